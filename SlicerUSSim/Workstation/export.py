"""Export of images, alone and with their geometry, of the cine and of the scene."""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from trame_slicer.core import SlicerApp
from vtkmodules.vtkCommonCore import vtkOutputWindow

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.base.ultrasound_dicom import ultrasound_dicom
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class
from SlicerUSSim.Logic.mrml.taken_image import TakenImage
from SlicerUSSim.Logic.tracked.sequence import SIMULATED, TrackedSequence
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.cine import Cine

#: File formats of an image with its geometry.
FRAME_SUFFIXES = (".nrrd", ".mha", ".vti")
#: Key of a file's header under which is what its image is of, see TakenImage.about
ABOUT = "SlicerUSSim"
#: The kind of export that a page composes
DICOM = "dicom"
#: Bytes of all pixels
_MOST_BYTES = 2**30
#: Numbers that a page sends: edges of the image region in pixels (x1, y1 behind the last), mm per pixel, ms per frame
_NAMES = ("x0", "y0", "x1", "y1", "mm_x", "mm_y", "frame_ms")


def png(taken: TakenImage) -> bytes:
    """An image as a PNG file, without scaling, with what it is of as a text."""
    buffer, text = io.BytesIO(), PngInfo()
    text.add_itxt(ABOUT, json.dumps(taken.about()))
    Image.fromarray(taken.image).save(buffer, "PNG", pnginfo=text)
    return buffer.getvalue()


def frame_file(taken: TakenImage, suffix: str) -> bytes:
    """An image with its position in the patient, and what it is of, as a file.

    Raises SimulationError if `suffix` is not one of FRAME_SUFFIXES.
    """
    require(suffix in FRAME_SUFFIXES, f"the file type is {suffix!r}, expected {', '.join(FRAME_SUFFIXES)}")
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"frame{suffix}"
        taken.volume().write(path, about={ABOUT: json.dumps(taken.about())})
        return path.read_bytes()


def sequence_file(images: Sequence[tuple[float, TakenImage]]) -> bytes:
    """Images with their times in s as a sequence metafile (.igs.mha), with their places in the MRI (RAS, mm).

    The file says what the last one is of (TakenImage.about).
    """
    seconds, taken = zip(*images, strict=True)
    transforms = tuple(
        {"ImageToProbe": image.grid.image_to_probe, "ProbeToReference": image.probe_to_world} for image in taken
    )
    fields = {SIMULATED: "cine", ABOUT: json.dumps(taken[-1].about())}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "cine.igs.mha"
        TrackedSequence(np.stack([image.image for image in taken]), transforms, np.array(seconds), fields=fields).write(
            path
        )
        return path.read_bytes()


class Exports:
    """The contents of the menu Export, by kind: png, .nrrd, .mha, .vti, cine, dicom, mrb, json.

    Each is (file name, content, MIME type). Raises SimulationError if there is nothing to export.
    """

    def __init__(self, app: SlicerApp, panel: BrowserPanel, cine: Cine, saved: Callable[[], None]) -> None:
        self._app, self._logic, self._tasks, self._cine, self._saved = app, panel.logic, panel.tasks, cine, saved
        self._preset, self._progress = panel.presenter.values.presetToSave, panel.progress

    def export(self, kind: str, sent: Mapping[str, bytes]) -> tuple[str, bytes, str]:
        """Export one kind, in a task: what takes time can be cancelled, and images go on meanwhile.

        `sent` are the files of which a page has composed it, see ultrasound_file.
        """
        if kind == "json":
            return "preset.json", json.dumps(self._preset().to_dict(), indent=2).encode(), "application/json"
        if kind == "mrb":
            return "ultrasound.mrb", self._scene(), "application/zip"
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
    stores: dict[Any, Any] = {}
    for node in nodes_of_class(app.scene, "vtkMRMLStorableNode"):
        if node.GetSaveWithScene() and (node.GetStorageNode() is not None or node.AddDefaultStorageNode()):
            store = node.GetStorageNode()
            if store is not None:  # some are whole in the scene's own file
                stores[store] = store.GetUseCompression()
    window = vtkOutputWindow.GetInstance()
    window.SetDisplayModeToNever()  # VTK would report every file of the scene
    try:
        for store in stores:
            store.SetUseCompression(False)
        is_written = app.app_logic.SaveSceneToSlicerDataBundleDirectory(str(folder), None)
    finally:
        for store, uses_compression in stores.items():
            store.SetUseCompression(uses_compression)
        window.SetDisplayModeToAlwaysStdErr()
    scene = folder / f"{folder.name}.mrml"
    if not is_written or not scene.exists():
        raise SimulationError("the scene could not be written")
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
