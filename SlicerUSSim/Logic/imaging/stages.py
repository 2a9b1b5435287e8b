"""The stages of an image, in order: shared by simulator, appearance model and benchmark.

How to add one is in docs/architecture.md#adding-a-stage.
"""

from __future__ import annotations

from SlicerUSSim.Logic.imaging.aperture import Aperture
from SlicerUSSim.Logic.imaging.bmode import Compressor, PulseFilter, ScanConverter
from SlicerUSSim.Logic.imaging.console import EdgeEnhancement, EnvelopeSmoothing, GreyMapping
from SlicerUSSim.Logic.imaging.raytracing import RayTracer
from SlicerUSSim.Logic.imaging.scattering import InterfaceEchoes, LateralBeam, Scatterers
from SlicerUSSim.Logic.imaging.side_lobes import SideLobes
from SlicerUSSim.Logic.imaging.stage import Stage

#: From the acquisition to impulses along the traced lines
IMPULSE_STAGES: tuple[type[Stage], ...] = (Aperture, RayTracer, Scatterers)
#: From there to the baseband signal. They are linear, so the appearance model applies them to each of its bases, and
#: adds the interfaces to the one of the fixed tissues
LINEAR_STAGES: tuple[type[Stage], ...] = (LateralBeam, SideLobes, InterfaceEchoes, PulseFilter)
#: From the baseband signal to pixels
DISPLAY_STAGES: tuple[type[Stage], ...] = (
    Compressor, EnvelopeSmoothing, GreyMapping, EdgeEnhancement, ScanConverter,
)  # fmt: skip
