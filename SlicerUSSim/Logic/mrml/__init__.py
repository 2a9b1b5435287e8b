"""The simulator on the nodes of a MRML scene, in 3D Slicer or with its libraries alone.

The only room of Logic that imports `slicer`; "scene" means the MRML scene and nothing else.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .fit_nodes import CostPlot as CostPlot
    from .logic import UltrasoundSceneLogic as UltrasoundSceneLogic
    from .parameter_node import SceneParameters as SceneParameters
    from .sequence_nodes import add_sequence as add_sequence

lazy_exports(globals())
