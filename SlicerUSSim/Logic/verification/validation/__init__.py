"""Validation: the quantities of the model's specification, measured on phantoms and compared with theory.

A check measures one phenomenon for one orientation of its phantom to the voxels, with all probes to which it applies.
Its outcome is rows of a table (predicted, measured, tolerance) and a figure. `ussim validate` runs all checks.
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
