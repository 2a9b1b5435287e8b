"""The VTK filters: they execute only when necessary, and their images have the position of the probe."""

from __future__ import annotations

import numpy as np
import pytest
import vtkmodules.vtkRenderingOpenGL2  # noqa: F401, makes rendering work at all
from hypothesis import given, settings, strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkDataObject, vtkImageData, vtkPolyData
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
from vtkmodules.vtkCommonMath import vtkMatrix4x4
from vtkmodules.vtkCommonTransforms import vtkTransform
from vtkmodules.vtkIOXML import vtkXMLImageDataWriter
from vtkmodules.vtkRenderingCore import (
    vtkImageActor,
    vtkImageSlice,
    vtkImageSliceMapper,
    vtkRenderer,
    vtkRenderWindow,
    vtkWindowToImageFilter,
)

from SlicerUSSim.Logic import (
    DisplaySettings,
    LinearProbe,
    Preset,
    SimulationSettings,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    seed_of_pose,
)
from SlicerUSSim.Logic.base.volume import read_image_file
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings
from SlicerUSSim.Logic.mri.sheets.polydata import as_polydata
from SlicerUSSim.Logic.probe.shape import outline_polydata
from SlicerUSSim.Logic.vtk.filters import SegmentationFilter, UltrasoundSimulationFilter
from tests.conftest import FLUID, SPECKLE, block, example, rigid
from tests.remembered import segment_once
from tests.test_drawn_sheets import plane

pytestmark = pytest.mark.usefixtures("segmented_once")

PROBE = LinearProbe(20, 30, scan_lines=48, focus_mm=15)
DISPLAY = DisplaySettings(image_size=(96, 64))
TISSUES = TissueTable({0: FLUID, 1: SPECKLE, 2: FLUID})


def cyst() -> Volume:
    return block(lambda x, y, z: np.where(x**2 + (y - 5) ** 2 + z**2 < 16, 2, 1), (12, 16, 8))


def simulation(labels: Volume | None = None) -> UltrasoundSimulationFilter:
    """A filter in front of a cyst, that counts its executions."""
    result = UltrasoundSimulationFilter()
    result.SetInputData((labels or cyst()).to_vtk())
    result.SetProbe(PROBE)
    result.SetDisplay(DISPLAY)
    result.SetTissues(TISSUES)
    result.SetProbeTransform(vtk_matrix(rigid(np.eye(3), [0, -15, 0])))
    result.executions = 0

    def count(*_):
        result.executions += 1

    result.AddObserver("StartEvent", count)
    return result


def executes(algorithm) -> bool:
    before = algorithm.executions
    algorithm.Update()
    return algorithm.executions > before


def test_the_image_is_the_simulators_at_the_probes_place():
    algorithm = simulation()
    algorithm.Update()
    pose = rigid(np.eye(3), [0, -15, 0])
    frame = UltrasoundSimulator(cyst(), TISSUES).simulate(PROBE, pose, DISPLAY, noise_seed=seed_of_pose(pose))
    volume = Volume.from_vtk(algorithm.GetOutput())
    np.testing.assert_array_equal(volume.array[0], frame.image)
    np.testing.assert_allclose(volume.ijk_to_ras, frame.to_volume().ijk_to_ras, atol=1e-12)
    np.testing.assert_array_equal(algorithm.GetFrame().iq, frame.iq)


def test_it_executes_when_something_changes_and_only_then():
    algorithm = simulation()
    assert executes(algorithm) and not executes(algorithm)
    changes = {
        "probe": lambda: algorithm.SetProbe(LinearProbe(20, 25, scan_lines=48)),
        "display": lambda: algorithm.SetDisplay(DisplaySettings(gain_db=3, image_size=(96, 64))),
        "settings": lambda: algorithm.SetSettings(SimulationSettings(seed=2)),
        "tissues": lambda: algorithm.SetTissues(TISSUES.replace("speckle", mu0=0.5)),
        "transform": lambda: algorithm.SetProbeTransform(vtk_matrix(rigid(np.eye(3), [1, -15, 0]))),
        "labels": lambda: algorithm.SetInputData(cyst().to_vtk()),
    }
    for name, change in changes.items():
        change()
        assert executes(algorithm), name
        if name not in ("transform", "labels"):  # those are other objects each time
            change()
        assert not executes(algorithm), f"{name}, set to what it was"
    image = algorithm.GetInputDataObject(0, 0)
    vtk_to_numpy(image.GetPointData().GetScalars())[:] = 1  # in place
    image.Modified()
    before = image_of(algorithm)
    assert executes(algorithm) and image_of(algorithm).mean() > before.mean()  # the cyst is gone


