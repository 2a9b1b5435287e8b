"""Tracked sequences: files of Plus, IGSIO and the MNI, orientations, transforms along a path, bad input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkCommonMath import vtkMatrix4x4

from SlicerUSSim.Logic import LinearProbe, SimulationError, TrackedSequence, Volume
from SlicerUSSim.Logic.base.transforms import rigid_between
from SlicerUSSim.Logic.tracked.images import TrackedImages
from SlicerUSSim.Logic.tracked.pose_files import (
    fit_landmarks,
    read_calibration,
    read_coordinate_definitions,
    read_matrix,
    read_tags,
    read_transform,
)
from tests.conftest import SHARED, needs_shared

names = st.sampled_from(["ImageToProbe", "ProbeToTracker", "ReferenceToTracker", "ReferenceToRas"])


def rigid(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    matrix[:3, 3] = random.uniform(-100, 100, 3)
    return matrix


def chain(count: int = 3) -> TrackedSequence:
    """Asymmetric, distinguishable images, tracked along ImageToProbe, ProbeToTracker, ReferenceToTracker."""
    images = np.random.default_rng(0).integers(0, 256, (count, 20, 30), dtype=np.uint8)
    transforms = tuple(
        {"ProbeToTracker": rigid(10 + n), "ReferenceToTracker": rigid(20 + n), "ImageToProbe": rigid(30)}
        for n in range(count)
    )
    return TrackedSequence(images, transforms, 0.1 * np.arange(count), fields={"Operator": "nobody"})


# ---- transforms ------------------------------------------------------------------------------------------------------


def test_pose_is_composed_along_the_path_with_inverses():
    sequence = chain()
    expected = np.linalg.inv(rigid(21)) @ rigid(11) @ rigid(30)
    assert np.allclose(sequence.pose(1, "ImageToReference"), expected)
    assert np.allclose(sequence.pose(1, "ReferenceToImage"), np.linalg.inv(expected))
    assert np.allclose(sequence.pose(2, "ProbeToProbe"), np.eye(4))


@given(st.integers(0, 50), st.integers(0, 50))
def test_any_path_and_its_reverse_are_inverses(a, c):
    sequence = chain().with_transforms({"ReferenceToRas": rigid(a), "ImageToProbe": rigid(c)})
    there, back = sequence.pose(0, "ImageToRas"), sequence.pose(0, "RasToImage")
    assert np.allclose(there @ back, np.eye(4), atol=1e-9)
    assert np.allclose(there, rigid(a) @ np.linalg.inv(rigid(20)) @ rigid(10) @ rigid(c))


@pytest.mark.parametrize("lost", ["nowhere", "in one image", "everywhere"])
def test_measured_transforms_win_over_constants_of_a_configuration(tmp_path, caplog, lost):
    """Where they were lost, too: an identity in a Plus configuration was mistaken for the pose."""
    plus_file(tmp_path / "plus.mha", "MF", MARKED_FAR)  # whose image 1 was not tracked
    content = (tmp_path / "plus.mha").read_bytes()
    status = {"nowhere": (b"= INVALID", b"= OK"), "everywhere": (b"TransformStatus = OK", b"TransformStatus = INVALID")}
    (tmp_path / "plus.mha").write_bytes(content.replace(*status.get(lost, (b"", b""))))
    constant = {"ImageToProbe": rigid(3), "ProbeToTracker": np.eye(4), "TrackerToProbe": np.eye(4)}
    sequence = TrackedSequence.read(tmp_path / "plus.mha").with_transforms(constant)
    tracked = [n for n in range(2) if sequence.has_pose(n, "ImageToTracker")]
    assert tracked == {"nowhere": [0, 1], "in one image": [0], "everywhere": []}[lost]
    assert [sequence.pose(n, "ProbeToTracker")[0, 3] for n in tracked] == [float(n) for n in tracked]
    assert "constant ProbeToTracker, TrackerToProbe" in caplog.text


def test_a_missing_transform_is_named_with_what_there_is():
    sequence = TrackedSequence(np.ones((1, 4, 4), np.uint8), ({"ProbeToTracker": np.eye(4)},), [0.0])
    with pytest.raises(SimulationError) as caught:
        sequence.pose(0, "ImageToTracker")
    message = str(caught.value)
    assert "from Image to Tracker" in message and "ProbeToTracker" in message and "ImageToProbe" in message
    assert not sequence.has_pose(0, "ImageToTracker") and sequence.has_pose(0, "TrackerToProbe")


@pytest.mark.parametrize("name", ["Image", "ToReference"])
def test_a_name_that_is_not_a_transform_is_refused(name):
    with pytest.raises(SimulationError, match="expected two frames joined by To"):
        chain().pose(0, name)


@pytest.mark.parametrize("number", [-1, 3, 0.5])
def test_an_image_that_does_not_exist_is_named(number):
    with pytest.raises(SimulationError, match=f"image {number} does not exist, expected 0 to 2"):
        chain().pose(number, "ImageToProbe")
    with pytest.raises(SimulationError, match=f"image {number} does not exist, expected 0 to 2"):
        chain().select([0, number])


def test_frames_named_with_a_to_inside_are_told_apart():
    sequence = TrackedSequence(
        np.ones((1, 4, 4), np.uint8), ({"TopToTracker": rigid(1), "TrackerToStool": rigid(2)},), [0.0]
    )
    assert np.allclose(sequence.pose(0, "TopToStool"), rigid(2) @ rigid(1))


def test_shapes_that_do_not_fit_are_refused():
    images = np.ones((2, 4, 4), np.uint8)
    for arguments, message in (
        ((images[0], ({}, {}), [0, 1]), "expected (n, rows, columns)"),
        ((images, ({},), [0, 1]), "1 sets of transforms for 2 images"),
        ((images, ({}, {}), [0]), "timestamps have shape (1,)"),
        ((images, ({"AToB": np.eye(3)}, {}), [0, 1]), "image 0: AToB has shape (3, 3)"),
        ((images, ({}, {"AToB": np.full((4, 4), np.nan)}), [0, 1]), "image 1: AToB"),
    ):
        with pytest.raises(SimulationError) as caught:
            TrackedSequence(*arguments)
        assert message in str(caught.value)


# ---- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("suffix", "compress", "kind"),
    [
        (".igs.mha", True, "u1"), (".seq.mha", False, ">i2"), (".mha", True, "<f4"), (".nrrd", False, "u1"),
        (".seq.nrrd", True, "u1"),
    ],
)  # fmt: skip
def test_what_is_written_is_read_back(tmp_path, suffix, compress, kind):
    sequence = replace(chain(), images=chain().images.astype(kind))
    path = tmp_path / f"sweep{suffix}"
    sequence.write(path, compress)
    found = TrackedSequence.read(path)
    assert np.array_equal(found.images, sequence.images) and found.images.dtype == np.dtype(kind).newbyteorder("=")
    assert np.allclose(found.timestamps, sequence.timestamps)
    assert found.fields == sequence.fields and found.image_type == "BRIGHTNESS"
    for ours, theirs in zip(found.transforms, sequence.transforms, strict=True):
        assert ours.keys() == theirs.keys()
        assert all(np.allclose(ours[name], theirs[name], atol=1e-6) for name in theirs)


def test_untracked_transforms_are_left_out_and_stay_out(tmp_path):
    sequence = chain()
    lost = ({}, *sequence.transforms[1:])
    TrackedSequence(sequence.images, lost, sequence.timestamps).write(tmp_path / "sweep.igs.mha")
    found = TrackedSequence.read(tmp_path / "sweep.igs.mha")
    assert not found.transforms[0] and "ProbeToTracker" in found.transforms[1]
    assert "ProbeToTrackerTransformStatus = INVALID" in (tmp_path / "sweep.igs.mha").read_bytes().decode("latin1")


def test_a_sequence_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "sweep.igs.mha"
    chain().write(path)
    before = path.read_bytes()
    with pytest.raises(SimulationError, match="does not exist"):
        chain().write(tmp_path / "nowhere" / "sweep.igs.mha")
    with pytest.raises(SimulationError, match="unknown sequence format"):
        chain().write(tmp_path / "sweep.png")
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["sweep.igs.mha"]


def plus_file(path: Path, orientation: str, pixels: np.ndarray, image_type: str = "BRIGHTNESS") -> None:
    """A file as Plus writes it, byte by byte, independent of this package's writer."""
    count, rows, columns = pixels.shape
    lines = [
        "ObjectType = Image", "NDims = 3", "AnatomicalOrientation = RAI", "BinaryData = True",
        "BinaryDataByteOrderMSB = False", "CompressedData = False", f"DimSize = {columns} {rows} {count}",
        "Kinds = domain domain list", "ElementSpacing = 1 1 1", "ElementType = MET_UCHAR", "Offset = 0 0 0",
        "TransformMatrix = 1 0 0 0 1 0 0 0 1", f"UltrasoundImageOrientation = {orientation}",
        f"UltrasoundImageType = {image_type}",
    ]  # fmt: skip
    for n in range(count):
        start = f"Seq_Frame{n:04d}_"
        lines += [
            f"{start}ProbeToTrackerTransform = 1 0 0 {n} 0 1 0 0 0 0 1 0 0 0 0 1 ",
            f"{start}ProbeToTrackerTransformStatus = {'OK' if n != 1 else 'INVALID'}",
            f"{start}Timestamp = {10 + n}.5",
            f"{start}ImageStatus = OK",
        ]
    header = "\n".join([*lines, "ElementDataFile = LOCAL", ""])
    path.write_bytes(header.encode() + np.ascontiguousarray(pixels, np.uint8).tobytes())


