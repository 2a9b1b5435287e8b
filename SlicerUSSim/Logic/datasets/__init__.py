"""Data sets: many labelled images from a recipe, made by one process or by many, and what reads them.

Image i is a function of the recipe's seed and i alone, so that any worker makes the same bits.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .recipe import READY as READY, Recipe as Recipe

lazy_exports(globals())
