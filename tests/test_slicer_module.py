"""The scripted module as loaded and run by Slicer, with stand-ins for parts of the Slicer application."""

from __future__ import annotations

import gc
import importlib
import importlib.metadata
import json
import logging
import os
import re
import subprocess
import sys
import textwrap
import types
import typing
from pathlib import Path

import numpy as np
import pytest
from vtkmodules.vtkCommonTransforms import vtkTransform

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")
pytest.importorskip("PySide6", reason="the panel is tested on Qt for Python: pip install PySide6-Essentials")

from tests import slicer_stand_in as stand_in  # noqa: E402
from tests.remembered import once  # noqa: E402
from tests.shared_data import SHARED, needs_shared  # noqa: E402
from tests.slicer_factory import load_source_as_module  # noqa: E402

ROOT = Path(__file__).parents[1]
MODULE_FILE = ROOT / "SlicerUSSim" / "USSim.py"
RESOURCES = ROOT / "SlicerUSSim" / "Resources"


@pytest.fixture(scope="module")
def module():
    """USSim.py, loaded as Slicer does, afterwards everything is imported as it was."""
    before = dict(sys.modules)
    own = slicer.__dict__.copy(), slicer.util.__dict__.copy()
    app = stand_in.start()
    for name in [name for name in sys.modules if name.split(".")[0] == "SlicerUSSim"]:
        del sys.modules[name]
    loaded = load_source_as_module("USSim", MODULE_FILE)
    loaded.app = app
    importlib.import_module("SlicerUSSim.Logic.imaging.device_trials").DeviceTrials = tried(own_device())
    yield loaded
    logging.getLogger("SlicerUSSim").setLevel(logging.NOTSET)
    for name in set(sys.modules) - set(before):
        if name.split(".")[0] in ("USSim", "SlicerUSSim", "qt", "ctk") or name.startswith("slicer."):
            del sys.modules[name]
    sys.modules.update(before)
    for target, values in zip((slicer, slicer.util), own, strict=True):
        for name in set(vars(target)) - set(values):
            delattr(target, name)
        vars(target).update(values)


def test_slicers_log_gets_choices_once_and_nothing_for_each_live_image(module):
    ours = logging.getLogger("SlicerUSSim")
    assert ours.level == logging.INFO and not ours.handlers and ours.propagate


def own_device():
    """The device of this computer, as if it had been tried."""
    info = importlib.import_module("SlicerUSSim.Logic.opencl.devices").choose_device()[0]
    kind = importlib.import_module("SlicerUSSim.Logic.imaging.device_trials").TriedDevice
    return kind(info.index, info.name, info.platform, info.kind, 20.0)


def tried(*devices, error: str = "", waits: int = 0):
    """DeviceTrials in place of the ones in child processes, with these results after some calls of progress."""

    class Tried:
        used = property(lambda self: devices[0] if devices and self.count >= waits else None)
        isDone = property(lambda self: self.count >= waits)

        def __init__(self, known, chosen) -> None:
            self.known, self.chosen, self.count = known, chosen, 0
            self.devices, self.error = sorted(devices, key=lambda device: device.key != chosen), error

        def wait(self, progress) -> None:
            while not self.isDone:
                self.count += 1
                progress(self.count / waits)

        def stop(self) -> None:
            pass

    return Tried


class Session:
    """A scene, and the module's panel open on it."""

    def __init__(self, module) -> None:
        self.module, self.app = module, module.app
        self.app.errors.clear()
        slicer.mrmlScene = self.scene = slicer.vtkMRMLScene()
        self.sequences = slicer.vtkSlicerSequencesLogic()
        self.sequences.SetMRMLScene(self.scene)
        for name in ("Red", "Yellow"):
            view = self.add("Slice", name)
            view.SetLayoutName(name)
            self.add("SliceComposite", name).SetLayoutName(name)
        parent = stand_in.QtWidgets.QWidget()
        stand_in.QtWidgets.QVBoxLayout(parent)
        parent.isEntered = True
        self.parent = parent
        self.widget = module.USSimWidget(parent)
        self.widget.setup()
        self.widget.enter()

    ui = property(lambda self: self.widget.ui)
    panel = property(lambda self: self.widget.panel)
    logic = property(lambda self: self.widget.logic.ultrasound)
    parameters = property(lambda self: self.logic.parameters)

    def add(self, kind: str, name: str):
        return self.scene.AddNewNodeByClass(f"vtkMRML{kind}Node", name)

    def head(self):
        """A small head, as loading an MRI would add it."""
        node = self.add("ScalarVolume", "Head")
        self.logic_module("mrml.nodes").write_volume(node, self.logic_module("mri.samples").head_mri(4.0))
        return node

    def segmented(self):
        """The same with its tissues, a coarse probe for speed, and the first image."""
        modality = self.logic_module("mri.modality")
        if not hasattr(self.module, "segment_once"):  # of the same head in all tests
            self.module.segment_once = modality.segment_mri = once(modality.segment_mri)
        self.parameters.mri = self.head()
        self.ui.scanLinesSpinBox.setValue(48)
        self.ui.segmentButton.click()
        return self

    @staticmethod
    def logic_module(name: str):
        return importlib.import_module(f"SlicerUSSim.Logic.{name}")

    def process(self) -> None:
        self.app.processEvents()
        self.app.processEvents()

    def image(self) -> np.ndarray:
        return slicer.util.arrayFromVolume(self.parameters.output)[0].copy()

    def move(self, z: float) -> None:
        node = self.parameters.probe_transform
        transform = vtkTransform()
        transform.SetMatrix(node.GetMatrixTransformToParent())
        transform.Translate(0, 0, z)
        node.SetMatrixTransformToParent(transform.GetMatrix())

    def close(self) -> None:
        self.widget.cleanup()
        self.parent.deleteLater()
        self.process()


@pytest.fixture
def simulation_error(module):
    """The class as imported by the module, independent of other imports of that name."""
    return lambda: importlib.import_module("SlicerUSSim.Logic.base.errors").SimulationError


@pytest.fixture
def session(module):
    result = Session(module)
    yield result
    result.close()


# ---- loading ---------------------------------------------------------------------------------------------------------