MARKED_FAR = np.arange(2 * 3 * 4, dtype=np.uint8).reshape(2, 3, 4)  # [n, towards far, towards marked]


@pytest.mark.parametrize(
    "orientation, pixels",
    [
        ("MF", MARKED_FAR),
        ("UFD", MARKED_FAR[:, :, ::-1]),
        ("MN", MARKED_FAR[:, ::-1, :]),
        ("UN", MARKED_FAR[:, ::-1, ::-1]),
        ("FM", MARKED_FAR.swapaxes(1, 2)),
        ("NM", MARKED_FAR.swapaxes(1, 2)[:, :, ::-1]),
        ("FU", MARKED_FAR.swapaxes(1, 2)[:, ::-1, :]),
        ("NU", MARKED_FAR.swapaxes(1, 2)[:, ::-1, ::-1]),
    ],
)
def test_images_come_in_one_orientation_whatever_the_file_has(tmp_path, orientation, pixels):
    plus_file(tmp_path / "plus.mha", orientation, pixels)
    found = TrackedSequence.read(tmp_path / "plus.mha")
    assert np.array_equal(found.images, MARKED_FAR)
    assert found.timestamps.tolist() == [10.5, 11.5]
    assert found.transforms[0]["ProbeToTracker"][0, 3] == 0.0 and "ProbeToTracker" not in found.transforms[1]


