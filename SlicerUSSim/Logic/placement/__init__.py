"""Where a probe stands on a patient: openings in the skull, standard views, aims, approaches, and bone before it."""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .aiming import opening_pose as opening_pose
    from .approach import plan_approach as plan_approach
    from .approach_weights import ApproachWeights as ApproachWeights
    from .bone_before_probe import about_bone as about_bone
    from .craniotomy import default_pose as default_pose, opened as opened
    from .views import VIEWS as VIEWS, view_pose as view_pose

lazy_exports(globals())