def test_start_up_imports_nothing_that_takes_time_or_may_be_missing():
    code = """
        import os, sys
        from importlib import metadata
        os.environ["QT_QPA_PLATFORM"] = "offscreen"
        missing = ("pyopencl", "nlopt", "skimage", "platformdirs", "PIL", "tqdm", "click", "matplotlib", "nrrd",
                   "nibabel")
        class Finder:
            def find_spec(self, name, path=None, target=None):
                if name.split(".")[0] in missing:
                    raise ImportError(name)
        sys.meta_path.insert(0, Finder())
        from tests import slicer_stand_in as stand_in, test_slicer_module as tests
        app = stand_in.start()
        real = metadata.version
        def version(name):         # as if they had never been installed
            if name in ("pyopencl", "scikit-image") and not app.installed:
                raise metadata.PackageNotFoundError(name)
            return real(name)
        metadata.version = version
        module = tests.load_source_as_module("USSim", tests.MODULE_FILE)
        assert not any(name.startswith(("SlicerUSSim.", "scipy")) for name in sys.modules), "imported at start-up"
        module.app = app
        session = tests.Session(module)    # the panel opens all the same
        assert not session.app.errors
        session.parameters.mri = session.head()
        app.answer = False                 # the user does not want the packages
        session.ui.segmentButton.click()
        assert session.app.errors == [
            "SlicerUSSim needs Python packages that are not installed (the installation was declined)"
        ], session.app.errors
        assert "pyopencl" in app.questions[0] and not app.installed
        app.testing, app.answer = True, False    # Slicer's message boxes then answer themselves
        module.USSimTest().runTest()
        assert "Test skipped" in app.shown[-1] and "pyopencl" in app.shown[-1] and not app.installed, app.shown
        app.testing, app.answer = False, True
        module.ensurePackages()
        assert app.installed == ["pyopencl>=2023.1", "scikit-image>=0.22"], app.installed
        assert "numpy==" + real("numpy") in app.constraints.splitlines()
        print("fine")
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0 and done.stdout.strip().endswith("fine"), done.stderr[-2000:]


def test_without_its_packages_the_panel_asks_for_them_and_is_shown_then(module, simulation_error, monkeypatch):
    def declined() -> None:
        raise simulation_error()("the installation was declined")

    monkeypatch.setitem(sys.modules, "SlicerUSSim.Widget.panel", None)  # importing it fails
    monkeypatch.setattr(module, "ensurePackages", declined)
    session = Session(module)
    widget = session.widget
    widget.onSceneEndChange(None, None)
    assert widget.panel is None and module.app.errors == ["the installation was declined"]
    monkeypatch.delitem(sys.modules, "SlicerUSSim.Widget.panel")
    monkeypatch.setattr(module, "ensurePackages", lambda: None)
    widget.installButton.click()
    assert widget.panel is not None and widget.ui.segmentButton
    assert not widget.installButton.isVisibleTo(session.parent)
    session.close()


def test_requirements_are_those_of_the_package_without_what_slicer_brings():
    tomllib = pytest.importorskip("tomllib")
    package = {
        _distribution(r) for r in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    }
    lines = (RESOURCES / "USSim" / "requirements.txt").read_text().splitlines()
    module = {_distribution(line) for line in lines if line and not line.startswith("#")}
    in_slicer = {"numpy", "vtk", "simpleitk"}
    for_the_command = {"click", "tqdm", "pillow"}
    for_files_that_slicer_reads_itself = {"nibabel", "pynrrd", "highdicom", "python-gdcm"}
    left_out = in_slicer | for_the_command | for_files_that_slicer_reads_itself
    assert module == {entry for entry in package if entry[0] not in left_out}


def _distribution(requirement: str) -> tuple[str, str]:
    name, rest = re.match(r"([\w-]+)(.*)", requirement).groups()
    return name.lower(), rest.replace("'", '"').replace(" ", "")


def test_sample_data_is_registered_with_a_checksum_and_a_thumbnail(module, monkeypatch):
    samples = []

    class Logic:
        @staticmethod
        def registerCustomSampleDataSource(**options):
            samples.append(options)

    stand_in = type(sys)("SampleData")
    stand_in.SampleDataLogic, stand_in.__file__ = Logic, "/Slicer/SampleData.py"
    monkeypatch.setitem(sys.modules, "SampleData", stand_in)
    module.registerSampleData()
    head, registered = samples
    assert head["thumbnailFileName"] == "/Slicer/Resources/Icons/MRHead.png"
    assert head["uris"].endswith(head["checksums"].split(":")[1]) and head["fileNames"] == "MRHead.nrrd"
    assert Path(registered["thumbnailFileName"]).exists()
    assert re.fullmatch(r"SHA256:[0-9a-f]{64}", registered["checksums"])
    assert registered["uris"].startswith("https://") and registered["fileNames"].endswith(".nii.gz")


def test_slicer_and_module_read_what_the_other_wrote_in_the_parameter_node(session):
    parameters, typed = session.parameters, session.widget.logic.getParameterNode()
    declared = session.logic_module("mrml.parameter_node")
    values = {name: entry for name, entry in declared.VALUE_PARAMETERS.items() if not entry.can_be_none}
    assert set(typed.allParameters) == {*declared.NODE_PARAMETERS, *values} and len(values) > 10
    hints = typing.get_type_hints(session.module.USSimParameterNode, include_extras=True)
    for name, entry in values.items():
        assert getattr(typed, name) == getattr(parameters, name) == entry.default, name
        kind, *notes = typing.get_args(hints[name]) or (hints[name],)
        assert kind is entry.type, name
        if entry.choices:
            assert notes[0].choices == list(entry.choices)
        elif entry.bounds:
            assert (notes[0].minimum, notes[0].maximum) == entry.bounds
    for name, classes in declared.NODE_PARAMETERS.items():
        assert all(issubclass(getattr(slicer, kind), hints[name]) for kind in classes), name
    typed.contrast, typed.fit_evaluations, typed.show_in_slice = "flair", 70, False
    assert (parameters.contrast, parameters.fit.evaluations, parameters.show_in_slice) == ("flair", 70, False)
    assert session.ui.contrastComboBox.currentText() == "flair" and not session.ui.showInSliceCheckBox.isChecked()
    parameters.filter_radius, parameters.real = 4, session.head()
    assert typed.filter_radius == 4 and typed.real is parameters.real


# ---- the widgets -----------------------------------------------------------------------------------------------------


def shown_parameters() -> dict[str, object]:
    """{name: declaration} of what panels show of preset and scene."""
    presets = importlib.import_module("SlicerUSSim.Logic.imaging.preset").preset_parameters()
    scene = importlib.import_module("SlicerUSSim.Logic.mrml.parameter_node").VALUE_PARAMETERS
    known = {**presets, **{f"scene.{name}": entry for name, entry in scene.items()}}
    return {name: entry for name, entry in known.items() if entry.shown}


def controls_of(session) -> dict[str, tuple]:
    """{name of a value: (its control, its widget)}"""
    return {control.value: (control, widget) for control, widget in session.panel._controls if control.value}


def test_every_shown_parameter_is_in_the_panel_with_tip_unit_and_range(session):
    controls, shown = controls_of(session), shown_parameters()
    assert set(controls) == set(shown) and len(shown) > 30
    for control, widget in session.panel._controls:
        assert len(widget.toolTip()) > 10, control.name
    for name, entry in shown.items():
        widget = controls[name][1]
        assert entry.tip in widget.toolTip(), name
        if entry.type is bool:
            assert widget.text() == entry.label
        elif entry.shown is not True:
            assert (widget.property("minimum"), widget.property("maximum")) == (entry.shown.low, entry.shown.high), name
            assert widget.property("singleStep") == pytest.approx(entry.shown.step)
            assert widget.property("suffix").strip() == entry.unit
            assert f"{entry.shown.low:g} to {entry.shown.high:g}{widget.property('suffix')}" in widget.toolTip()
        elif entry.choices:
            assert [widget.itemText(n) for n in range(widget.count())] == list(entry.choices)


def test_every_node_selector_has_the_scene_and_the_classes_of_its_role(session):
    selectors = [(control, widget) for control, widget in session.panel._controls if control.kind == "node"]
    roles = importlib.import_module("SlicerUSSim.Logic.mrml.parameter_node").NODE_PARAMETERS
    assert set(roles) - {control.node for control, _ in selectors} == {"seed", "outline", "image_sequence"}
    for control, widget in selectors:
        assert widget.property("nodeTypes") == list(roles[control.node]) and widget._scene is session.scene
        assert widget.property("addEnabled") == bool(control.new_node)


def test_whole_numbers_and_ticks_of_widgets_reach_the_declared_types(session):
    session.ui.scanLinesSpinBox.setValue(64)
    session.ui.seedSpinBox.setValue(4_000_000_000.0)
    session.ui.classesSpinBox.setValue(4)
    session.ui.reflectionsCheckBox.click()
    session.ui.noiseSlider.setValue(-150.0)
    preset = session.logic.preset
    assert preset.probe.scan_lines == 64 and type(preset.probe.scan_lines) is int
    assert preset.settings.seed == 999_999  # the most that the panel offers
    assert session.parameters.classes == 4 and preset.settings.reflections is False and preset.display.noise_db is None
    session.logic.preset = preset.changed("settings", seed=4_000_000_000)
    session.panel.refresh()
    assert session.ui.seedSpinBox.property("value") == 4_000_000_000 and not session.app.errors


def test_a_moved_slider_reads_no_other_values(session, monkeypatch):
    """Nor node lists, tissues and what can be done."""
    session.ui.gainSlider.setValue(1.0)
    presenter, read = session.panel.presenter, []
    value = presenter.values.value
    monkeypatch.setattr(presenter.values, "value", lambda name: (read.append(name), value(name))[1])
    for part, name in ((presenter.tissues, "rows"), (session.panel, "_offer_fitting")):
        monkeypatch.setattr(part, name, lambda *_: 1 / 0)
    session.ui.gainSlider.setValue(7.0)
    assert session.logic.preset.display.gain_db == 7.0 and set(read) == {"display.gain_db"}
    read.clear()
    session.logic.preset = session.logic.preset.changed("display", gain_db=2.0)  # as by a script
    assert session.ui.gainSlider.property("value") == 2.0 and set(read) == {"display.gain_db"}


def test_the_tissue_table_follows_which_sheets_are_drawn(session):
    from SlicerUSSim.Logic.mrml.sheet_nodes import write_sheets
    from SlicerUSSim.Logic.tissue import Surfels

    session.segmented()
    sheets = session.add("Model", "sheets")
    write_sheets(sheets, Surfels.of("falx", np.zeros((4, 3)), np.eye(3)[[0, 1, 2, 0]], 0.5, 0.7, 0.8), sheets)
    session.parameters.sheets = sheets
    session.process()
    table = session.ui.tissueTable

    def names():
        return [
            table.item(row, 0).text() for row in range(table.rowCount() if callable(table.rowCount) else table.rowCount)
        ]

    assert "falx" in names()
    session.parameters.sheet_falx = False
    assert "falx" not in names()
    session.parameters.sheet_falx = True
    assert "falx" in names()


def test_a_wrong_value_in_a_scene_is_shown_and_can_be_mended(session):
    session.parameters.mri = session.head()
    session.parameters.node.SetParameter("contrast", "T3")
    assert session.ui.contrastComboBox.currentText() == "t1"
    session.ui.segmentButton.click()
    assert session.app.errors == ["scene: contrast is 'T3', expected one of t1, t1gd, t2, flair, ct"]
    session.ui.contrastComboBox.setCurrentText("t2")
    assert session.parameters.segmentation.contrast == "t2"


# ---- working with it -------------------------------------------------------------------------------------------------


def test_the_first_image_takes_a_volume_and_two_clicks(session):
    session.parameters.mri = None
    assert not session.ui.segmentButton.isEnabled() and not session.ui.liveCheckBox.isEnabled()
    session.segmented()
    labels = session.parameters.labels
    assert labels.GetName() == "Head tissues" and labels.GetSegmentation().GetNumberOfSegments() == 3
    assert session.ui.labelsSelector.currentNode() is labels
    session.ui.sliceViewComboBox.setCurrentText("Yellow")
    session.ui.liveCheckBox.setChecked(True)
    assert session.logic.isLive and not session.app.errors
    assert session.image().mean() > 5
    assert session.parameters.output.GetParentTransformNode() is session.parameters.probe_transform
    assert session.parameters.outline.GetPolyData().GetNumberOfPoints() > 50
    assert session.parameters.probe_transform.GetDisplayNode().GetEditorVisibility()
    # The slice view stands in the plane of the probe.
    view = session.panel.sliceNode()
    assert view.GetLayoutName() == "Yellow"
    pose = session.logic_module("mrml.nodes").node_to_world(session.parameters.probe_transform)
    matrix = np.array(view.GetSliceToRAS().GetData()).reshape(4, 4)
    np.testing.assert_allclose(matrix[:3, 0], pose[:3, 0], atol=1e-9)
    np.testing.assert_allclose(matrix[:3, 1], -pose[:3, 1], atol=1e-9)
    np.testing.assert_allclose((np.linalg.inv(pose) @ matrix)[2, 3], 0, atol=1e-9)
    composites = [session.scene.GetNthNodeByClass(n, "vtkMRMLSliceCompositeNode") for n in range(2)]
    ids = {c.GetLayoutName(): c.GetForegroundVolumeID() for c in composites}
    assert ids["Yellow"] == session.parameters.output.GetID() and ids["Red"] is None
    session.ui.showInSliceCheckBox.setChecked(False)
    assert session.parameters.show_in_slice is False and session.panel.presenter.images._slice_node() is None


def test_the_image_follows_the_probe_and_the_controls_from_the_event_loop(session):
    session.segmented()
    session.ui.liveCheckBox.setChecked(True)
    images = [session.image()]
    for name, change in {
        "probe": lambda: [session.move(0.1) for _ in range(50)],
        "gain": lambda: session.ui.gainSlider.setValue(12.0),
        "kind": lambda: session.ui.kindComboBox.setCurrentText("convex"),
        "tissue": lambda: session.ui.tissueTable.item(3, 4).setText("0.9"),
    }.items():
        change()
        assert (session.image().shape == images[-1].shape) and (session.image() == images[-1]).all(), "not yet"
        session.process()
        now = session.image()
        assert now.shape != images[-1].shape or (now != images[-1]).mean() > 0.02, name
        images.append(now)
    assert not session.app.errors
    session.ui.liveCheckBox.setChecked(False)
    session.move(3)
    session.process()
    assert (session.image() == images[-1]).all() and not session.logic.isLive


def test_tissues_are_edited_taken_from_presets_and_reset(session):
    table, ui = session.segmented().ui.tissueTable, session.ui
    names = [table.item(line, 0).text() for line in range(table.rowCount())]
    assert names == ["coupling", "csf", "grey matter", "white matter", "leptomeninges"]
    before = table.item(1, 1).text()
    for text, message in (
        ("fast", "'fast', expected a number"),
        ("-3", "speed_of_sound_m_s is -3.0, expected a number between 100 and 10000"),
    ):
        table.item(1, 1).setText(text)
        assert message in session.app.errors.pop() and table.item(1, 1).text() == before
    assert not session.app.errors
    line = names.index("grey matter")
    table.setCurrentCell(line, 0)
    ui.tissuePresetComboBox.setCurrentText("liver")
    ui.assignTissueButton.click()
    assert table.item(line, 0).text() == "grey matter" and table.item(line, 1).text() == "1578"
    assert "Szabo" in table.item(line, 1).toolTip()
    table.item(line, 4).setText("0,5")  # a comma is a point
    assert session.logic.preset.tissues.for_names(["grey matter"])[1].mu0 == 0.5
    assert table.item(line, 4).toolTip() == "set manually"
    ui.resetTissuesButton.click()
    assert table.item(line, 1).text() == "1541"
    # One that the preset does not have
    session.parameters.labels.GetSegmentation().GetNthSegment(1).SetName("My Tumor")
    session.panel.refresh()
    names = [table.item(line, 0).text() for line in range(table.rowCount())]
    table.item(names.index("tumour"), 4).setText("0.77")
    assert not session.app.errors
    tissues = session.logic.tissues(session.parameters.labels)
    assert [tissue.mu0 for tissue in tissues.values() if tissue.name == "tumour"] == [0.77]


def test_presets_go_through_files_of_the_command(session, tmp_path, monkeypatch):
    import qt

    file = str(tmp_path / "mine.json")
    session.ui.probePresetComboBox.setCurrentText("abdominal")
    session.ui.gainSlider.setValue(7.5)
    monkeypatch.setattr(qt.QFileDialog, "getSaveFileName", staticmethod(lambda *_: (file, "")))
    session.ui.savePresetButton.click()
    saved = json.loads(Path(file).read_text())
    assert saved["probe"]["radius_mm"] == 60.0 and saved["display"]["gain_db"] == 7.5
    session.ui.gainSlider.setValue(0.0)
    session.ui.probePresetComboBox.setCurrentText("linear")
    assert session.ui.widthSpinBox.isEnabled() and not session.ui.radiusSpinBox.isEnabled()
    monkeypatch.setattr(qt.QFileDialog, "getOpenFileName", staticmethod(lambda *_: file))
    session.ui.loadPresetButton.click()
    assert session.ui.gainSlider.property("value") == 7.5 and session.ui.radiusSpinBox.value() == 60.0
    assert session.ui.probePresetComboBox.currentText() == "abdominal"
    Path(file).write_text('{"display": {"gain": 3}}')
    session.ui.loadPresetButton.click()
    assert session.app.errors and "mine.json: display: 'gain' is unknown" in session.app.errors[0]
    assert session.ui.gainSlider.property("value") == 7.5
    monkeypatch.setattr(qt.QFileDialog, "getSaveFileName", staticmethod(lambda *_: "/nowhere/x.json"))
    session.ui.savePresetButton.click()
    assert "/nowhere/x.json: the folder /nowhere does not exist" in session.app.errors[1]


def test_cancel_stops_the_segmentation_and_leaves_nothing(session):
    session.parameters.mri = session.head()
    shown = []

    def press_cancel():
        shown.append(session.ui.progressWidget.isVisibleTo(session.parent))
        shown.append(session.ui.segmentButton.isEnabled())
        session.ui.cancelButton.click()

    stand_in.QtCore.QTimer.singleShot(0, press_cancel)
    session.ui.segmentButton.click()
    assert shown == [True, False]
    assert session.parameters.labels is None and session.scene.GetNumberOfNodesByClass("vtkMRMLSegmentationNode") == 0
    assert not session.app.errors  # the user knows
    assert session.ui.segmentButton.isEnabled() and not session.ui.progressWidget.isVisibleTo(session.parent)


@pytest.mark.long  # the extraction of a brain
@needs_shared
def test_the_brain_of_a_whole_head_is_a_mask_node_and_can_be_cancelled(session):
    """ReMIND-022's T1 with the skull, at 4 mm (../shared/data)."""
    volume = session.logic_module("base.volume").Volume
    whole = volume.read(SHARED / "remind022" / "t1_contrast.nii.gz")
    coarse = volume(np.ascontiguousarray(whole.array[::4, ::4, ::4]), whole.ijk_to_ras @ np.diag([4.0, 4.0, 4.0, 1.0]))
    node = session.add("ScalarVolume", "Whole")
    session.logic_module("mrml.nodes").write_volume(node, coarse)
    session.parameters.mri = node
    stand_in.QtCore.QTimer.singleShot(500, session.ui.cancelButton.click)
    session.ui.segmentButton.click()
    assert session.parameters.labels is None and session.parameters.mask is None and not session.app.errors
    assert session.scene.GetNumberOfNodesByClass("vtkMRMLLabelMapVolumeNode") == 0
    session.ui.segmentButton.click()
    assert not session.app.errors
    brain = session.parameters.mask
    assert brain.GetName() == "Whole brain" and "whole head: brain extracted" in session.ui.notesLabel.text()
    inside = session.logic_module("mrml.nodes").read_volume(brain).array > 0
    assert 1000 < inside.sum() * 0.064 < 1700