def test_a_transform_deep_in_a_chain_moves_the_image():
    algorithm = simulation()
    matrix, inner, outer = vtkMatrix4x4(), vtkTransform(), vtkTransform()
    inner.SetInput(outer)
    algorithm.SetProbeTransform(inner)
    assert executes(algorithm)
    outer.Translate(0, -15, 0)
    assert executes(algorithm) and not executes(algorithm)
    assert algorithm.GetOutput().GetOrigin()[1] == pytest.approx(-15 + 30 / 96 / 2)
    algorithm.SetProbeTransform(matrix)
    algorithm.Update()
    matrix.SetElement(1, 3, -10.0)
    assert executes(algorithm) and not executes(algorithm)
    algorithm.SetProbeTransform(matrix)  # the same one again
    assert not executes(algorithm)
    assert algorithm.GetOutput().GetOrigin()[1] == pytest.approx(-10 + 30 / 96 / 2)
    np.testing.assert_allclose(algorithm.GetOutput(1).GetBounds(), (-10, 10, -10, 20, 0, 0), atol=1e-5)  # the outline


@settings(max_examples=10)
@given(
    angles=st.tuples(*[st.floats(-180, 180)] * 3),
    place=st.tuples(*[st.floats(-100, 100)] * 3),
    first=st.tuples(*[st.integers(-5, 5)] * 3),
)
def test_the_information_pass_knows_the_geometry_without_computing(angles, place, first):
    """For any pose, and for labels with any place, direction and first index."""
    pose = rigid(Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), place)
    labels = cyst()
    image = Volume(labels.array, pose @ labels.ijk_to_ras).to_vtk()
    origin, extent = [0.0] * 3, image.GetExtent()
    image.TransformIndexToPhysicalPoint(*(-n for n in first), origin)
    image.SetExtent(*(extent[n] + first[n // 2] for n in range(6)))  # as vtkExtractVOI leaves it
    image.SetOrigin(origin)
    algorithm = simulation()
    algorithm.SetInputData(image)
    algorithm.SetProbeTransform(vtk_matrix(pose @ rigid(np.eye(3), [0, -15, 0])))
    algorithm.UpdateInformation()
    info = algorithm.GetOutputInformation(0)
    assert algorithm.executions == 0
    whole = info.Get(vtkStreamingDemandDrivenPipeline.WHOLE_EXTENT())
    promised = {key: info.Get(getattr(vtkDataObject, key)()) for key in ("SPACING", "ORIGIN", "DIRECTION")}
    algorithm.Update()
    output = algorithm.GetOutput()
    assert whole == output.GetExtent()
    np.testing.assert_allclose(promised["SPACING"], output.GetSpacing(), rtol=1e-9)
    np.testing.assert_allclose(promised["ORIGIN"], output.GetOrigin(), atol=1e-9)
    np.testing.assert_allclose(promised["DIRECTION"], output.GetDirectionMatrix().GetData(), atol=1e-6)
    # The cyst appears at its position, black in the middle of the image, for every pose.
    picture = Volume.from_vtk(output).array[0].astype(float)
    assert picture[58:68, 28:36].mean() < 0.3 * picture[8:24, 10:54].mean()


def test_a_writer_stores_image_and_place(tmp_path):
    algorithm = simulation()
    writer = vtkXMLImageDataWriter()
    writer.SetInputConnection(algorithm.GetOutputPort())
    writer.SetFileName(str(tmp_path / "image.vti"))
    writer.Write()
    read = read_image_file(tmp_path / "image.vti")
    np.testing.assert_array_equal(read.array[0], algorithm.GetFrame().image)
    np.testing.assert_allclose(read.ijk_to_ras, algorithm.GetFrame().to_volume().ijk_to_ras, atol=1e-6)


def test_alpha_is_the_imaged_field():
    algorithm = simulation()
    algorithm.SetProbe(Preset().probe)
    algorithm.SetFieldAlpha(True)
    algorithm.Update()
    both = vtk_to_numpy(algorithm.GetOutput().GetPointData().GetScalars()).reshape(96, 64, 2)
    np.testing.assert_array_equal(both[..., 0], algorithm.GetFrame().image)
    outside = both[..., 1] == 0
    assert 0.2 < outside.mean() < 0.6
    assert np.count_nonzero(algorithm.GetFrame().image[outside]) < 0.01 * outside.sum()  # on the edge


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda f: f.SetInputData(vtkImageData()), "vtkImageData is empty"),
        (lambda f: f.SetProbeTransform(vtk_matrix(np.diag([2.0, 1, 1, 1]))), "probe transform is not rigid"),
        (lambda f: f.SetTissues(TissueTable({1: SPECKLE})), "label 2 has no tissue"),
        (lambda f: f.SetSheetsData(outline_polydata(PROBE)), "sheets: has no array 'place' of its cells"),
    ],
)
def test_what_is_wrong_is_one_error_event_and_no_image(break_it, message):
    algorithm = simulation()
    algorithm.Update()
    heard = []

    def hear(caller, event, text=None):
        heard.append(text)

    hear.CallDataType = "string0"
    algorithm.AddObserver("ErrorEvent", hear)
    algorithm.GetExecutive().AddObserver("ErrorEvent", lambda *_: None)  # VTK's own "a request failed"
    break_it(algorithm)
    algorithm.Update()
    assert len(heard) == 1 and message in heard[0] and "\n" not in heard[0]
    assert algorithm.GetErrorMessage() == heard[0]
    assert algorithm.GetOutput().GetNumberOfPoints() == 0
    # And it recovers.
    mended = simulation()
    algorithm.SetInputData(mended.GetInputDataObject(0, 0))
    algorithm.SetProbeTransform(vtkTransform())
    algorithm.SetTissues(TISSUES)
    algorithm.SetSheetsData(None)
    algorithm.Update()
    assert algorithm.GetErrorMessage() == "" and algorithm.GetOutput().GetNumberOfPoints() == 96 * 64