def test_rf_data_comes_line_by_line_from_near_to_far(tmp_path):
    plus_file(tmp_path / "plus.mha", "NM", MARKED_FAR.swapaxes(1, 2)[:, :, ::-1], "RF_REAL")
    found = TrackedSequence.read(tmp_path / "plus.mha")
    assert np.array_equal(found.images, MARKED_FAR.swapaxes(1, 2)) and found.image_type == "RF_REAL"
    with pytest.raises(SimulationError, match="RF_REAL data, expected B-mode"):
        TrackedImages.of(found)


def test_colours_become_grey(tmp_path):
    grey = np.random.default_rng(0).integers(0, 256, (2, 5, 6), dtype=np.uint8)
    image = sitk.GetImageFromArray(np.repeat(grey[..., None], 3, axis=3), isVector=True)
    sitk.WriteImage(image, str(tmp_path / "colour.mha"))
    assert np.abs(TrackedSequence.read(tmp_path / "colour.mha").images.astype(int) - grey).max() <= 1


def slicer_sequence(kind: str, path: Path, name: str = "Image", nodes: Callable = lambda slicer: []):
    """(storage node, sequence node) of 3D Slicer for a file, with these nodes at 0, 0.5, ... seconds."""
    slicer = pytest.importorskip("slicer", reason="Slicer's MRML libraries: pip install '.[slicer]'")
    scene = slicer.vtkMRMLScene()
    sequence = scene.AddNewNodeByClass("vtkMRMLSequenceNode", name)
    for n, node in enumerate(nodes(slicer)):
        sequence.SetDataNodeAtValue(node, str(0.5 * n))
    storage = scene.AddNewNodeByClass(f"vtkMRML{kind}SequenceStorageNode")
    storage.SetFileName(str(path))
    return storage, sequence


