"""read_scene: scenes of 3D Slicer and of this workstation (.mrb), read by a child process into plain values."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.reading import in_child
from SlicerUSSim.Logic.mrml.scene_bundle import unpacked
from SlicerUSSim.Logic.mrml.scene_record import SceneRecord, record_scene


def read_scene(path: str | os.PathLike) -> SceneRecord:
    """The patient, the choices of the module and the probe in a bundle.

    Raises SimulationError for another file, one that names files outside it, and for a scene without a volume.
    """
    with TemporaryDirectory(prefix="ussim-scene-") as folder:  # of this process, which outlives the child
        return _read_scene(path, folder)


@in_child
def _read_scene(path: str | os.PathLike, folder: str) -> SceneRecord:
    """The same, with a folder to unpack it in."""
    import slicer
    from trame_slicer.core import SlicerApp
    from vtkmodules.vtkCommonCore import vtkOutputWindow

    scene_path = unpacked(Path(path), Path(folder).resolve() / "scene")
    app = SlicerApp()
    app.register_module_logic(cast(Any, slicer).vtkSlicerSequencesLogic())
    window = vtkOutputWindow.GetInstance()
    window.SetDisplayModeToNever()
    require(bool(app.io_manager.load_scene(scene_path)), f"{path}: the scene cannot be read")
    return record_scene(app.scene)