def image_of(algorithm) -> np.ndarray:
    return Volume.from_vtk(algorithm.GetOutput()).array[0].copy()


def sheets_of() -> vtkPolyData:
    """The falx across the beam, 10 mm deep, as its file has it."""
    return as_polydata(plane("falx", rigid(np.eye(3), [0, -20, 0])))


def test_sheets_of_the_kinds_that_are_chosen_are_drawn():
    algorithm, tissues = simulation(), TissueTable({**TISSUES}, TissueTable.brain(["white matter"]).membrane)
    algorithm.SetTissues(tissues)
    algorithm.Update()
    without = image_of(algorithm)
    surface = sheets_of()
    algorithm.SetSheetsData(surface)
    assert executes(algorithm)
    image = image_of(algorithm)
    surfels = plane("falx", rigid(np.eye(3), [0, -20, 0]))
    pose = rigid(np.eye(3), [0, -15, 0])
    expected = UltrasoundSimulator(cyst(), tissues, sheets=surfels)
    np.testing.assert_array_equal(image, expected.simulate(PROBE, pose, DISPLAY, noise_seed=seed_of_pose(pose)).image)
    assert image[25:40].mean() > without[25:40].mean() + 10  # 10 of 30 mm deep, in 96 rows
    assert not executes(algorithm)
    surface.Initialize()  # in place
    algorithm.Modified()
    algorithm.Update()
    assert "has no array 'place'" in algorithm.GetErrorMessage()


@pytest.mark.slow
def test_segmentation_labels_as_the_function_does_and_names_travel():
    mri = head_mri(3.5)
    segmentation = SegmentationFilter()
    segmentation.SetInputData(mri.to_vtk())
    shares = []
    segmentation.AddObserver("ProgressEvent", lambda caller, _: shares.append(caller.GetProgress()))
    algorithm = UltrasoundSimulationFilter()
    algorithm.SetInputConnection(segmentation.GetOutputPort())
    algorithm.SetProbe(PROBE)
    algorithm.Update()
    expected = segment_once(mri, thin_sulci=True)
    labels = Volume.from_vtk(segmentation.GetOutput())
    np.testing.assert_array_equal(labels.array, expected.labels.array)
    np.testing.assert_allclose(labels.ijk_to_ras, mri.ijk_to_ras, atol=1e-9)
    assert segmentation.GetSegmentation().tissue_names == expected.tissue_names
    assert shares == sorted(shares) and shares[-1] == 1.0
    # With T2, label 1 is white matter; the names, not the numbers, choose the tissues.
    segmentation.SetSettings(SegmentationSettings("t2"))
    algorithm.Update()
    assert segmentation.GetSegmentation().tissue_names[0] == "white matter"
    assert algorithm._simulator._simulator.medium.tissues[1].name == "white matter"


