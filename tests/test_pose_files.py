"""Poses as numbers and as files."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import SimulationError
from SlicerUSSim.Logic.base.transforms import LPS_TO_RAS, angles_of_pose, pose_of_angles
from SlicerUSSim.Logic.tracked.pose_files import pose_of_text, read_pose, write_pose

degrees = st.floats(-179.0, 179.0)


@given(degrees, degrees, degrees)
def test_angles_are_about_the_fixed_axes_r_a_s(r, a, s):
    pose = pose_of_angles([1.0, -2.0, 3.0], [r, a, s])
    np.testing.assert_allclose(pose[:3, :3], Rotation.from_euler("xyz", [r, a, s], degrees=True).as_matrix(), atol=1e-9)
    assert pose[:3, 3].tolist() == [1.0, -2.0, 3.0]
    np.testing.assert_allclose(pose_of_angles(pose[:3, 3], angles_of_pose(pose)), pose, atol=1e-6)


@pytest.mark.parametrize("a", [90.0, -90.0])
def test_angles_of_a_pose_that_looks_along_r_give_the_pose_again(a):
    pose = pose_of_angles([0, 0, 0], [30.0, a, 50.0])
    angles = angles_of_pose(pose)
    assert angles[0] == 0.0 and angles[1] == pytest.approx(a)
    np.testing.assert_allclose(pose_of_angles([0, 0, 0], angles), pose, atol=1e-9)


@pytest.mark.parametrize("suffix", [".json", ".tfm", ".h5", ".mat", ".txt"])
def test_a_pose_is_read_as_it_was_written_in_every_format(suffix, tmp_path):
    pose = pose_of_angles([10.123456789, -20.0, 30.0], [11.0, 22.0, 33.0])
    write_pose(tmp_path / f"pose{suffix}", pose)
    np.testing.assert_allclose(read_pose(tmp_path / f"pose{suffix}"), pose, atol=1e-9)
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("suffix", [".txt", ".mat"])
@pytest.mark.parametrize("kind", ["double", "float"])
def test_transforms_of_c3d_and_ants_are_read(suffix, kind, tmp_path):
    """SimpleITK shows their class as a chain with itself, in which reading did not end."""
    path, name = tmp_path / f"pose{suffix}", f"MatrixOffsetTransformBase_{kind}_3_3"
    pose = pose_of_angles([10.0, -20.0, 30.0], [11.0, 22.0, 33.0])
    to_probe = np.linalg.inv(LPS_TO_RAS @ pose @ LPS_TO_RAS)[:3]
    numbers = np.concatenate([to_probe[:, :3].ravel(), to_probe[:, 3]]).astype(kind if kind == "double" else "float32")
    if suffix == ".mat":
        savemat(path, {name: numbers[:, None], "fixed": np.zeros((3, 1), numbers.dtype)}, format="4")
    else:
        text = f"Parameters: {' '.join(map(str, numbers))}\nFixedParameters: 0 0 0\n"
        path.write_text(f"#Insight Transform File V1.0\n#Transform 0\nTransform: {name}\n{text}")
    np.testing.assert_allclose(read_pose(path), pose, atol=1e-4)


def test_a_matrix_of_flirt_is_not_a_pose(tmp_path):
    for name in ("flirt.mat", "flirt.txt"):
        np.savetxt(tmp_path / name, np.eye(4), "%.8f ")
    with pytest.raises(SimulationError, match=r"FLIRT .* -src IMAGE flirt\.mat -fsl2ras -oitk pose\.tfm converts"):
        read_pose(tmp_path / "flirt.mat")
    assert np.array_equal(read_pose(tmp_path / "flirt.txt"), np.eye(4))  # as the user says


def test_a_pose_is_read_from_a_bare_matrix_in_json(tmp_path):
    pose = pose_of_angles([1.0, -2.0, 30.0], [10.0, 20.0, 30.0])
    (tmp_path / "pose.json").write_text(str(pose.tolist()))
    np.testing.assert_allclose(read_pose(tmp_path / "pose.json"), pose, atol=1e-9)


def test_itk_files_are_from_the_world_to_the_probe_in_lps_as_slicers(tmp_path):
    sitk = pytest.importorskip("SimpleITK")
    write_pose(tmp_path / "pose.tfm", pose_of_angles([10.0, 20.0, 30.0], [0, 0, 0]))
    transform = sitk.ReadTransform(str(tmp_path / "pose.tfm"))
    assert transform.TransformPoint((-10.0, -20.0, 30.0)) == (0.0, 0.0, 0.0)


def test_poses_are_typed_as_six_or_sixteen_numbers():
    expected = pose_of_angles([1.5, 2.0, -3.0], [90.0, 0.0, 45.0])
    np.testing.assert_allclose(pose_of_text("1.5, 2, -3; 90 0 45"), expected, atol=1e-12)
    np.testing.assert_allclose(pose_of_text(str(expected.tolist())), expected, atol=1e-12)
    np.testing.assert_allclose(pose_of_text("\n".join(" ".join(map(str, row)) for row in expected)), expected)


@pytest.mark.parametrize(
    "text", ["", "1 2 3", "1 2 3 4 5 x", "nan 0 0 0 0 0", "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "1 " * 17]
)
def test_other_texts_are_refused_in_one_line(text):
    with pytest.raises(SimulationError) as error:
        pose_of_text(text)
    assert "pose" in str(error.value) and "\n" not in str(error.value)


def test_a_matrix_that_is_not_a_pose_is_not_written(tmp_path):
    with pytest.raises(SimulationError, match="is not rigid"):
        write_pose(tmp_path / "pose.json", np.diag([2.0, 2.0, 2.0, 1.0]))
    assert not list(tmp_path.iterdir())
