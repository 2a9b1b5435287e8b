"""Environments for agents that learn to move a probe, with the API of Gymnasium: pip install "SlicerUSSim[gym]"."""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .find_view import FindView as FindView

lazy_exports(globals())