@pytest.mark.slow
def test_segmentation_takes_a_mask_and_can_be_stopped():
    mri = head_mri(4.0)
    mask = mri.with_array((np.indices(mri.array.shape)[2] < mri.array.shape[2] // 2).astype(np.uint8))
    segmentation = SegmentationFilter()
    segmentation.SetInputData(mri.to_vtk())
    segmentation.SetMaskData(mask.to_vtk())
    segmentation.Update()
    labels = Volume.from_vtk(segmentation.GetOutput()).array
    assert labels[mask.array > 0].any() and not labels[mask.array == 0].any()

    segmentation.GetExecutive().AddObserver("ErrorEvent", lambda *_: None)
    stop = segmentation.AddObserver("ProgressEvent", lambda caller, _: caller.SetAbortExecute(1))
    segmentation.SetSettings(SegmentationSettings(classes=3))
    segmentation.Modified()
    segmentation.Update()
    assert segmentation.GetOutput().GetNumberOfPoints() == 0 and segmentation.GetErrorMessage() == ""
    segmentation.RemoveObserver(stop)
    segmentation.SetAbortExecute(0)
    segmentation.Modified()
    segmentation.Update()
    np.testing.assert_array_equal(Volume.from_vtk(segmentation.GetOutput()).array, labels)


@pytest.mark.slow
def test_the_example_shows_mri_outline_and_ultrasound_in_one_window(mni, tmp_path):
    vtk_pipeline = example("vtk_pipeline")
    scene = vtk_pipeline.build(mni[0])
    scene.window.Render()
    vtk_pipeline.write_png(scene.window, str(tmp_path / "window.png"))
    picture = np.asarray(Image.open(tmp_path / "window.png").convert("RGB")).astype(int)
    assert picture.shape == (600, 1200, 3)
    left = picture[:, :600]
    yellow = (left[..., 0] > 150) & (left[..., 1] > 120) & (left[..., 2] < 90)
    assert 800 < yellow.sum() < 6000
    rows, columns = np.nonzero(yellow)
    assert rows.min() < 110 and rows.max() > 480 and columns.min() < 40 and columns.max() > 560  # the whole field
    # Speckle inside the field, the smooth MRI outside it.
    inside, outside = left[300:360, 120:180, 0], left[250:290, 50:80, 0]
    assert inside.std() > 8 and outside.mean() > 120
    # In the plane of the probe a pixel of the window shows the pixel of the frame that is there.
    frame = scene.simulation.GetFrame()
    mm_per_pixel = 150.0 / 600.0
    for column in range(200, 420, 20):
        x, y = (column + 0.5 - 300) * mm_per_pixel, (300.5 - 300) * mm_per_pixel + 50.0
        shown = left[295:306, column - 5 : column + 6, 0].mean()
        to_pixel = np.linalg.inv(frame.image_to_probe)
        at = (to_pixel @ [x, y, 0, 1])[:2].round().astype(int)
        half = round(5 * mm_per_pixel / frame.pixel_spacing_mm[0])
        true = frame.image[at[1] - half : at[1] + half + 1, at[0] - half : at[0] + half + 1].mean()
        assert shown == pytest.approx(true, abs=12), column


def test_an_image_actor_shows_it_where_it_is():
    """vtkImageActor and vtkImageSlice, seen along the elevational axis of a turned probe: the pixels of the frame."""
    pose = rigid(Rotation.from_euler("xyz", [20, -30, 50], degrees=True).as_matrix(), [30, -15, 2])
    algorithm = simulation(Volume(cyst().array, pose @ rigid(np.eye(3), [0, 15, 0]) @ cyst().ijk_to_ras))
    algorithm.SetProbeTransform(vtk_matrix(pose))
    algorithm.Update()
    for actor in (vtkImageActor(), vtkImageSlice()):
        mapper = vtkImageSliceMapper()
        mapper.SetInputConnection(algorithm.GetOutputPort())
        mapper.BorderOn()  # draw the outermost pixels whole
        actor.SetMapper(mapper)
        actor.GetProperty().SetInterpolationTypeToNearest()
        shown = seen_along_z(actor, pose, size=(192, 288))  # nine pixels of the window for one of the image
        np.testing.assert_array_equal(shown[1::3, 1::3], algorithm.GetFrame().image)


def seen_along_z(actor, pose: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(rows, columns) of a window that shows exactly the image plane of PROBE, 20 mm wide and 30 mm deep."""
    renderer, window = vtkRenderer(), vtkRenderWindow()
    renderer.AddViewProp(actor)
    camera = renderer.GetActiveCamera()
    camera.ParallelProjectionOn()
    camera.SetFocalPoint(*(pose @ [0, 15, 0, 1])[:3])
    camera.SetPosition(*(pose @ [0, 15, -100, 1])[:3])
    camera.SetViewUp(*-pose[:3, 1])
    camera.SetParallelScale(15.0)
    camera.SetClippingRange(1, 200)
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(0)
    window.SetSize(*size)
    window.AddRenderer(renderer)
    window.Render()
    grab = vtkWindowToImageFilter()
    grab.SetInput(window)
    grab.Update()
    scalars = grab.GetOutput().GetPointData().GetScalars()
    return vtk_to_numpy(scalars).reshape(size[1], size[0], 3)[::-1, :, 0]


@pytest.mark.slow
def test_another_mri_is_registered_and_classified_with_the_first():
    t1 = head_mri(4.0)
    noise = np.random.default_rng(1).normal(0.0, 4.0, t1.array.shape)
    inverse = np.where(t1.array > 0, 160.0 - t1.array + noise, 0.0).astype(np.float32)
    t2 = Volume(inverse, rigid(np.eye(3), [3.0, -2.0, 1.0]) @ t1.ijk_to_ras)
    algorithm = SegmentationFilter()
    algorithm.SetInputData(t1.to_vtk())
    algorithm.SetOtherData("t2", t2.to_vtk())
    algorithm.Update()
    assert not algorithm.GetErrorMessage() and any(line.startswith("t2: registered") for line in algorithm.GetNotes())
    algorithm.SetOtherData("t2", None)
    algorithm.SetOtherData("t1", t2.to_vtk())
    algorithm.AddObserver("ErrorEvent", lambda *_: None)
    algorithm.Update()
    assert "two volumes of contrast t1" in algorithm.GetErrorMessage()


def test_labels_without_names_are_recognised_or_refused():
    """A lesion's mask was simulated as CSF, SPM's grey matter as CSF."""
    from tests.test_label_maps import head

    def output(labels: Volume) -> UltrasoundSimulationFilter:
        algorithm = UltrasoundSimulationFilter()
        algorithm.SetProbe(PROBE)
        algorithm.SetDisplay(DISPLAY)
        algorithm.SetInputData(labels.to_vtk())
        return algorithm

    mask = np.zeros((40, 40, 40), np.uint8)
    mask[15:25, 15:25, 15:25] = 1
    algorithm = output(Volume(mask, np.eye(4)))
    for heard in (algorithm, algorithm.GetExecutive()):
        heard.AddObserver("ErrorEvent", lambda *_: None)
    algorithm.Update()
    message = algorithm.GetErrorMessage()
    assert algorithm.GetFrame() is None and "a binary mask" in message
    found = output(head())
    found.Update()
    assert found.GetFrame() is not None
    known = output(Volume(mask, np.eye(4)))
    known.SetTissues(TissueTable({0: FLUID, 1: SPECKLE}))
    known.Update()
    assert known.GetFrame() is not None


def test_what_is_set_can_be_got():
    """Each Set method of both filters has a Get method, which gives the same object."""
    names = {"OtherData": "t2"}
    for kind in (SegmentationFilter, UltrasoundSimulationFilter):
        algorithm, own = kind(), {name for base in kind.__mro__[:2] for name in vars(base)}
        values = {
            "Settings": SegmentationSettings(classes=4) if kind is SegmentationFilter else SimulationSettings(seed=1),
            "MaskData": cyst().to_vtk(), "OtherData": cyst().to_vtk(), "Device": "cpu", "InputData": cyst().to_vtk(),
            "Probe": PROBE, "ProbeTransform": vtkTransform(), "Tissues": TISSUES, "Display": DISPLAY,
            "FieldAlpha": True,
            "Preset": Preset(PROBE, DISPLAY, SimulationSettings(seed=1), TISSUES), "SheetsData": vtkPolyData(),
            "Texture": None,
        }  # fmt: skip
        for name in (name.removeprefix("Set") for name in own if name.startswith("Set")):
            getattr(algorithm, f"Set{name}")(*([names[name]] if name in names else []), values[name])
            got = algorithm.GetInputDataObject(0, 0) if name == "InputData" else getattr(algorithm, f"Get{name}")()
            assert (got[names[name]] if name in names else got) == values[name], name
    algorithm = SegmentationFilter()
    algorithm.AddTissueData("tumour", values["MaskData"])
    assert algorithm.GetAddedTissues() == (("tumour", values["MaskData"]),)
