"""Data sets: many labelled images from a recipe, made by one process or by many, and what reads them.

Image i is a function of the recipe's seed and i alone, so that any worker with the same OpenCL runtime makes the same
bits.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .making import Made as Made, make_dataset as make_dataset
    from .reader import SimulatedImages as SimulatedImages, export_coco as export_coco, export_nnunet as export_nnunet
    from .recipe import READY as READY, Recipe as Recipe

lazy_exports(globals())
