"""Basic types of all other rooms: errors, settings, volumes, files, transforms.

Imports no other room. VTK and SimpleITK are imported only when a volume is converted for them.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .declaration import Parameter as Parameter, parameters_of as parameters_of
    from .errors import Cancelled as Cancelled, SimulationError as SimulationError, user_message as user_message
    from .files import read_json as read_json, write_json as write_json, written_whole as written_whole
    from .settings import DisplaySettings as DisplaySettings, SimulationSettings as SimulationSettings
    from .transforms import (
        LPS_TO_RAS as LPS_TO_RAS,
        check_affine as check_affine,
        check_rigid as check_rigid,
        nearest_rotation as nearest_rotation,
        rigid_between as rigid_between,
    )
    from .volume import Volume as Volume

lazy_exports(globals())
