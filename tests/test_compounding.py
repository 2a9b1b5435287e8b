"""Volumes from sweeps: grey levels at their positions for all poses and grids; gaps filled, nothing added elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import ConvexProbe, LinearProbe, SimulationError, Volume
from SlicerUSSim.Logic.imaging.compounding import Compounder, sweep_grid
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import slide_sweep, tilt_sweep
from tests.conftest import SPECKLE, block, rigid, simulator
from validation.beams import freehand_sweep

PROBE = ConvexProbe(30, 60, 40)


def painted(probe, pose, grey) -> Frame:
    """A frame whose pixels have the grey level `grey(points)` of where they are in the patient (RAS mm)."""
    grid = ImageGrid.for_probe(probe, (300, 320))
    column, row = np.meshgrid(np.arange(grid.columns), np.arange(grid.rows))
    pixels = np.stack([column, row, 0 * row, 1 + 0 * row], axis=-1)
    points = pixels @ (pose @ grid.image_to_probe).T
    places = pixels @ grid.image_to_probe.T
    image = np.where(probe.holds(places[..., 0], places[..., 1]), grey(points[..., :3]), 0).astype(np.uint8)
    return Frame(
        iq=np.zeros((2, 2)), envelope=np.zeros((2, 2)), bmode=image, image=image, sample_interval_mm=0.1,
        cycles_per_mm=6.5, grid=grid, probe_to_ras=pose,
    )  # fmt: skip


def compounded(probe, poses, grey, grid=None, hole_mm=None, spacing_mm=1.0) -> Volume:
    compounder = Compounder(grid or sweep_grid(probe, poses, spacing_mm), probe)
    for pose in poses:
        compounder.add(painted(probe, pose, grey))
    return compounder.volume(hole_mm)


def centres(volume: Volume) -> np.ndarray:
    """(k, j, i, 3) RAS of every voxel."""
    k, j, i = np.indices(volume.array.shape)
    return np.stack([i, j, k, np.ones_like(i)], axis=-1) @ volume.ijk_to_ras.T[:, :3]


def slope(points) -> np.ndarray:
    return 120 + 1.1 * points[..., 0] - 0.7 * points[..., 1] + 0.5 * points[..., 2]


@pytest.mark.slow
@settings(max_examples=8)
@given(
    angles=st.tuples(*[st.floats(-180, 180)] * 3),
    shift=st.tuples(*[st.floats(-20, 20)] * 3),
    spacing=st.tuples(*[st.floats(0.7, 1.6)] * 3),
    flips=st.tuples(*[st.sampled_from([-1, 1])] * 3),
    kind=st.sampled_from(["slide", "tilt", "freehand"]),
)
def test_every_voxel_has_the_grey_level_of_its_place(angles, shift, spacing, flips, kind):
    """Any sweep into any grid: a linear ramp in the patient comes out as that ramp."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    pose[:3, 3] = 0.2 * np.array(shift)
    sweep = {
        "slide": slide_sweep(pose, 12, 13),
        "tilt": tilt_sweep(pose, 20, 15),
        "freehand": freehand_sweep(pose, 12, 20),
    }
    matrix = np.diag([f * s for f, s in zip(flips, spacing, strict=True)] + [1.0])
    size = np.ceil(110.0 / np.array(spacing)).astype(int)
    matrix[:3, 3] = -0.5 * matrix[:3, :3] @ size
    grid = Volume(np.zeros(size[::-1], np.uint8), matrix)
    volume = compounded(PROBE, sweep[kind], slope, grid)
    np.testing.assert_array_equal(volume.ijk_to_ras, matrix)
    filled = volume.array > 0
    assert filled.sum() * np.prod(spacing) > 5000  # cubic millimetres
    error = (volume.array - slope(centres(volume)))[filled]
    # Up to a voxel from an image its grey level counts as it is: the ramp's slope times that.
    assert np.abs(error).max() < 1.4 * max(spacing) + 2.0
    assert np.sqrt((error**2).mean()) < 1.0