def test_errors_of_every_button_are_one_line(session):
    session.parameters.mri = session.add("ScalarVolume", "hollow")
    session.ui.segmentButton.click()
    assert session.app.errors == ["MRI Volume 'hollow' has no image data"]
    assert session.parameters.labels is None
    session.parameters.labels = session.add("Segmentation", "empty")
    session.ui.liveCheckBox.setChecked(True)
    assert "'empty' is empty" in session.app.errors[1] and not session.ui.liveCheckBox.isChecked()
    session.ui.simulateButton.click()
    session.ui.placeButton.click()
    assert len(session.app.errors) == 4 and not any("\n" in message for message in session.app.errors)
    session.ui.simulateSequenceButton.click()
    assert "no sequence of transforms chosen" in session.app.errors[4]


def test_a_sequence_is_simulated_and_its_browser_plays_it(session):
    session.segmented()
    session.ui.placeButton.click()
    transforms = session.add("Sequence", "sweep")
    nodes = importlib.import_module("SlicerUSSim.Logic.mrml.nodes")
    pose = nodes.node_to_world(session.parameters.probe_transform)
    for number in range(3):
        item = slicer.vtkMRMLLinearTransformNode()
        nodes.set_node_to_world(item, pose)
        transforms.SetDataNodeAtValue(item, str(number))
    browser = session.add("SequenceBrowser", "browser")
    browser.SetAndObserveMasterSequenceNodeID(transforms.GetID())
    session.ui.transformSequenceSelector.setCurrentNode(transforms)
    session.ui.simulateSequenceButton.click()
    assert not session.app.errors
    images = session.scene.GetFirstNodeByName("sweep ultrasound")
    assert images.GetNumberOfDataNodes() == 3 and browser.IsSynchronizedSequenceNode(images, True)
    assert session.ui.sequenceLabel.text() == "3 images in 'sweep ultrasound'"
    # It is shown, as bright as live images are.
    shown, composite = browser.GetProxyNode(images), session.scene.GetFirstNodeByClass("vtkMRMLSliceCompositeNode")
    display = shown.GetDisplayNode()
    assert (display.GetWindow(), display.GetLevel(), display.GetAutoWindowLevel()) == (255, 127.5, 0)
    assert composite.GetForegroundVolumeID() == shown.GetID()
    # The next ones take their place; of other transforms they are others.
    session.ui.simulateSequenceButton.click()
    assert session.parameters.image_sequence is images and not session.app.errors
    other = session.add("Sequence", "other sweep")
    other.SetDataNodeAtValue(item, "0")
    session.ui.transformSequenceSelector.setCurrentNode(other)
    session.ui.simulateSequenceButton.click()
    assert not session.app.errors and images.GetNumberOfDataNodes() == 3
    assert session.parameters.image_sequence.GetName() == "other sweep ultrasound"
    # One that fails leaves no node behind.
    scaled = session.add("Sequence", "scaled")
    item.SetMatrixTransformToParent(session.logic_module("base.vtk_data").vtk_matrix(np.diag([2.0, 1, 1, 1])))
    scaled.SetDataNodeAtValue(item, "0")
    session.ui.transformSequenceSelector.setCurrentNode(scaled)
    count = session.scene.GetNumberOfNodesByClass("vtkMRMLSequenceNode")
    session.ui.simulateSequenceButton.click()
    assert "item 0 of Sequence 'scaled' is not rigid" in session.app.errors[0]
    assert session.scene.GetNumberOfNodesByClass("vtkMRMLSequenceNode") == count


