"""The first ten minutes with the module, in a Python with nothing but Slicer's libraries and the module's packages.

    python tests/first_ten_minutes.py HEAD_WITH_BRAIN.npz FOLDER

does, without Qt, what a newcomer does in Slicer: a whole head in, Segment, Live, save, close, load, sequence, fit. It
prints a JSON line with the seconds of each step and what was found. The caches of kernels are empty at first.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter, sleep

import numpy as np

FOLDER = Path(sys.argv[2])
os.environ["XDG_CACHE_HOME"] = str(FOLDER / "cache")
(FOLDER / "cache").mkdir(parents=True)

import slicer  # noqa: E402

from SlicerUSSim.Logic.base.volume import Volume  # noqa: E402
from SlicerUSSim.Logic.imaging.device_trials import DeviceTrials  # noqa: E402
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import node_to_world, read_volume, set_node_to_world, write_volume  # noqa: E402
from SlicerUSSim.Widget.presenter import PanelPresenter  # noqa: E402

SECONDS: dict[str, float] = {}
FOUND: dict[str, object] = {}


@contextmanager
def step(name: str) -> Iterator[None]:
    start = perf_counter()
    yield
    SECONDS[name] = round(perf_counter() - start, 1)


class View:
    """A panel without widgets, whose event loop is `process`."""

    def __init__(self) -> None:
        self.waiting, self.titles, self.status = [], [], ""

    def showError(self, message: str) -> None:
        raise RuntimeError(message)

    def showStatus(self, message: str) -> None:
        self.status = message

    def refresh(self, changed=None) -> None:
        pass

    @contextmanager
    def progress(self, title: str) -> Iterator:
        self.titles.append(title)
        yield lambda share: None

    def schedule(self, function) -> None:
        self.waiting.append(function)

    def process(self) -> None:
        while self.waiting:
            self.waiting.pop(0)()

    def sliceNode(self):
        return None

    def showChart(self, chart_node) -> None:
        pass


def image(presenter: PanelPresenter) -> np.ndarray:
    return read_volume(presenter.parameters.output).array[0].copy()


def main(head_file: Path) -> None:
    with step("import, and open the panel"):
        scene = slicer.vtkMRMLScene()
        sequences = slicer.vtkSlicerSequencesLogic()
        sequences.SetMRMLScene(scene)
        view = View()
        presenter = PanelPresenter(UltrasoundSceneLogic(scene), view)
        presenter.trials = DeviceTrials()
    with np.load(head_file) as given:
        head, brain = Volume(given["head"], given["ijk_to_ras"]), given["brain"]
    node = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Head")
    write_volume(node, head)
    presenter.nodeAdded(node)
    view.process()

    with step("Segment"):
        presenter.segmenting.segment()
    nodes = presenter.parameters
    mask = read_volume(nodes.mask).array > 0
    FOUND["overlap"] = 2 * float((mask & brain).sum()) / float(mask.sum() + brain.sum())
    FOUND["mask is the same"] = bool(np.array_equal(mask, given_mask(head_file)))
    FOUND["notes"] = presenter.notes.text()
    presenter.values.setValue("scene.view", "temporal")
    with step("Place at view"):
        presenter.placing.placeAtView()
    with step("Live: the first image, with the rest of building kernels"):
        presenter.images.setLive(True)
    FOUND["titles"] = view.titles
    before = image(presenter)
    pose = node_to_world(nodes.probe_transform)
    poses = [pose @ shifted(0.5 * n) for n in range(5)]
    with step("Live: 5 images"):
        for at in poses:
            set_node_to_world(nodes.probe_transform, at)
            view.process()
    FOUND["changed"] = float((image(presenter) != before).mean())

    saved = FOLDER / "scene.mrb"
    with step("save"):
        save(scene, saved)
    with step("close"):
        scene.Clear(0)
        presenter.forgetPatient()  # as USSimWidget does then
    FOUND["after close"] = [presenter.notes.text(), view.status, presenter.fits.canApply()[0], presenter.logic.isLive]
    with step("load"):
        load(scene, saved)
    presenter.chooseDefaultNodes()
    FOUND["loaded"] = [nodes.mri.GetName(), nodes.labels.GetName(), nodes.probe_transform.GetName()]

    transforms = scene.AddNewNodeByClass("vtkMRMLSequenceNode", "Sweep")
    for number, at in enumerate(poses):
        item = slicer.vtkMRMLLinearTransformNode()
        set_node_to_world(item, at)
        transforms.SetDataNodeAtValue(item, str(number))
    nodes.transform_sequence = transforms
    with step("sequence of 5 images"):
        presenter.images.simulateSequence()
    FOUND["images"] = nodes.image_sequence.GetNumberOfDataNodes()

    preset = presenter.logic.preset
    presenter.logic.preset = preset.changed("display", gain_db=9.0)
    presenter.images.simulate()
    real = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Real")
    write_volume(real, Volume(image(presenter)[None], presenter.logic.lastImage().ijk_to_ras))
    presenter.logic.preset = preset
    nodes.real = real
    presenter.values.setValue("scene.fit_free", "gain_db")
    presenter.values.setValue("scene.fit_evaluations", 60)
    with step("fit"):
        presenter.fits.fit()
        presenter.fits.apply()
    FOUND["gain"] = presenter.logic.preset.display.gain_db
    presenter.trials.stop()
    while not presenter.trials.isDone:
        sleep(0.1)


def given_mask(head_file: Path) -> np.ndarray:
    with np.load(head_file) as given:
        return given["mask"]


def shifted(z_mm: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[2, 3] = z_mm
    return matrix


def save(scene, path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        scene.SetURL(str(Path(folder) / "scene.mrml"))
        scene.SetRootDirectory(folder)
        assert scene.WriteToMRB(str(path))


def load(scene, path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        zipfile.ZipFile(path).extractall(folder)
        scene.SetURL(str(next(Path(folder).rglob("*.mrml"))))
        assert scene.Import()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
    print(json.dumps({"seconds": SECONDS, "found": FOUND}))
