"""The simulator as filters of a VTK pipeline: an MRI to labels, labels to the image under a probe.

They execute again only if their input, the probe's transform or a parameter has changed.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .filters import (
        SegmentationFilter as SegmentationFilter,
        UltrasoundSimulationFilter as UltrasoundSimulationFilter,
    )

lazy_exports(globals())
