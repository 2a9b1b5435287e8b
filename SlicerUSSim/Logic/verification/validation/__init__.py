"""Is the simulator right? Every number of the model's specification, measured on phantoms against its prediction.

A check measures one phenomenon for one orientation of its phantom on the voxels, with every probe it applies to; its
outcome is rows of a table (predicted, measured, tolerance) and a picture. `ussim validate` runs them all.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .checks import (
        ORIENTATIONS as ORIENTATIONS,
        PROBES as PROBES,
        Check as Check,
        Outcome as Outcome,
        Row as Row,
    )
    from .run import (
        Finding as Finding,
        Report as Report,
        all_checks as all_checks,
        chosen_checks as chosen_checks,
        validate as validate,
    )

lazy_exports(globals())
