"""Tissues: acoustic parameters with sources, labels and names, and texture.

A tissue has six parameters; a TissueTable assigns a tissue to every label of a label map.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .label_files import names_of_file as names_of_file, read_names as read_names
    from .label_mapping import LabelMapping as LabelMapping
    from .label_maps import LabelledTissues as LabelledTissues, read_label_map as read_label_map
    from .label_sources import read_label_file as read_label_file
    from .names import same_name as same_name, tissue_named as tissue_named
    from .presets import TISSUES as TISSUES, colour_of as colour_of
    from .surfels import KINDS as KINDS, Surfels as Surfels
    from .table import TissueTable as TissueTable
    from .texture import Texture as Texture
    from .tissue import Membrane as Membrane, Tissue as Tissue

lazy_exports(globals())
