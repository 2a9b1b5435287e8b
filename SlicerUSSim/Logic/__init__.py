"""The public interface: `from SlicerUSSim.Logic import UltrasoundSimulator`.

One room per subject, each with its own face: base, opencl, probe, tissue, tracked, mri, placement, imaging,
datasets, fitting, vtk, mrml. Names are imported when they are first used, so that importing this package costs nothing.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports
from SlicerUSSim.Logic.base.version import __version__ as __version__

if TYPE_CHECKING:
    from .base.errors import SimulationError as SimulationError
    from .base.settings import DisplaySettings as DisplaySettings, SimulationSettings as SimulationSettings
    from .base.volume import Volume as Volume
    from .fitting.image_similarity import similarity as similarity
    from .fitting.optimization import AppearanceResult as AppearanceResult, optimize_appearance as optimize_appearance
    from .imaging.frame import Frame as Frame
    from .imaging.noise import seed_of_pose as seed_of_pose
    from .imaging.preset import Preset as Preset
    from .imaging.simulator import UltrasoundSimulator as UltrasoundSimulator
    from .mri.ct import CtSegmentation as CtSegmentation, segment_ct as segment_ct
    from .mri.lesions.grown_lesion import GrownLesion as GrownLesion
    from .mri.lesions.seeded import grow_lesion as grow_lesion
    from .mri.segmentation import Segmentation as Segmentation, segment_mri as segment_mri
    from .opencl.devices import list_devices as list_devices
    from .probe.arrays import ConvexProbe as ConvexProbe, LinearProbe as LinearProbe, PhasedProbe as PhasedProbe
    from .tissue.table import TissueTable as TissueTable
    from .tissue.texture import Texture as Texture
    from .tissue.tissue import Membrane as Membrane, Tissue as Tissue
    from .tracked.sequence import TrackedSequence as TrackedSequence

lazy_exports(globals())
