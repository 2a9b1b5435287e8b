"""Lesions proposed from an MRI: grown from a point, or where a brain differs from a healthy one. Never applied alone."""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .detection import propose_lesions as propose_lesions
    from .proposal import Proposal as Proposal
    from .seeded import grow_lesion as grow_lesion

lazy_exports(globals())