@pytest.mark.parametrize("kind", ["slide", "tilt"])
def test_holes_between_images_are_filled_and_nothing_else_is(kind):
    pose = rigid(np.eye(3), [0, 0, 0])
    poses = slide_sweep(pose, 24, 9) if kind == "slide" else tilt_sweep(pose, 40, 11)
    grid = sweep_grid(PROBE, poses, 0.8)
    raw, whole = (compounded(PROBE, poses, lambda p: 100 + 0 * p[..., 0], grid, hole_mm) for hole_mm in (0, None))
    assert (raw.array > 0).mean() < 0.9 * (whole.array > 0).mean()
    # Inside the swept region everything is filled, and with the images' level; far outside nothing is.
    points = centres(whole)
    if kind == "slide":
        place, aside = points[..., 1], np.abs(points[..., 2])
        inside = PROBE.holds(1.15 * points[..., 0], points[..., 1]) & (aside < 11.5) & (place > 1) & (place < 37)
        from_apex = points[..., 1] + PROBE.radius_mm
        radius, steer = np.hypot(points[..., 0], from_apex), np.degrees(np.arctan2(points[..., 0], from_apex))
        outside = (aside > 14.5) | (np.abs(steer) > 33) | (np.abs(radius - 50) > 21.5)
    else:
        place, angle = np.hypot(points[..., 1], points[..., 2]), np.degrees(np.arctan2(points[..., 2], points[..., 1]))
        inside = PROBE.holds(1.15 * points[..., 0], place) & (np.abs(angle) < 19) & (place > 2) & (place < 37)
        inside &= points[..., 1] > 0
        outside = (place > 43) | ((np.abs(angle) > 28) & (place > 15))
    assert inside.sum() > 5000
    assert (whole.array[inside] == 100).all()
    assert not whole.array[outside].any()


def test_holes_are_filled_up_to_the_widest_gap_of_an_uneven_sweep():
    """Images 1, 1, 6 and 2 mm apart: every layer of voxels between the first and the last one is filled."""
    places = np.array([0.0, 1.0, 2.0, 8.0, 10.0])
    poses = [rigid(np.eye(3), [0, 0, z]) for z in places]
    grid = sweep_grid(PROBE, poses, 1.0)
    whole, narrow = (compounded(PROBE, poses, lambda p: 100 + 0 * p[..., 0], grid, hole) for hole in (None, 1.0))
    points = centres(whole)
    x, y, z = np.moveaxis(points, -1, 0)
    # Away from the edge of the field, where a filled gap is slightly concave.
    inside = PROBE.holds(1.4 * x, y) & (y > 6) & (y < 29) & (z > 0) & (z < 10)
    gap = inside & (z > 3.5) & (z < 6.5)
    assert gap.sum() > 1000 and not narrow.array[gap].any()
    assert (whole.array[inside] == 100).all()


def test_the_grid_of_a_sweep_just_holds_its_field():
    """A voxel of margin on each side, and less than a voxel more."""
    poses = slide_sweep(rigid(np.eye(3), [3, -5, 11]), 12, 5)
    for spacing in (0.8, 1.7):
        grid = sweep_grid(PROBE, poses, spacing)
        points = np.concatenate([PROBE.outline_mm() @ pose[:3, :3].T + pose[:3, 3] for pose in poses])
        first = grid.ijk_to_ras[:3, 3]
        last = first + spacing * (np.array(grid.array.shape[::-1]) - 1)
        np.testing.assert_allclose(first, points.min(axis=0) - spacing)
        beyond = (last - points.max(axis=0)) / spacing
        assert (beyond >= 1 - 1e-9).all() and (beyond < 2).all()
    assert np.allclose(sweep_grid(PROBE, poses).spacing_mm, 0.5)


def test_images_that_overlap_are_averaged():
    pose = rigid(np.eye(3), [0, 0, 0])
    compounder = Compounder(sweep_grid(PROBE, [pose], 1.0), PROBE)
    for grey in (60, 120):
        compounder.add(painted(PROBE, pose, lambda p, grey=grey: grey + 0 * p[..., 0]))
    values = compounder.volume(0).array
    assert set(np.unique(values)) == {0, 90}


@pytest.mark.parametrize(("near", "far"), [(0.0, 0.5), (0.1, 0.9)])
def test_an_image_counts_the_less_the_farther_off_its_plane_is(near, far):
    """Two images beside a layer of voxels 1 mm apart: weights fall linearly to zero at one voxel."""
    matrix = np.diag([1.0, 1.0, 1.0, 1.0])
    matrix[:3, 3] = -20.0, 0.0, -3.0
    compounder = Compounder(Volume(np.zeros((7, 40, 40), np.uint8), matrix), PROBE)
    for offset, grey in ((near, 60), (far, 240)):
        pose = rigid(np.eye(3), [0, 0, offset])
        compounder.add(painted(PROBE, pose, lambda p, grey=grey: grey + 0 * p[..., 0]))
    weights = 1 - np.abs([near, far])
    layer = compounder.volume(0).array[3]
    assert (layer > 0).sum() > 500
    np.testing.assert_allclose(layer[layer > 0], weights @ [60, 240] / weights.sum(), atol=1.0)