def linear_transforms(matrices) -> Callable:
    """Nodes for slicer_sequence."""

    def nodes(slicer):
        for matrix in matrices:
            to_parent, node = vtkMatrix4x4(), slicer.vtkMRMLLinearTransformNode()
            to_parent.DeepCopy(matrix.ravel())
            node.SetMatrixTransformToParent(to_parent)
            yield node

    return nodes


def test_slicer_reads_the_transforms_that_are_written(tmp_path):
    tracked = tuple({"ProbeToTracker": rigid(n)} for n in range(3))
    TrackedSequence(chain().images, tracked, [0.0, 0.5, 1.0]).write(tmp_path / "sweep.seq.mha", compress=False)
    storage, node = slicer_sequence("LinearTransform", tmp_path / "sweep.seq.mha")
    assert storage.ReadData(node) == 1 and node.GetNumberOfDataNodes() == 3
    matrix = vtkMatrix4x4()
    node.GetNthDataNode(1).GetMatrixTransformToParent(matrix)
    assert np.allclose(np.reshape(matrix.GetData(), (4, 4)), rigid(1), atol=1e-5)


@pytest.mark.parametrize("name", ["ProbeToReference-Sequence", "Needle pose"])  # the first as Slicer records it
@pytest.mark.parametrize("suffix", [".seq.mha", ".seq.mhd", ".seq.nrrd"])
def test_transforms_of_slicer_are_poses_without_images(tmp_path, suffix, name):
    nodes = linear_transforms([rigid(n) for n in range(3)])
    storage, sequence = slicer_sequence("LinearTransform", tmp_path / f"poses{suffix}", name, nodes)
    assert storage.WriteData(sequence) == 1
    found = TrackedSequence.read(tmp_path / f"poses{suffix}")
    assert len(found) == 3 and not found.has_images and found.timestamps.tolist() == [0.0, 0.5, 1.0]
    assert np.allclose(found.pose(2, "ProbeToReference"), rigid(2), atol=1e-3)  # Slicer writes six digits
    with pytest.raises(SimulationError, match="poses without images"):
        TrackedImages.of(found, path="ProbeToReference")


@pytest.mark.parametrize("components, suffix", [(1, ".seq.nrrd"), (3, ".seq.nrrd"), (1, ".seq.mha"), (3, ".seq.mha")])
def test_images_of_a_slicer_sequence_are_read(tmp_path, components, suffix):
    def nodes(slicer):
        for image in chain().images:
            data = vtkImageData()
            data.SetDimensions(30, 20, 1)
            pixels = np.repeat(image.ravel()[:, None], components, axis=1)
            data.GetPointData().SetScalars(numpy_to_vtk(pixels, deep=True))
            node = slicer.vtkMRMLScalarVolumeNode() if components == 1 else slicer.vtkMRMLVectorVolumeNode()
            node.SetAndObserveImageData(data)
            yield node

    storage, sequence = slicer_sequence("Volume", tmp_path / f"image{suffix}", nodes=nodes)
    assert storage.WriteData(sequence) == 1
    found = TrackedSequence.read(tmp_path / f"image{suffix}")
    assert np.abs(found.images.astype(int) - chain().images).max() <= 1


