"""From a label map and a pose to an image, in stages: medium, ray tree, echoes, B-mode, scan conversion.

`simulator` runs the stages; each has its host code here and its kernels in kernels/. A Preset has all user settings.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .compounding import Compounder as Compounder, sweep_grid as sweep_grid
    from .frame import Frame as Frame
    from .noise import seed_of_pose as seed_of_pose
    from .preset import Preset as Preset
    from .reuse import ReusedSimulator as ReusedSimulator
    from .self_check import SelfCheck as SelfCheck, check_devices as check_devices
    from .simulator import (
        EmptyViewWarning as EmptyViewWarning,
        SlowScatterersWarning as SlowScatterersWarning,
        TreeOverflowWarning as TreeOverflowWarning,
        UltrasoundSimulator as UltrasoundSimulator,
    )

lazy_exports(globals())