def test_choosing_other_nodes_while_live_continues_with_those(session):
    session.segmented()
    session.ui.liveCheckBox.setChecked(True)
    first = session.parameters.output
    other = session.add("ScalarVolume", "other")
    session.ui.outputSelector.setCurrentNode(other)
    session.process()
    assert session.logic.isLive and session.parameters.output is other
    assert (slicer.util.arrayFromVolume(other) == slicer.util.arrayFromVolume(first)).all()
    session.scene.RemoveNode(session.parameters.probe_transform)
    session.process()
    assert not session.logic.isLive and not session.ui.liveCheckBox.isChecked()


# ---- fit to real ultrasound ------------------------------------------------------------------------------------------


def with_real_image(session, gain_db: float = 9.0):
    """A "real" image of the segmented head: brighter than simulated, other speckle, in a separate volume."""
    session.segmented()
    session.ui.simulateButton.click()
    preset = session.logic.preset
    session.logic.preset = preset.changed("display", gain_db=gain_db).changed("settings", seed=77)
    session.ui.simulateButton.click()
    real = session.add("ScalarVolume", "Real")
    module = session.logic_module("mrml.nodes")
    shown = module.read_volume(session.parameters.output)
    volume = session.logic_module("base.volume").Volume
    place = module.node_to_world(session.parameters.output) @ shown.ijk_to_ras
    module.write_volume(real, volume(shown.array.copy(), place))
    session.logic.preset = preset
    session.parameters.real = real
    session.ui.fitEvaluationsSpinBox.setValue(100)
    for n in range(session.ui.freeList.count()):
        item = session.ui.freeList.item(n)
        item.setCheckState(stand_in.QtCore.Qt.Checked if item.text() == "Gain" else stand_in.QtCore.Qt.Unchecked)
    return session