@pytest.mark.parametrize(
    "change, message",
    [
        (("UltrasoundImageOrientation = MF", "UltrasoundImageOrientation = QX"), "'QX', expected a code such as MF"),
        (("Timestamp = 10.5", "Timestamp = noon"), "'noon', expected seconds"),
        (("Seq_Frame0001_Timestamp", "Seq_Frame0007_Timestamp"), "has the field Seq_Frame0007_Timestamp"),
        (("Seq_Frame0000_ProbeToTrackerTransform =", "Seq_Frame0000_ProbeTransform ="), "no path from Probe"),
    ],
)
def test_a_damaged_field_is_one_clear_error(tmp_path, change, message):
    path = tmp_path / "plus.mha"
    plus_file(path, "MF", MARKED_FAR)
    path.write_bytes(path.read_bytes().replace(change[0].encode(), change[1].encode()))
    with pytest.raises(SimulationError) as caught:
        sequence = TrackedSequence.read(path)
        sequence.pose(0, "ProbeToTracker")
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["missing.mha", "empty.mha", "text.nrrd", "text.mha"])
def test_a_file_that_is_none_is_one_clear_error(tmp_path, name):
    if "missing" not in name:
        (tmp_path / name).write_text("" if "empty" in name else "this is not an image\n")
    with pytest.raises(SimulationError, match=name) as caught:
        TrackedSequence.read(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name, value", [("Needle", "1 0 0"), ("NeedleToTracker", "1 0 0"), ("NeedleToTracker", "x")])
def test_a_transform_that_is_not_needed_may_be_none(tmp_path, name, value):
    plus_file(tmp_path / "plus.mha", "MF", MARKED_FAR)
    content = (tmp_path / "plus.mha").read_bytes()
    field = f"Seq_Frame0000_{name}Transform = {value}\n".encode()
    (tmp_path / "plus.mha").write_bytes(content.replace(b"ElementDataFile", field + b"ElementDataFile"))
    sequence = TrackedSequence.read(tmp_path / "plus.mha")
    assert sequence.has_pose(0, "ProbeToTracker") and not sequence.has_pose(0, "NeedleToTracker")
    sequence.write(tmp_path / "again.mha")
    assert field in (tmp_path / "again.mha").read_bytes()  # nothing of a file is lost


@pytest.mark.parametrize("scale", [0.0, 2.0, -1.0])
def test_a_tracked_pose_that_is_not_rigid_is_left_out(tmp_path, caplog, scale):
    poses = [{"ImageToProbe": np.diag([0.1, 0.1, 0.1, 1]), "ProbeToTracker": np.eye(4)} for _ in range(2)]
    poses[1]["ProbeToTracker"] = np.diag([scale, abs(scale), abs(scale), 1.0])
    sequence = TrackedSequence(np.ones((2, 4, 5), np.uint8), tuple(poses), np.arange(2.0))
    sequence.write(tmp_path / "s.igs.mha")
    found = TrackedSequence.read(tmp_path / "s.igs.mha")
    assert [found.has_pose(n, "ImageToTracker") for n in range(2)] == [True, False]
    assert "Seq_Frame0001_ProbeToTrackerTransform" in caplog.text and "such transforms are left out" in caplog.text


def test_values_that_slicers_igsio_writes_are_read_with_a_warning(tmp_path, caplog):
    plus_file(tmp_path / "plus.mha", "??", MARKED_FAR, "BRIGHTNESSBRIGHTNESS")
    found = TrackedSequence.read(tmp_path / "plus.mha")
    assert np.array_equal(found.images, MARKED_FAR) and found.image_type == "BRIGHTNESS"
    assert "UltrasoundImageOrientation is '??', which is unknown, read as MF" in caplog.text


# ---- the MNI's files -------------------------------------------------------------------------------------------------


def write_minc1(path: Path, array: np.ndarray, origin, spacing, cosines) -> None:
    """A MINC 1 file: NetCDF with dimensions zspace, yspace, xspace."""
    from scipy.io import netcdf_file

    with netcdf_file(path, "w") as file:
        for axis, (name, size) in enumerate(zip(("zspace", "yspace", "xspace"), array.shape, strict=True)):
            file.createDimension(name, size)
            variable = file.createVariable(name, "d", ())
            variable.start, variable.step = float(origin[2 - axis]), float(spacing[2 - axis])
            variable.direction_cosines = np.asarray(cosines[2 - axis], float)
            variable.spacing = b"regular__"
        image = file.createVariable("image", "b", ("zspace", "yspace", "xspace"))
        image[:] = array.astype(np.uint8).view(np.int8)
        image.signtype = b"unsigned"
        image.valid_range = np.array([0.0, 255.0])
        for name, value in (("image-max", 255.0), ("image-min", 0.0)):
            file.createVariable(name, "d", ())[...] = value


def test_minc1_is_read_with_its_place(tmp_path):
    array = np.random.default_rng(0).integers(0, 256, (4, 5, 6), dtype=np.uint8)
    turned = Rotation.from_euler("xyz", [10, -20, 30], degrees=True).as_matrix()
    write_minc1(tmp_path / "volume.mnc", array, (-10.0, 20.0, 5.0), (0.5, 1.0, 2.0), turned.T)
    volume = Volume.read(tmp_path / "volume.mnc")
    assert np.array_equal(volume.array, array)
    expected = np.eye(4)
    expected[:3, :3] = turned * [0.5, 1.0, 2.0]
    expected[:3, 3] = turned @ [-10.0, 20.0, 5.0]  # MINC's start is along the turned axes
    assert np.allclose(volume.ijk_to_ras, expected)
    (tmp_path / "broken.mnc").write_bytes((tmp_path / "volume.mnc").read_bytes()[:60])
    with pytest.raises(SimulationError, match=r"broken\.mnc: cannot be read as an image"):
        Volume.read(tmp_path / "broken.mnc")


def test_minc_slices_become_a_sequence(tmp_path):
    images = np.random.default_rng(1).integers(0, 256, (3, 7, 9), dtype=np.uint8)
    for n, image in enumerate(images):
        write_minc1(tmp_path / f"slice{n}.mnc", image[None], (n, 2.0, 3.0), (0.3, 0.4, 1.0), np.eye(3))
    sequence = TrackedSequence.from_slices(sorted(tmp_path.glob("*.mnc")))
    assert np.array_equal(sequence.images, images)
    pose = sequence.pose(2, "ImageToReference")
    assert np.allclose(pose @ [4, 5, 0, 1], [2 + 4 * 0.3, 2 + 5 * 0.4, 3, 1])
    with pytest.raises(SimulationError, match="expected one slice"):
        write_minc1(tmp_path / "thick.mnc", images, (0, 0, 0), (1, 1, 1), np.eye(3))
        TrackedSequence.from_slices([tmp_path / "thick.mnc"])
    with pytest.raises(SimulationError, match="no slice"):
        TrackedSequence.from_slices([])


def test_a_volume_is_cut_where_the_probe_looks():
    k, j, i = np.mgrid[0:60, 0:50, 0:40]
    volume = Volume((i + 2 * j + k).astype(np.float32), np.diag([1.0, 1.0, 1.0, 1.0]))
    probe = LinearProbe(20, 25, scan_lines=32)
    pose = np.eye(4)
    pose[:3, 3] = 20.0, 5.0, 30.0
    sequence = TrackedSequence.from_volume(volume, probe, [pose], (50, 40))
    x, y, z, _ = sequence.pose(0, "ImageToReference") @ [12, 20, 0, 1]
    assert sequence.images[0, 20, 12] == pytest.approx(x + 2 * y + z, abs=1.0)
    found = TrackedImages.of(sequence, probe=probe)
    assert np.allclose(found.poses[0], pose, atol=1e-6)


def test_xfm_and_tag_files_are_read(tmp_path):
    (tmp_path / "a.xfm").write_text(
        "MNI Transform File\n% by hand\nTransform_Type = Linear;\nLinear_Transform =\n"
        " 1 0 0 5\n 0 0.9 0.1 -2\n 0 -0.1 1.1 3.5;\n"
    )
    assert read_transform(tmp_path / "a.xfm")[:3].tolist() == [[1, 0, 0, 5], [0, 0.9, 0.1, -2], [0, -0.1, 1.1, 3.5]]
    (tmp_path / "grid.xfm").write_text("MNI Transform File\nTransform_Type = Grid_Transform;\n")
    with pytest.raises(SimulationError, match="Grid_Transform, expected Linear"):
        read_transform(tmp_path / "grid.xfm")
    (tmp_path / "two.tag").write_text(
        'MNI Tag Point File\nVolumes = 2;\n% Volume: mri.mnc\n\nPoints =\n 1 2 3 4 5 6 "a 7"\n -1.5 2e1 .5 0 0 0 "b";\n'
    )
    one, two = read_tags(tmp_path / "two.tag")
    assert one.tolist() == [[1, 2, 3], [-1.5, 20, 0.5]] and two.tolist() == [[4, 5, 6], [0, 0, 0]]
    (tmp_path / "no.tag").write_text("1 2 3\n")
    with pytest.raises(SimulationError, match="does not start with"):
        read_tags(tmp_path / "no.tag")


@given(st.integers(0, 1000), st.integers(3, 20))
def test_landmarks_give_the_rigid_map_between_them(seed, count):
    points = np.random.default_rng(seed).uniform(-50, 50, (count, 3))
    matrix = rigid(seed)
    found, left = rigid_between(points, points @ matrix[:3, :3].T + matrix[:3, 3])
    assert left < 1e-6 and np.linalg.det(found[:3, :3]) == pytest.approx(1.0)
    moved = points @ found[:3, :3].T + found[:3, 3]
    assert np.allclose(moved, points @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-6)


def test_calibrations_are_read_from_plus_configurations_and_matrices(tmp_path):
    (tmp_path / "plus.xml").write_text(
        '<PlusConfiguration><CoordinateDefinitions><Transform From="Image" To="Probe" '
        'Matrix="0 0.08 0 11 -0.08 0 0 50 0 0 0.08 0 0 0 0 1"/></CoordinateDefinitions></PlusConfiguration>'
    )
    found = read_coordinate_definitions(tmp_path / "plus.xml")["ImageToProbe"]
    assert found[0].tolist() == [0, 0.08, 0, 11]
    (tmp_path / "matrix.txt").write_text("0 0.08 0 11\n-0.08 0 0 50\n0 0 0.08 0\n0 0 0 1\n")
    assert np.array_equal(read_matrix(tmp_path / "matrix.txt"), found)
    for text, message in (("<a/>", "has no <Transform"), ("hello", "is not XML")):
        (tmp_path / "bad.xml").write_text(text)
        with pytest.raises(SimulationError, match=message):
            read_coordinate_definitions(tmp_path / "bad.xml")


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([[0, 0, 0], [9, 0, 0]], "2 pairs of landmarks, expected three or more"),
        ([[0, 0, 0], [9, 9, 9], [20, 20, 20.5]], r"landmarks in the ultrasound lie within 0\.\d+ mm of a line"),
    ],
)
def test_landmarks_that_leave_a_turn_free_are_refused(points, words):
    with pytest.raises(SimulationError, match=words):
        fit_landmarks(np.array(points, float), np.array(points, float))


