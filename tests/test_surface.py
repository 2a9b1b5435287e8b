"""Position of a probe on the patient's surface, and sliding, rocking, tilting and rotating it."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.probe.poses import aimed_at, angles_to_surface, carried, turned
from SlicerUSSim.Logic.probe.surface import PatientSurface
from tests.conftest import block

RADIUS = 40.0
BALL = block(lambda x, y, z: x**2 + y**2 + z**2 < RADIUS**2, half_mm=(45, 45, 45), spacing_mm=1.0)
BALL_SURFACE = PatientSurface(BALL)

angle = st.floats(-85, 85)
direction = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1).map(np.array)


@st.composite
def poses(draw):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", draw(st.tuples(*[st.floats(-180, 180)] * 3)), degrees=True).as_matrix()
    pose[:3, 3] = draw(st.tuples(*[st.floats(-50, 50)] * 3))
    return pose


def is_rigid(pose: np.ndarray) -> bool:
    return np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3)) and np.linalg.det(pose[:3, :3]) > 0


@given(pose=poses(), start=direction, end=direction)
def test_a_carried_probe_turns_by_the_angle_between_the_directions(pose, start, end):
    moved = carried(pose, [1.0, 2.0, 3.0], start, end)
    assert is_rigid(moved) and np.allclose(moved[:3, 3], [1, 2, 3])
    rotation = moved[:3, :3] @ pose[:3, :3].T
    assert np.allclose(rotation @ (start / np.linalg.norm(start)), end / np.linalg.norm(end), atol=1e-7)
    cosine = np.clip(start @ end / np.linalg.norm(start) / np.linalg.norm(end), -1, 1)
    turned_by = Rotation.from_matrix(rotation).magnitude()
    assert np.rad2deg(turned_by) == pytest.approx(np.rad2deg(np.arccos(cosine)), abs=1e-4)


@given(pose=poses(), target=direction)
def test_a_probe_aimed_at_a_point_has_it_on_its_axis(pose, target):
    target = pose[:3, 3] + 40.0 * target
    seen = np.linalg.inv(aimed_at(pose, target)) @ [*target, 1.0]
    assert np.allclose(seen[[0, 2]], 0.0, atol=1e-6) and seen[1] > 0


@given(pose=poses(), rock=angle, tilt=angle)
def test_angles_to_the_surface_are_those_the_probe_was_turned_by(pose, rock, tilt):
    assert angles_to_surface(turned(pose, rock_deg=rock, tilt_deg=tilt), -pose[:3, 1]) == pytest.approx(
        (rock, tilt), abs=1e-6
    )


def test_rocking_stays_in_the_image_plane_and_tilting_leaves_it():
    rocked, tilted, rotated = (turned(np.eye(4), **{f"{name}_deg": 20.0}) for name in ("rock", "tilt", "rotate"))
    assert np.allclose(rocked[:3, 2], [0, 0, 1]) and rocked[0, 1] < 0
    assert np.allclose(tilted[:3, 0], [1, 0, 0]) and tilted[2, 1] > 0
    assert np.allclose(rotated[:3, 1], [0, 1, 0]) and not np.allclose(rotated, np.eye(4))


def test_the_surface_of_a_ball_is_where_the_ball_ends():
    for outward in np.eye(3):
        point = BALL_SURFACE.nearest(70.0 * outward)
        assert np.linalg.norm(point) == pytest.approx(RADIUS, abs=1.0)
        assert BALL_SURFACE.normal(point) @ outward > 0.995
        assert np.allclose(BALL_SURFACE.hit(70.0 * outward, [0, 0, 0]), point, atol=0.5)
    assert BALL_SURFACE.hit([60, 60, 60], [60, -60, 60]) is None


@given(right=st.floats(-110, 110), front=st.floats(-110, 110))
def test_angles_say_where_on_the_patient_a_point_is(right, front):
    assert BALL_SURFACE.angles(BALL_SURFACE.at(right, front)) == pytest.approx((right, front), abs=1e-4)


def test_the_ear_is_to_the_right_and_the_forehead_in_front():
    for right, front, place in ((90, 0, [RADIUS, 0, 0]), (0, 90, [0, RADIUS, 0]), (0, 0, [0, 0, RADIUS])):
        assert np.allclose(BALL_SURFACE.at(right, front), place, atol=1.5)


@given(
    right=st.floats(-80, 80), front=st.floats(-80, 80), rotate=st.floats(-170, 170), rock=st.floats(-60, 60),
    tilt=st.floats(-60, 60), lift=st.floats(-3, 10),
)  # fmt: skip
def test_what_a_probe_is_set_to_is_read_back(right, front, rotate, rock, tilt, lift):
    wanted = dict(
        right_deg=right, front_deg=front, rotate_deg=rotate, rock_deg=rock, tilt_deg=tilt, lift_mm=lift
    )  # fmt: skip
    pose = BALL_SURFACE.held(np.eye(4), **wanted)
    assert is_rigid(pose)
    # The nearest point of a mesh is not exactly the one that the normal was taken at.
    assert asdict(BALL_SURFACE.where(pose)) == pytest.approx(wanted, abs=2.5)


@given(pose=poses(), rock=st.floats(-60, 60))
def test_a_change_of_one_angle_leaves_face_and_other_angles(pose, rock):
    before, moved = BALL_SURFACE.where(pose), BALL_SURFACE.held(pose, rock_deg=rock)
    after = BALL_SURFACE.where(moved)
    assert np.allclose(moved[:3, 3], pose[:3, 3]) and after.rock_deg == pytest.approx(rock, abs=1e-4)
    assert after.tilt_deg == pytest.approx(before.tilt_deg, abs=1e-4)
    assert np.cos(np.deg2rad(after.rotate_deg - before.rotate_deg)) == pytest.approx(1.0, abs=1e-6)


@given(pose=poses(), outward=direction)
def test_a_slid_probe_stands_along_the_normal_on_the_surface(pose, outward):
    slid = BALL_SURFACE.slid(pose, 60.0 * outward / np.linalg.norm(outward))
    face, axis = slid[:3, 3], slid[:3, 1]
    assert is_rigid(slid) and -6.0 < np.linalg.norm(face) - RADIUS < 21.0
    assert axis @ -BALL_SURFACE.normal(BALL_SURFACE.nearest(face)) > 0.99


def test_a_probe_that_is_not_kept_upright_keeps_its_angles_to_the_surface():
    start = BALL_SURFACE.held(np.eye(4), right_deg=0, front_deg=0, rotate_deg=20, rock_deg=15, tilt_deg=-10, lift_mm=1)
    there = BALL_SURFACE.where(BALL_SURFACE.slid(start, BALL_SURFACE.at(40, 20), upright=False))
    assert (there.rock_deg, there.tilt_deg, there.lift_mm) == pytest.approx((15, -10, 1), abs=1.5)
    assert (there.right_deg, there.front_deg) == pytest.approx((40, 20), abs=1.5)


def test_sulci_are_bridged_and_the_head_stays_its_size():
    mri = head_mri(3.0)
    inside = mri.array > 0.3 * mri.array.max()
    grooved = inside.copy()
    grooved[:, :, inside.shape[2] // 2 - 1 : inside.shape[2] // 2 + 1] = False  # a cleft of 6 mm from top to bottom
    whole, cleft = (PatientSurface(Volume(a.astype(np.uint8), mri.ijk_to_ras)) for a in (inside, grooved))
    for front in (-60, 0, 60):
        assert np.linalg.norm(whole.at(0, front) - cleft.at(0, front)) < 4.0


def test_the_surface_lies_where_the_labels_lie_in_any_grid():
    matrix = np.array([[0.0, -1.5, 0.0, 10.0], [0.7, 0.0, 0.0, -20.0], [0.0, 0.0, 3.0, 5.0], [0, 0, 0, 1]])
    centre = np.array([5.0, 12.0, -8.0])
    k, j, i = np.meshgrid(np.arange(40), np.arange(70), np.arange(140), indexing="ij")
    matrix[:3, 3] += centre - matrix[:3] @ [70, 35, 20, 1]
    ras = np.stack([i, j, k, np.ones_like(i)], -1) @ matrix.T
    inside = np.linalg.norm(ras[..., :3] - centre, axis=-1) < 30.0
    surface = PatientSurface(Volume(inside.astype(np.uint8), matrix))
    assert np.allclose(surface.centre, centre, atol=1.5)
    for outward in np.eye(3):
        assert np.linalg.norm(surface.nearest(centre + 60 * outward) - centre) == pytest.approx(30.0, abs=1.5)


def test_no_direction_and_no_surface_are_refused():
    with pytest.raises(SimulationError, match="expected two of non-zero length"):
        carried(np.eye(4), [0, 0, 0], [0, 0, 0], [0, 0, 1])
    with pytest.raises(SimulationError, match="label map is empty"):
        PatientSurface(Volume(np.zeros((4, 4, 4), np.uint8), np.eye(4)))


def test_a_surface_tells_how_far_it_is_and_can_be_cancelled():
    told: list[float] = []
    PatientSurface(BALL, told.append)
    assert len(told) > 3 and told == sorted(told) and told[0] > 0 and told[-1] < 1

    def cancelled(share: float) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        PatientSurface(BALL, cancelled)


def test_a_path_on_a_ball_becomes_upright_poses_across_it():
    """Sphere: faces at its radius, axes through its centre, elevation along the path; also from points beside it."""
    angles = np.deg2rad(np.linspace(-30, 30, 7))
    path = 1.1 * RADIUS * np.stack([np.zeros(7), np.sin(angles), np.cos(angles)], axis=1)
    poses = np.array(BALL_SURFACE.along(path, 2.0))
    assert len(poses) == pytest.approx(RADIUS * np.deg2rad(60) / 2.0, abs=2) and all(map(is_rigid, poses))
    faces = poses[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(faces, axis=1), RADIUS, atol=1.5)
    np.testing.assert_allclose(-np.sum(poses[:, :3, 1] * faces, axis=1) / RADIUS, 1.0, atol=0.06)
    assert (np.abs(np.sum(poses[:-1, :3, 2] * np.diff(faces, axis=0), axis=1)) > 1.8).all()
    assert (poses[:, 0, 0] > 0.95).all()  # the right of the image is the patient's
    with pytest.raises(SimulationError, match=r"the path on the patient is 0\.0 mm long"):
        BALL_SURFACE.along([path[0], path[0]])