@pytest.mark.slow
def test_the_panel_fits_compares_applies_and_reverts(session):
    assert not session.ui.fitButton.isEnabled() and "Segment" in session.ui.fitButton.toolTip()
    with_real_image(session)
    ui = session.ui
    assert session.parameters.fit_free == "gain_db" and session.parameters.fit_evaluations == 100
    assert ui.fitButton.isEnabled() and not ui.applyFitButton.isEnabled()
    before = session.logic.preset
    ui.fitButton.click()
    assert not session.app.errors
    assert "cost" in ui.fitLabel.text() and "Gain: 0 → " in ui.fitLabel.text()
    assert session.logic.preset == before  # until Apply
    # What can be compared lies in the scene, and the slice view shows it before the real image.
    composite = session.scene.GetFirstNodeByClass("vtkMRMLSliceCompositeNode")
    shown = session.scene.GetNodeByID(composite.GetForegroundVolumeID())
    behind = session.scene.GetNodeByID(composite.GetBackgroundVolumeID())
    assert (shown.GetName(), behind.GetName()) == ("Fit: after", "Fit: real")
    after, real = (slicer.util.arrayFromVolume(node).astype(int) for node in (shown, behind))
    assert abs(after.mean() - real.mean()) < 3
    ui.compareComboBox.setCurrentText("before")
    assert session.scene.GetNodeByID(composite.GetForegroundVolumeID()).GetName() == "Fit: before"
    composite.SetForegroundOpacity(1.0)
    session.panel.presenter.fits.blink()
    assert composite.GetForegroundOpacity() == 0.0
    ui.applyFitButton.click()
    assert session.logic.preset.display.gain_db == pytest.approx(9.0, abs=1.5)
    assert ui.gainSlider.property("value") == pytest.approx(session.logic.preset.display.gain_db, abs=0.25)
    assert ui.revertFitButton.isEnabled() and not ui.applyFitButton.isEnabled()
    ui.revertFitButton.click()
    assert session.logic.preset == before and ui.applyFitButton.isEnabled()
    ui.compareNumberComboBox.setCurrentText("0")
    assert not session.app.errors


def test_a_cancelled_fit_changes_nothing_and_errors_are_one_line(session):
    with_real_image(session)
    before = session.logic.preset
    stand_in.QtCore.QTimer.singleShot(0, session.ui.cancelButton.click)
    session.ui.fitButton.click()
    assert session.logic.preset == before and not session.app.errors
    assert session.ui.fitLabel.text() == "" and session.ui.fitButton.isEnabled()
    session.panel.presenter.fits.setFree("gain_db", False)
    session.ui.fitButton.click()
    assert session.app.errors == ["no parameter is free; tick at least one"]
    session.panel.presenter.fits.setFree("noise_db", True)
    assert session.parameters.fit_free == "noise_db"
    images = session.add("Sequence", "images")
    images.SetDataNodeAtValue(session.parameters.real, "0")
    session.parameters.real = images
    session.ui.fitFramesLineEdit.setText("first")
    session.ui.fitFramesLineEdit.editingFinished.emit()
    session.ui.fitButton.click()
    assert "frames are 'first', expected numbers such as 0,5,10" in session.app.errors[1]
    session.panel.presenter.fits.apply()
    session.panel.presenter.fits.revert()
    session.panel.presenter.fits.compare("after", 0)
    assert len(session.app.errors) == 5 and not any("\n" in message for message in session.app.errors)


def test_closing_the_scene_and_leaving_the_module_is_survived(session):
    session.segmented()
    session.ui.liveCheckBox.setChecked(True)
    session.widget.exit()
    session.ui.mriSelector.setCurrentNode(None)  # as selectors do while a scene is closed
    session.move(1)
    session.process()
    assert session.logic.isLive and session.parameters.mri is not None  # in another module the image still follows
    session.widget.enter()
    assert session.ui.mriSelector.currentNode() is session.parameters.mri
    session.scene.Clear(0)
    session.process()
    assert not session.logic.isLive and session.parameters.labels is None
    session.head()
    session.widget.enter()
    session.ui.segmentButton.click()
    assert not session.app.errors
    assert session.parameters.labels is not None