def test_a_calibration_is_read_from_a_transform_as_slicer_saves_it(tmp_path):
    """The map from the parent in LPS; a calibration scales."""
    import SimpleITK as sitk

    matrix = np.array([[0.0, -0.2, 0, 5], [0.1, 0, 0, -7], [0, 0, 0.2, 3], [0, 0, 0, 1]])
    flip = np.diag([-1.0, -1, 1, 1])
    to_image = flip @ np.linalg.inv(matrix) @ flip
    transform = sitk.AffineTransform(to_image[:3, :3].ravel().tolist(), to_image[:3, 3].tolist())
    for name in ("calibration.tfm", "calibration.txt", "calibration.h5"):
        sitk.WriteTransform(transform, str(tmp_path / name))
        (found,) = read_calibration(tmp_path / name, "ImageToTool").items()
        assert found[0] == "ImageToTool"
        np.testing.assert_allclose(found[1], matrix, atol=1e-9)


def test_what_is_left_at_each_landmark_is_reported():
    points = np.array([[0.0, 0, 0], [50, 0, 0], [0, 40, 0], [0, 0, 30], [30, 30, 30]])
    shift = np.array([5.0, 4.0, -2.0])
    matrix, line, left = fit_landmarks(points, points + shift + np.eye(5, 3, k=-2) * [0.0, 0.0, 1.0])
    assert np.allclose(matrix[:3, 3], shift, atol=1.0) and line.startswith("5 landmarks agree to 0.")
    assert line == f"5 landmarks agree to {np.sqrt((left**2).mean()):.2f} mm (root mean square)" and left.argmax() == 4


