"""Export of images, alone and with their geometry, of the cine and of the scene."""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image
from trame_slicer.core import SlicerApp
from vtkmodules.vtkCommonCore import vtkOutputWindow

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.base.ultrasound_dicom import ultrasound_dicom
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class
from SlicerUSSim.Logic.mrml.taken_files import FRAME_SUFFIXES, frame_file, png, sequence_file
from SlicerUSSim.Logic.mrml.taken_image import TakenImage
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.cine import Cine
from SlicerUSSim.Workstation.pose_entry import PoseEntry

#: The kind of export that a page composes
DICOM = "dicom"
#: Bytes of all pixels
_MOST_BYTES = 2**30
#: Numbers that a page sends: edges of the image region in pixels (x1, y1 behind the last), mm per pixel, ms per frame
_NAMES = ("x0", "y0", "x1", "y1", "mm_x", "mm_y", "frame_ms")


class Exports:
    """The files of the menu Save, by kind: png, .nrrd, .mha, .vti, cine, dicom, mrb, json, pose.*.

    Each is (file name, content, MIME type). Raises SimulationError if there is nothing to export.
    """

    def __init__(
        self, app: SlicerApp, panel: BrowserPanel, cine: Cine, poses: PoseEntry, saved: Callable[[], None]
    ) -> None:
        self._pose_file = poses.file
        self._app, self._logic, self._tasks, self._cine, self._saved = app, panel.logic, panel.tasks, cine, saved
        self._preset, self._progress = panel.presenter.values.presetToSave, panel.progress

    def export(self, kind: str, sent: Mapping[str, bytes]) -> tuple[str, bytes, str]:
        """Export one kind, in a task: long work can be cancelled, and images continue meanwhile.

        `sent` are the files of which a page has composed it, see ultrasound_file.
        """
        if kind == "json":
            return "preset.json", json.dumps(self._preset().to_dict(), indent=2).encode(), "application/json"
        if kind == "mrb":
            return "ultrasound.mrb", self._scene(), "application/zip"
        if kind.startswith("pose."):
            return *self._pose_file(kind.removeprefix("pose")), "application/octet-stream"
        if kind == "cine":
            with self._progress("Export the cine") as progress:
                images = list(self._cine.displayed(progress))
                return "cine.igs.mha", self._tasks.doAside(lambda: sequence_file(images)), "application/octet-stream"
        require(kind in ("png", DICOM, *FRAME_SUFFIXES), f"the export is {kind[:20]!r}, expected one of the menu")
        taken = required(self._logic.taken, "there is no image, expected labels and a probe")
        if kind == DICOM:
            return "ultrasound.dcm", self._tasks.doAside(lambda: ultrasound_file(sent, taken)), "application/dicom"
        if kind == "png":
            return "ultrasound.png", png(taken), "image/png"
        return f"ultrasound{kind}", frame_file(taken, kind), "application/octet-stream"

    def _scene(self) -> bytes:
        """The scene of this moment as .mrb, which 3D Slicer opens."""
        with self._progress("Export the scene") as progress, TemporaryDirectory() as folder:
            with self._logic.imageHeld():
                files = write_bundle(self._app, Path(folder) / "ultrasound")
                self._saved()
            return self._tasks.doAside(lambda: zipped(files, progress))


def zipped(files: Mapping[str, Path], progress: Callable[[float], None]) -> bytes:
    """A .zip of {name: file}; `progress` may raise errors.Cancelled."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for number, (name, file) in enumerate(files.items()):
            progress(number / len(files))
            archive.write(file, name)
    return buffer.getvalue()


def write_bundle(app: SlicerApp, folder: Path) -> dict[str, Path]:
    """{name in an .mrb: file} of the scene of a SlicerApp, which is written into a new folder.

    Nothing is compressed yet: this is done in the event loop, where 100 MB take some hundredths of a second.
    Raises SimulationError if it cannot be written.
    """
    folder.mkdir()
    _remove_unused_stores(app.scene)
    for node in nodes_of_class(app.scene, "vtkMRMLStorableNode"):
        if node.GetSaveWithScene() and (node.GetStorageNode() is not None or node.AddDefaultStorageNode()):
            store = node.GetStorageNode()
            if store is not None:  # some are whole in the scene's own file
                store.SetUseCompression(False)
    window = vtkOutputWindow.GetInstance()
    window.SetDisplayModeToNever()  # VTK would report every file of the scene
    try:
        is_written = app.app_logic.SaveSceneToSlicerDataBundleDirectory(str(folder), None)
    finally:
        window.SetDisplayModeToAlwaysStdErr()
    scene = folder / f"{folder.name}.mrml"
    require(is_written and scene.exists(), "the scene could not be written")
    # What is saved from this scene again is compressed, as usual
    scene.write_text(scene.read_text("utf-8").replace('useCompression="0"', 'useCompression="1"'), "utf-8")
    return {path.relative_to(folder.parent).as_posix(): path for path in sorted(folder.rglob("*")) if path.is_file()}


def _remove_unused_stores(scene) -> None:
    """Remove storage nodes of nodes that are gone: scenes would name the folder of the last one as their file."""
    used = {
        node.GetNthStorageNode(number)
        for node in nodes_of_class(scene, "vtkMRMLStorableNode")
        for number in range(node.GetNumberOfStorageNodes())
    }
    for store in nodes_of_class(scene, "vtkMRMLStorageNode"):
        if store not in used:
            scene.RemoveNode(store)


def ultrasound_file(sent: Mapping[str, bytes], taken: TakenImage) -> bytes:
    """One frame or several as a DICOM file of the patient and time of `taken`, with one calibrated region.

    `sent` are the frames (PNG) by name, in their order, and "": JSON with the numbers of _NAMES.
    Raises SimulationError for frames of several sizes, and for a region that is not in them.
    """
    try:
        about = json.loads(sent.get("", b""))
        x0, y0, x1, y1, mm_x, mm_y, frame_ms = (float(about[name]) for name in _NAMES)
        images = [Image.open(io.BytesIO(content)) for name, content in sent.items() if name]
        sizes = {image.size for image in images}
        require(len(sizes) == 1, f"the frames have the sizes {sorted(sizes)}, expected one size")
        width, height = sizes.pop()
        require(3 * width * height * len(images) <= _MOST_BYTES, f"the frames are {len(images)}, expected fewer")
        frames = np.stack([np.asarray(image.convert("RGB")) for image in images])
    except (ValueError, LookupError, TypeError, OSError) as error:
        raise SimulationError(f"the frames of the page cannot be read ({error})") from None
    scale = mm_x, mm_y, frame_ms if len(images) > 1 else 1.0
    is_scale = all(0 < value < math.inf for value in scale)
    is_region = 0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height
    require(is_region and is_scale, f"the region of the image is {about}, expected one within {width}x{height} pixels")
    edges = tuple(map(round, (x0, y0, x1 - 1, y1 - 1)))
    return ultrasound_dicom(
        frames, edges, (mm_x, mm_y), patient=taken.patient, time=taken.time, frame_ms=scale[2], has_texts=True
    )
