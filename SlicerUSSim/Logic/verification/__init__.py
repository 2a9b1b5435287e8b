"""Verification and benchmarks: phantoms, measurements, validation, twins, benchmark, numpy model.

Only the commands that run it import this room.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .measurement import fit_rayleigh as fit_rayleigh, level_db as level_db
    from .phantoms import Echo as Echo, Phantom as Phantom
    from .twins import Twin as Twin, make_twin as make_twin

lazy_exports(globals())