def test_visits_of_the_module_leave_no_observers_behind(session):
    """The typed node of each visit went on reading all values: after 20 visits a change took 8 times as long."""
    for _ in range(3):
        session.widget.exit()
        session.widget.enter()
    gc.collect()
    assert not [entry for entry in gc.get_objects() if type(entry) is session.module.USSimParameterNode]


def test_closing_a_scene_does_not_redraw_the_panel_for_each_node(session, monkeypatch):
    """A scene of 300 models took 12 s to close, now 0.1 s."""
    for number in range(30):
        session.add("Model", f"{number}")
    session.process()
    redrawn, refresh = [], session.panel.refresh
    monkeypatch.setattr(session.panel, "refresh", lambda *changed: (redrawn.append(changed), refresh(*changed)))
    session.scene.Clear(0)
    assert 0 < len(redrawn) < 10


def test_closing_the_scene_forgets_the_patient(session):
    """Nodes of the next scene have the IDs of earlier ones: a fit to patient A set the gain of patient B."""
    with_real_image(session)
    ui = session.ui
    ui.fitButton.click()
    session.parameters.labels, fitted = None, session.parameters.labels
    assert not ui.applyFitButton.isEnabled() and "Head tissues" in ui.applyFitButton.toolTip()  # two in one scene
    session.parameters.labels = fitted
    ui.liveCheckBox.setChecked(True)
    ui.liveCheckBox.setChecked(False)
    assert ui.applyFitButton.isEnabled() and "Head" in ui.notesLabel.text() and "FROZEN" in ui.statusLabel.text()
    session.scene.Clear(0)
    session.process()
    assert not ui.notesLabel.text() and not ui.fitLabel.text() and not ui.statusLabel.text()
    assert session.logic.taken is None and not session.logic.notes
    session.head()
    session.widget.enter()
    session.process()
    for button in (ui.applyFitButton, ui.revertFitButton, ui.undoSegmentButton, ui.pickSeedButton):
        assert not button.isEnabled(), button.objectName()
    session.panel.presenter.fits.apply()
    assert session.app.errors == ["Fit to real images first"] and session.logic.preset.display.gain_db == 0.0


def test_a_volume_that_is_loaded_is_the_mri_if_none_is(session):
    head = session.head()
    session.process()
    assert session.parameters.mri is head and session.ui.mriSelector.currentNode() is head
    session.head()
    session.process()
    assert session.parameters.mri is head


def test_reloading_the_module_brings_new_code(module):
    scene_before = sys.modules.get("SlicerUSSim.Logic.mrml.logic") or importlib.import_module(
        "SlicerUSSim.Logic.mrml.logic"
    )
    again = load_source_as_module("USSim", MODULE_FILE)
    try:
        assert importlib.import_module("SlicerUSSim.Logic.mrml.logic") is not scene_before
        assert again.USSimLogic is not module.USSimLogic
    finally:
        module.__dict__.update(again.__dict__ | {"app": module.app})


def test_a_plan_is_shown_as_pictures_to_press(session):
    session.segmented()
    nodes, pathology = session.logic_module("mrml.label_nodes"), session.logic_module("mri.pathology")
    node = session.parameters.labels
    found = nodes.read_labels(node, session.logic.preset.tissues)
    k, j, i = np.indices(found.labels.array.shape)
    middle = np.argwhere(found.labels.array > 0).mean(axis=0)
    ball = found.labels.with_array((np.linalg.norm(np.stack([k, j, i], -1) - middle, axis=-1) < 3.0).astype(np.uint8))
    added = pathology.add_tissue(found.labels, found.names, ball, "tumour")
    nodes.write_labels(node, added.labels, added.tissue_names, node)
    assert not session.ui.candidate1Picture.isEnabled()
    session.ui.planButton.click()
    session.process()
    pictures = [session.ui.candidate1Picture, session.ui.candidate2Picture, session.ui.candidate3Picture]
    assert all(picture.isEnabled() and not picture.icon().isNull() for picture in pictures)
    assert session.ui.approachNotesLabel.text().startswith("tumour: ")
    pictures[1].click()
    assert "Candidate 2: " in session.ui.approachNotesLabel.text()
    assert session.parameters.probe_transform is None
    session.ui.openHereButton.click()
    probe: typing.Any = session.parameters.probe_transform
    inward = probe.GetMatrixTransformToParent()
    way = (found.labels.ijk_to_ras @ [*middle[::-1], 1.0])[:3] - [inward.GetElement(row, 3) for row in range(3)]
    axis = [inward.GetElement(row, 1) for row in range(3)]
    assert axis @ way == pytest.approx(np.linalg.norm(way), abs=1.0)


def test_what_a_first_image_needs_is_one_screen_of_440_pixels(session):
    session.segmented()
    session.ui.liveCheckBox.setChecked(True)
    session.parent.show()
    session.process()
    session.panel.refresh()  # results take as many lines as they need in this width
    session.parent.resize(440, session.parent.sizeHint().height())
    session.process()
    sections = session.parent.findChildren(stand_in.CollapsibleButton)
    opened = [section for section in sections if not section.property("collapsed")]
    assert [section.property("text") for section in opened] == ["Patient", "Probe", "Ultrasound"]
    last = opened[-1]
    assert last.y() + last.height() <= 700 and session.parent.width() == 440 and len(session.panel._controls) < 124
    for section in sections:
        section.setCollapsed(False)
    session.process()
    kinds = stand_in.QtWidgets.QAbstractButton | stand_in.SliderWidget | stand_in.NodeComboBox
    for widget in vars(session.ui).values():
        if isinstance(widget, kinds) and widget.objectName() != "cancelButton":
            assert widget.isVisible() and widget.width() >= widget.minimumSizeHint().width(), widget.objectName()
    table = session.ui.tissueTable
    assert table.horizontalHeader().length() <= table.viewport().width() and not session.app.errors
    if folder := os.environ.get("USSIM_PICTURES"):
        for section in sections:
            section.setCollapsed(section not in opened)
        brain = session.add("ScalarVolume", "MNI152")
        session.logic_module("mrml.nodes").write_volume(brain, session.logic_module("mri.samples").demo_mri()[0])
        session.parameters.mri = brain
        session.ui.probePresetComboBox.setCurrentText("convex")
        session.ui.gainSlider.setValue(6)
        session.ui.segmentButton.click()
        session.ui.liveCheckBox.setChecked(True)
        session.process()
        session.parent.resize(440, session.parent.sizeHint().height())
        session.process()
        session.parent.grab().toImage().save(str(Path(folder) / "slicer-panel.png"))