@pytest.mark.slow
def test_a_simulated_volume_shows_a_cyst_where_it_is():
    """Slide and tilt in an oblique pose; the cyst's centre within half a voxel."""
    rotation = Rotation.from_euler("xyz", [20, 33, 11], degrees=True).as_matrix()
    centre = np.array([3.0, -2.0, 1.0])
    labels = block(
        lambda x, y, z: np.where((x - 3) ** 2 + (y + 2) ** 2 + (z - 1) ** 2 < 36, 0, 1), half_mm=(40, 40, 40)
    )
    quiet = simulator(labels, SPECKLE, coupling=SPECKLE.__class__("fluid", 1541.0, 1.607, 0.0))
    probe = LinearProbe(36, 45, scan_lines=96, focus_mm=25, elevation_focus_mm=25)
    pose = rigid(rotation, rotation.T @ centre + [0, -25, 0])
    for poses in (slide_sweep(pose, 20, 26), tilt_sweep(pose, 45, 31)):
        done = []
        volume = quiet.volume(probe, poses, spacing_mm=0.8, progress=done.append)
        assert done == list(range(1, len(poses) + 1))
        points = centres(volume)
        dark = (volume.array < 25) & (np.linalg.norm(points - centre, axis=-1) < 9)
        np.testing.assert_allclose(points[dark].mean(axis=0), centre, atol=0.4)
        # The beam's width makes it smaller, not larger.
        assert 0.4 < dark.sum() * 0.8**3 / (4 / 3 * np.pi * 6**3) < 1.0


def test_sweeps_that_cannot_be_compounded_are_refused():
    with pytest.raises(SimulationError, match="the sweep has no pose"):
        sweep_grid(PROBE, [])
    with pytest.raises(SimulationError, match="pose is not rigid"):
        sweep_grid(PROBE, [2.0 * np.eye(4) - np.diag([0, 0, 0, 1.0])])
    far = np.eye(4)
    far[:3, 3] = 5000.0
    with pytest.raises(SimulationError, match=r"voxels is too large; raise spacing_mm \(0.5\)"):
        sweep_grid(PROBE, [np.eye(4), far])
    with pytest.raises(SimulationError, match="spacing_mm is 0"):
        sweep_grid(PROBE, [np.eye(4)], 0.0)
    with pytest.raises(SimulationError, match="hole_mm is -1"):
        compounded(PROBE, [np.eye(4)], slope, hole_mm=-1)
    with pytest.raises(SimulationError, match="a sweep has 0 frames"):
        slide_sweep(np.eye(4), 10, 0)


@pytest.mark.slow
def test_the_command_writes_a_volume_that_lies_in_the_patient(tmp_path):
    labels = block(lambda x, y, z: np.where(y > 0, 1, 2), half_mm=(30, 30, 30), spacing_mm=2.0)
    labels.write(tmp_path / "labels.nii.gz")
    np.savetxt(tmp_path / "pose.txt", rigid(np.eye(3), [0, -28, 0]))
    out = tmp_path / "volume.nrrd"
    arguments = ["volume", str(tmp_path / "labels.nii.gz"), "--map", "ussim", "--pose", str(tmp_path / "pose.txt")]
    arguments += ["-o", str(out), "--overwrite"]
    result = CliRunner().invoke(main, [*arguments, "--slide", "10", "--frames", "6", "--spacing", "1.5"])
    assert result.exit_code == 0, result.output
    volume = Volume.read(out)
    assert volume.array.dtype == np.uint8 and volume.array.any()
    np.testing.assert_allclose(volume.spacing_mm, 1.5, atol=1e-5)
    # The field begins at the face, 28 mm before the origin, and reaches 90 mm from there.
    rows = np.flatnonzero(volume.array.any(axis=(0, 2))) * 1.5 + volume.ijk_to_ras[1, 3]
    assert rows.min() == pytest.approx(-28, abs=2.0)
    result = CliRunner().invoke(
        main, [*arguments, "--tilt", "20", "--frames", "5", "--like", str(tmp_path / "labels.nii.gz")]
    )
    assert result.exit_code == 0, result.output
    np.testing.assert_allclose(Volume.read(out).ijk_to_ras, labels.ijk_to_ras, atol=1e-5)


def test_the_command_wants_one_kind_of_sweep(tmp_path):
    options = ["--tilt", "10", "--slide", "10"]
    result = CliRunner().invoke(
        main, ["volume", "x.nii.gz", "--pose", "auto", "-o", str(tmp_path / "v.nrrd"), *options]
    )
    assert result.exit_code == 2
    assert result.stderr.strip() == "ussim: expected exactly one of --tilt DEGREES and --slide MILLIMETRES"
