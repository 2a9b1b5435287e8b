"""The stages of an image in their order: shared by simulator, appearance model, benchmark and numpy model.

How to add one is in docs/architecture.md#adding-a-stage.
"""

from __future__ import annotations

from SlicerUSSim.Logic.imaging.bmode import Compressor, PulseFilter
from SlicerUSSim.Logic.imaging.raytracing import RayTracer
from SlicerUSSim.Logic.imaging.scan_conversion import ScanConverter
from SlicerUSSim.Logic.imaging.scattering import InterfaceEchoes, LateralBeam, Scatterers
from SlicerUSSim.Logic.imaging.stage import Stage

#: From the acquisition to impulses along the traced lines
IMPULSE_STAGES: tuple[type[Stage], ...] = (RayTracer, Scatterers, InterfaceEchoes)
#: From there to the baseband signal. They are linear: the appearance model brings its bases through them one by one
LINEAR_STAGES: tuple[type[Stage], ...] = (LateralBeam, PulseFilter)
#: From the baseband signal to pixels
DISPLAY_STAGES: tuple[type[Stage], ...] = (Compressor, ScanConverter)
