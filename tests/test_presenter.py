"""The panel's presenter without Qt, with another view, as in the browser."""

from __future__ import annotations

import subprocess
import sys
from contextlib import contextmanager

import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from SlicerUSSim.Logic.mri.samples import head_mri  # noqa: E402
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import write_volume  # noqa: E402
from SlicerUSSim.Widget.presenter import PanelPresenter  # noqa: E402


class PlainView:
    """Records all calls; its event loop is a list."""

    def __init__(self) -> None:
        self.errors, self.status, self.waiting, self.shares, self.refreshed = [], [], [], [], 0

    def showError(self, message: str) -> None:
        self.errors.append(message)

    def showStatus(self, message: str) -> None:
        self.status.append(message)

    def refresh(self) -> None:
        self.refreshed += 1

    @contextmanager
    def progress(self, title: str):
        yield self.shares.append

    def schedule(self, function) -> None:
        self.waiting.append(function)

    def sliceNode(self):
        return None


@pytest.fixture
def presenter():
    scene = slicer.vtkMRMLScene()
    node = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Head")
    write_volume(node, head_mri(3.0))
    result = PanelPresenter(UltrasoundSceneLogic(scene), PlainView())
    result.chooseDefaultNodes()
    return result


def test_it_needs_no_qt():
    code = (
        "import sys, SlicerUSSim.Widget.presenter; "
        "print([name for name in sys.modules if name.split('.')[0] in ('qt', 'PySide6')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.strip() == "[]", done.stderr


def test_from_mri_to_live_image(presenter):
    view = presenter.view
    assert presenter.canSegment()[0] and not presenter.canSimulate()[0]
    presenter.segment()
    assert presenter.canSimulate()[0] and view.shares[-1] == 1.0
    presenter.setValue("probe.scan_lines", 48)
    presenter.setLive(True)
    assert presenter.isLive() and not view.errors
    before = slicer.util.arrayFromVolume(presenter.logic.parameters.output).copy()
    presenter.setValue("display.gain_db", 10.0)
    assert presenter.value("display.gain_db") == 10.0 and len(view.waiting) == 1
    view.waiting.pop()()
    after = slicer.util.arrayFromVolume(presenter.logic.parameters.output)
    assert after.astype(float).mean() > before.astype(float).mean() + 10
    presenter.setLive(False)
    assert not presenter.isLive()


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda p: p.setValue("display.gain_db", 1000.0), "display: gain_db is 1000.0"),
        (lambda p: p.chooseProbe("loud"), "no probe is called 'loud', expected one of phased"),
        (lambda p: p.setTissue("csf", "mu0", "nan"), "tissue 'csf': mu0 is 'nan', expected a number"),
        (lambda p: p.setTissue("bone marrow", "mu0", "1"), "no tissue is called 'bone marrow'"),
        (lambda p: p.assignTissue("csf", "cheese"), "no tissue is called 'cheese'"),
        (lambda p: p.setLive(True), "no label map chosen; segment the MRI first"),
        (lambda p: p.placeProbe(), "no label map chosen, expected one to put the probe on"),
        (lambda p: p.loadPreset("/nowhere.json"), "/nowhere.json: cannot be read"),
    ],
)
def test_what_a_user_does_wrong_is_shown_and_changes_nothing(presenter, act, message):
    before, nodes = presenter.logic.preset, presenter.logic.scene.GetNumberOfNodes()
    act(presenter)
    assert len(presenter.view.errors) == 1 and message in presenter.view.errors[0]
    assert presenter.logic.preset == before and presenter.logic.scene.GetNumberOfNodes() == nodes
    assert presenter.view.refreshed


def test_a_bug_of_ours_is_not_swallowed(presenter, monkeypatch):
    monkeypatch.setattr(presenter.logic, "segment", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        presenter.segment()
    assert presenter.logic.scene.GetFirstNodeByName("Head tissues") is None and presenter.canSegment()[0]
