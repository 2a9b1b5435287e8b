"""Is it right, and is it fast: phantoms, measurements, validation, twins, benchmark, a model in numpy.

Nothing outside of this room imports it but the commands that run it.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .measurement import fit_rayleigh as fit_rayleigh, level_db as level_db
    from .phantoms import Echo as Echo, Phantom as Phantom
    from .twins import Twin as Twin, make_twin as make_twin

lazy_exports(globals())