def test_a_tracked_probe_is_set_up_in_its_section(session):
    tracked, calibration = (session.add("LinearTransform", name) for name in ("ProbeToReference", "ImageToProbe"))
    vtk_matrix = session.logic_module("base.vtk_data").vtk_matrix
    calibration.SetMatrixTransformToParent(vtk_matrix(np.diag([0.2, 0.2, 0.2, 1])))
    session.ui.trackedSelector.setCurrentNode(tracked)
    session.ui.calibrationSelector.setCurrentNode(calibration)
    session.ui.facePixelLineEdit.setText("310 15")
    session.ui.facePixelLineEdit.editingFinished.emit()
    session.ui.useCalibrationButton.click()
    session.process()
    assert "pixels of 0.2 x 0.2 mm; face at column 310.0, row 15.0 (as given)" in session.ui.trackedLabel.text()
    assert session.parameters.probe_transform.GetParentTransformNode() is tracked and not session.app.errors
    session.ui.sendImagesButton.click()
    assert "no image yet" in session.app.errors.pop()
    if folder := os.environ.get("USSIM_PICTURES"):
        for section in session.parent.findChildren(stand_in.CollapsibleButton):
            section.setCollapsed(section.property("text") != "Tracked ultrasound")
        session.parent.show()
        session.parent.resize(440, 360)
        session.process()
        session.parent.grab().toImage().save(str(Path(folder) / "slicer-tracked.png"))


def test_image_and_probe_are_in_the_3d_views_until_switched_off(session):
    session.segmented()
    session.ui.simulateButton.click()
    view = session.panel.sliceNode()
    probe = session.scene.GetFirstNodeByName("Ultrasound probe")
    assert view.GetSliceVisible() and probe.GetDisplayNode().GetVisibility()
    assert probe.GetParentTransformNode() is session.parameters.probe_transform
    width = probe.GetPolyData().GetBounds()[1]
    session.ui.probePresetComboBox.setCurrentText("abdominal")
    session.ui.simulateButton.click()
    assert probe.GetPolyData().GetBounds()[1] > width
    session.ui.sliceViewComboBox.setCurrentText("Yellow")
    assert not view.GetSliceVisible() and session.panel.sliceNode().GetSliceVisible()
    session.ui.showIn3dCheckBox.setChecked(False)
    session.ui.showProbeCheckBox.setChecked(False)
    assert not session.panel.sliceNode().GetSliceVisible() and not probe.GetDisplayNode().GetVisibility()
    assert not session.app.errors


def test_the_layout_for_ultrasound_comes_and_goes_with_the_module(session):
    session.ui.layoutButton.click()  # as without a main window
    views = session.add("Layout", "views")
    views.SetViewArrangement(views.SlicerLayoutFourUpView)
    session.ui.layoutButton.click()
    ours = views.GetViewArrangement()
    assert ours != views.SlicerLayoutFourUpView and "vtkMRMLViewNode" in views.GetLayoutDescription(ours)
    session.ui.layoutButton.click()
    assert views.GetViewArrangement() == views.SlicerLayoutFourUpView
    session.ui.layoutButton.click()
    session.widget.exit()
    assert views.GetViewArrangement() == views.SlicerLayoutFourUpView
    session.widget.enter()
    session.ui.layoutButton.click()
    views.SetViewArrangement(views.SlicerLayoutConventionalView)  # the user's, since
    session.widget.exit()
    assert views.GetViewArrangement() == views.SlicerLayoutConventionalView and not session.app.errors


def test_tissues_are_edited_in_the_segment_editor(session, monkeypatch):
    edited: list = []
    editor = types.SimpleNamespace(setSegmentationNode=edited.append, setSourceVolumeNode=edited.append)
    module = types.SimpleNamespace(widgetRepresentation=lambda: types.SimpleNamespace(self=lambda: holder))
    holder = types.SimpleNamespace(editor=editor)
    monkeypatch.setattr(slicer, "modules", types.SimpleNamespace(segmenteditor=module), raising=False)
    monkeypatch.setattr(slicer.util, "selectModule", edited.append, raising=False)
    assert not session.ui.editTissuesButton.isEnabled()
    session.segmented().ui.editTissuesButton.click()
    assert edited == ["SegmentEditor", session.parameters.labels, session.parameters.mri]


@pytest.fixture
def bare_slicer(module, monkeypatch):
    """A Slicer before 5.11, without pyopencl until pip is asked for it, and with versions of its own."""
    app = module.app
    app.installed, app.questions, app.answer = [], [], True
    versions = {"numpy": "2.0.2", "SimpleITK": "2.5.0", "scipy": "1.14.1"}

    def version(name: str) -> str:
        if name == "pyopencl" and not app.installed:
            raise importlib.metadata.PackageNotFoundError(name)
        return versions.get(name, "9999")

    def distributions():
        odd = [{"Name": None, "Version": None}, {"Name": "handmade", "Version": "today"}]
        shadowed = [{"Name": "Numpy", "Version": "1.0"}]  # further behind on sys.path: not what Python imports
        own = [{"Name": name, "Version": text} for name, text in versions.items()]
        return [types.SimpleNamespace(metadata=entry) for entry in own + shadowed + odd]

    monkeypatch.setattr(importlib.metadata, "version", version)
    monkeypatch.setattr(importlib.metadata, "distributions", distributions)
    monkeypatch.setitem(sys.modules, "slicer.packaging", None)
    return types.SimpleNamespace(app=app, versions=versions, ensure=module.ensurePackages)


def test_packages_are_installed_without_changing_what_slicer_has(bare_slicer):
    bare_slicer.ensure()
    assert bare_slicer.app.installed == ["pyopencl>=2023.1"]
    assert bare_slicer.app.constraints.splitlines() == ["numpy==2.0.2", "scipy==1.14.1", "simpleitk==2.5.0"]
    bare_slicer.ensure()
    assert len(bare_slicer.app.installed) == len(bare_slicer.app.questions) == 1  # all is there


def test_packages_that_are_too_old_or_fail_to_install_are_one_line(bare_slicer, simulation_error, monkeypatch):
    def fail(arguments):
        raise RuntimeError("Collecting pyopencl\nERROR: no space left on device\n")

    monkeypatch.setattr(slicer.util, "pip_install", fail)
    with pytest.raises(simulation_error(), match=r"not installed \(ERROR: no space left on device\)$"):
        bare_slicer.ensure()
    bare_slicer.app.questions.clear()
    bare_slicer.versions["scipy"] = "1.9"  # Slicer's own, which is left alone
    message = r'needs scipy>=1.10, but this Slicer has 1.9, .* slicer.util.pip_install\("scipy>=1.10"\)'
    with pytest.raises(simulation_error(), match=message):
        bare_slicer.ensure()
    assert not bare_slicer.app.installed and not bare_slicer.app.questions


def test_a_slicer_that_has_pip_ensure_is_left_to_it(bare_slicer, simulation_error, monkeypatch):
    asked = []

    def pip_ensure(requirements, constraints=None, requester=None):
        asked.append((requester, list(map(str, requirements)), Path(constraints).read_text()))
        if not bare_slicer.app.testing:  # where it returns and does nothing
            bare_slicer.app.installed.append("pyopencl")

    packaging = type(sys)("slicer.packaging")
    packaging.pip_ensure = pip_ensure
    monkeypatch.setitem(sys.modules, "slicer.packaging", packaging)
    monkeypatch.setattr(bare_slicer.app, "testing", True)
    with pytest.raises(simulation_error(), match=r"not installed \(pyopencl>=2023.1\)"):
        bare_slicer.ensure()
    monkeypatch.setattr(bare_slicer.app, "testing", False)
    bare_slicer.ensure()
    requester, requirements, constraints = asked[-1]
    assert requester == "SlicerUSSim" and requirements == ["pyopencl>=2023.1"] and "numpy==2.0.2" in constraints


