"""Export of images, frames with their geometry, cine loops and the scene."""

from __future__ import annotations

import io
import json
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from trame_slicer.core import SlicerApp
from vtkmodules.vtkCommonCore import vtkOutputWindow

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class
from SlicerUSSim.Logic.mrml.taken_image import TakenImage
from SlicerUSSim.Workstation.browser_panel import BrowserPanel

#: File formats of an image with its geometry.
FRAME_SUFFIXES = (".nrrd", ".mha", ".vti")
#: Key of a file's header under which is what its image is of, see TakenImage.about
ABOUT = "SlicerUSSim"
#: Number of images in a cine loop; and limits of the display time of each, in milliseconds.
MOST_IMAGES = 200
_SHORTEST_MS, _LONGEST_MS = 40, 500


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


class CineImage(NamedTuple):
    """One image of a cine loop."""

    #: When it was shown
    seconds: float
    #: (rows, columns) uint8
    image: np.ndarray
    #: What it is of, as JSON, see TakenImage.about; "" if that is not known
    about: str = ""


class Cine:
    """A cine loop: the last images, as in a scanner."""

    def __init__(self) -> None:
        self._images: deque[CineImage] = deque(maxlen=MOST_IMAGES)

    def add(self, image: np.ndarray, seconds: float, about: str = "") -> None:
        """Append a (rows, columns) uint8 image with its time and what it is of; another size starts a new loop."""
        if self._images and self._images[-1].image.shape != image.shape:
            self.clear()
        self._images.append(CineImage(seconds, image, about))

    def clear(self) -> None:
        """Forget all images."""
        self._images.clear()

    @property
    def images(self) -> list[CineImage]:
        """All, which are never changed."""
        return list(self._images)


def gif(images: Sequence[CineImage], progress: Callable[[float], None] = lambda share: None) -> bytes:
    """An animated GIF with the original timing, and what each image is of as a comment (of_images).

    `progress` is called with the fraction done before every image, and may raise errors.Cancelled.
    Raises SimulationError for fewer than two images.
    """
    require(len(images) > 1, f"the cine loop has {len(images)} images, expected two or more")
    times = np.array([one.seconds for one in images])
    waits = np.clip(np.diff(times, append=times[-1] + 0.2) * 1e3, _SHORTEST_MS, _LONGEST_MS)

    def others() -> Iterator[Image.Image]:
        for number, one in enumerate(images[1:], 1):
            progress(number / len(images))
            yield Image.fromarray(one.image)

    buffer = io.BytesIO()
    Image.fromarray(images[0].image).save(
        buffer, "GIF", save_all=True, append_images=others(), duration=waits.round(-1).astype(int).tolist(), loop=0,
        comment=of_images(images).encode(),
    )  # fmt: skip
    return buffer.getvalue()


def of_images(images: Sequence[CineImage]) -> str:
    """What images are of, as JSON {"images": one for each, "presets": once each, by the images' "preset"}.

    See TakenImage.about; {} for an image of which that is not known.
    """
    presets: list[Any] = []
    about: list[dict[str, Any]] = []
    for one in images:
        known = json.loads(one.about) if one.about else {}
        if "preset" in known:
            if known["preset"] not in presets[-1:]:
                presets.append(known["preset"])
            known["preset"] = len(presets) - 1
        about.append(known)
    return json.dumps({"images": about, "presets": presets})


class Exports:
    """The contents of the menu Export, by kind: png, .nrrd, .mha, .vti, gif, mrb, json.

    Each is (file name, content, MIME type). Raises SimulationError if there is nothing to export.
    """

    def __init__(self, app: SlicerApp, panel: BrowserPanel, cine: Cine, saved: Callable[[], None]) -> None:
        self._app, self._logic, self._tasks, self._cine, self._saved = app, panel.logic, panel.tasks, cine, saved
        self._preset, self._progress = panel.presenter.values.presetToSave, panel.progress

    def export(self, kind: str) -> tuple[str, bytes, str]:
        """Export one kind, in a task: what takes time can be cancelled, and images go on meanwhile."""
        if kind == "json":
            return "preset.json", json.dumps(self._preset().to_dict(), indent=2).encode(), "application/json"
        if kind == "mrb":
            return "ultrasound.mrb", self._scene(), "application/zip"
        if kind == "gif":
            images = self._cine.images
            with self._progress("Export the images") as progress:
                content = self._tasks.doAside(lambda: gif(images, progress))
            return "ultrasound.gif", content, "image/gif"
        require(kind in ("png", *FRAME_SUFFIXES), f"the export is {kind[:20]!r}, expected one of the menu")
        taken = required(self._logic.taken, "there is no image, expected labels and a probe")
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