# ---- real files ------------------------------------------------------------------------------------------------------


@needs_shared
@pytest.mark.parametrize("name", ["SpinePhantomFreehand", "BoneUltrasound_L14"])
def test_real_sequences_are_read_and_tracked(name):
    sequence = TrackedSequence.read(SHARED / f"{name}.igs.mha")
    assert sequence.images.shape == (21, 616, 820) and sequence.images.dtype == np.uint8
    assert sequence.frames_of_reference() == ["Probe", "Reference", "Stylus", "Tracker"]
    poses = [sequence.pose(n, "ProbeToReference") for n in range(21)]
    steps = [np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in pairwise(poses)]
    assert 0.05 < np.median(steps) < 5.0  # a hand at 12 images per second
    with pytest.raises(SimulationError, match="calibration ImageToProbe"):
        sequence.pose(0, "ImageToReference")


@needs_shared
def test_real_rf_data_starts_at_the_face():
    sequence = TrackedSequence.read(SHARED / "UltrasonixLinearRfData.igs.mha")
    assert sequence.images.shape == (1, 256, 2080) and sequence.images.dtype == np.int16
    energy = np.abs(sequence.images[0].astype(float)).mean(axis=0)
    assert energy[:200].mean() > 20 * energy[-200:].mean()  # the file has it the other way round (NM)