@pytest.fixture
def panel_with(module, monkeypatch):
    """The panel on a computer with these devices."""
    sessions = []

    def opened(*devices, **options) -> Session:
        trials = tried(*devices, **options)
        monkeypatch.setattr(importlib.import_module("SlicerUSSim.Widget.device_bar"), "DeviceTrials", trials)
        sessions.append(Session(module))
        return sessions[-1]

    yield opened
    for session in sessions:
        session.close()


@pytest.mark.parametrize(
    ("system", "machine", "offered"),
    [
        ("linux", "x86_64", ["Install Intel's runtime for processors (1000 MB)"]),  # PoCL is installed here
        ("win32", "AMD64", ["Install Intel's runtime for processors (120 MB)"]),
        ("linux", "aarch64", []),
        ("darwin", "arm64", []),
    ],
)
def test_without_a_device_the_panel_says_so_and_offers_a_runtime(panel_with, monkeypatch, system, machine, offered):
    """Untested on Windows: this tests only what is offered."""
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr("platform.machine", lambda: machine)
    monkeypatch.setattr(slicer.app, "installed", [])
    monkeypatch.setitem(sys.modules, "pyopencl", types.ModuleType("pyopencl"))  # loaded without the runtime
    session = panel_with(error="no OpenCL device found; install one")
    bar = session.widget.devices
    assert bar.label.text() == "No OpenCL device found; install one" and not bar.devices.isVisibleTo(session.parent)
    buttons = [button for button in bar.buttons.values() if button.isVisibleTo(session.parent)]
    assert [button.text() for button in buttons] == offered
    for button in buttons:
        button.click()
        assert session.app.errors.pop() == "Intel's runtime is installed; restart Slicer to use it"
        assert session.app.installed[0] == "intel-opencl-rt" and "numpy==" in session.app.constraints
    assert not session.app.errors


def test_the_chosen_device_is_remembered(panel_with, module):
    kind = importlib.import_module("SlicerUSSim.Logic.imaging.device_trials").TriedDevice
    fast, slow = (kind(f"{n}:0", f"device {n}", "any", "GPU", 10.0 + n) for n in range(2))
    broken = kind("2:0", "device 2", "any", "GPU", None, "its runtime ended the process (-6)")
    session = panel_with(fast, broken, slow)
    combo = session.widget.devices.devices
    assert [combo.itemText(n) for n in range(combo.count())] == [
        "10 ms per image: device 0 (any)", "11 ms per image: device 1 (any)",
    ]  # fmt: skip
    assert session.widget.devices.label.text() == "device 2 cannot be used: its runtime ended the process (-6)"
    assert session.logic.device == fast.key
    combo.setCurrentIndex(1)
    assert session.logic.device == slow.key
    again = panel_with(fast, broken, slow)
    assert again.widget.devices.trials.chosen == slow.key
    assert again.widget.devices.trials.known == {fast.key: 10.0, slow.key: 11.0}
    module.app.settings.clear()


def test_the_first_image_says_that_it_waits_for_kernels(panel_with):
    session = panel_with(own_device(), waits=3).segmented()
    shown, bar = [], session.ui.progressBar
    bar.valueChanged.connect(lambda value: shown.append((bar.isVisibleTo(session.parent), bar.format(), value)))
    session.ui.liveCheckBox.setChecked(True)
    assert (True, "Build kernels, once on this computer %p%", 33) in shown and session.logic.isLive
    assert not session.app.errors


@pytest.mark.slow
def test_a_scene_loaded_while_the_panel_is_open_is_shown(session, tmp_path):
    session.segmented()
    session.ui.placeButton.click()
    session.ui.gainSlider.setValue(9.0)
    session.parameters.contrast = "t2"
    session.scene.SetRootDirectory(str(tmp_path))
    session.scene.SetSaveToXMLString(1)
    session.scene.Commit()
    saved = session.scene.GetSceneXMLString()
    session.scene.Clear(0)
    session.process()
    ui = session.ui
    assert ui.labelsSelector.currentNode() is None and ui.gainSlider.property("value") == 0.0
    session.scene.SetLoadFromXMLString(1)
    session.scene.SetSceneXMLString(saved)
    session.scene.Import()
    session.process()
    shown = [ui.mriSelector, ui.labelsSelector, ui.probeTransformSelector]
    assert [s.currentNode() and s.currentNode().GetName() for s in shown] == ["Head", "Head tissues", "Probe"]
    assert ui.gainSlider.property("value") == 9.0 and ui.contrastComboBox.currentText() == "t2"
    assert session.parameters.labels is ui.labelsSelector.currentNode() and not session.app.errors


# ---- nothing of others is taken or overwritten -----------------------------------------------------------------------


def offered(selector) -> list[str]:
    return [selector.itemText(n) for n in range(selector.count())]


@pytest.mark.slow
def test_selectors_offer_only_what_fits(session):
    session.segmented()
    session.ui.simulateButton.click()
    flair = session.add("ScalarVolume", "FLAIR")
    session.logic_module("mrml.nodes").write_volume(flair, session.logic_module("mri.samples").head_mri(6.0))
    surface = session.add("Model", "skin")
    surface.SetAndObservePolyData(session.parameters.outline.GetPolyData())
    for name in ("Red Volume Slice", "Yellow Volume Slice"):
        session.add("Model", name)
    session.add("LinearTransform", "Red Slice Transform")
    session.add("ScalarVolume", "empty")
    session.panel.refresh()
    ui = session.ui
    assert offered(ui.mriSelector) == ["None", "Head", "FLAIR", "empty"]  # no ultrasound
    assert offered(ui.secondMriSelector) == ["None", "FLAIR", "empty"]
    assert offered(ui.realSelector) == ["None", "FLAIR", "empty"]
    assert offered(ui.outputSelector) == ["None", "Ultrasound", "empty"]
    assert offered(ui.sheetsSelector) == ["None"]
    assert offered(ui.probeTransformSelector) == ["None", "Probe"]


@pytest.mark.slow
def test_deleting_the_live_output_takes_no_other_volume(session):
    """Slicer's selector chooses the next node: live images were then written into the FLAIR of the patient."""
    session.segmented()
    session.ui.liveCheckBox.setChecked(True)
    own = session.add("ScalarVolume", "another image of this module")
    session.logic.simulate(session.parameters.labels, session.parameters.probe_transform, own)
    kept = slicer.util.arrayFromVolume(own).copy()
    flair = session.head()
    before = slicer.util.arrayFromVolume(flair).copy()
    session.panel.refresh()
    assert session.logic.isLive and offered(session.ui.outputSelector)[1:] == ["Ultrasound", own.GetName()]
    session.scene.RemoveNode(session.parameters.output)
    session.process()
    assert not session.logic.isLive and not session.ui.liveCheckBox.isChecked()
    assert session.parameters.output is None and session.ui.outputSelector.currentNode() is None
    session.move(5)
    session.process()
    assert (slicer.util.arrayFromVolume(flair) == before).all() and (slicer.util.arrayFromVolume(own) == kept).all()
    assert not session.app.errors
    session.ui.liveCheckBox.setChecked(True)
    assert session.parameters.output not in (None, own, flair)
