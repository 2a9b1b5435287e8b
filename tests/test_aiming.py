"""A probe in an opening: aimed at a lesion below it, and what its notes say about bone before it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import Volume
from SlicerUSSim.Logic.mri.pathology import add_tissues
from SlicerUSSim.Logic.placement.aiming import FARTHEST_DEG, opening_pose
from SlicerUSSim.Logic.placement.bone_before_probe import CLOSED_DB, about_bone, about_missing_skull
from SlicerUSSim.Logic.placement.craniotomy import default_pose, disc_opening, middle_of, opened, without_outside
from SlicerUSSim.Logic.placement.views import view_pose
from SlicerUSSim.Logic.probe import PROBES, ConvexProbe, LinearProbe, Probe
from SlicerUSSim.Logic.probe.poses import pose_looking_at, turned
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Widget.interface import in_panel
from tests.test_craniotomy import NAMES, TOP, head, places_of  # noqa: F401

ILL = (*NAMES, "tumour", "oedema")
TUMOUR, OEDEMA = len(ILL) - 1, len(ILL)
ON_SKIN = pose_looking_at((0.0, 0.0, 78.5), (0.0, 0.0, 0.0))


def with_ball(labels: Volume, centre, radius_mm: float, label: int = TUMOUR) -> Volume:
    """Labels with a ball in the brain."""
    inside = (np.linalg.norm(places_of(labels) - centre, axis=-1) <= radius_mm) & (labels.array == 2)
    return labels.with_array(np.where(inside, label, labels.array).astype(np.uint8))


def with_disc(labels: Volume, diameter_mm: float) -> tuple[Volume, np.ndarray]:
    """(labels with a disc opened at the vertex, the middle of what was removed)"""
    found, _ = opened(labels, ILL, disc_opening(labels, ILL, TOP, diameter_mm))
    return found, middle_of(labels, found)


def off_axis_mm(pose: np.ndarray, place) -> float:
    across, _, up = (np.linalg.inv(pose) @ [*place, 1.0])[:3]
    return float(np.hypot(across, up))


def notes_of(labels: Volume, probe: Probe, pose: np.ndarray, *, is_open: bool, names=ILL):
    return about_bone(labels, names, TISSUES.values(), probe, pose, is_open=is_open)


@pytest.mark.slow
def test_a_probe_in_an_opening_looks_at_the_tumour_below_it(head):  # noqa: F811
    place = np.array([10.0, 8.0, 35.0])
    labels, middle = with_disc(with_ball(head, place, 7.0), 40.0)
    pose, line = opening_pose(labels, ILL, PROBES["phased"], middle)
    assert off_axis_mm(pose, place) < 1.5
    upright, nothing = opening_pose(with_disc(head, 40.0)[0], NAMES, PROBES["phased"], middle)
    assert nothing == "" and off_axis_mm(upright, place) > 10.0
    np.testing.assert_allclose(upright[:3, 1], [0.0, 0.0, -1.0], atol=0.03)  # without a lesion along the normal
    angle = np.rad2deg(np.arccos(pose[:3, 1] @ upright[:3, 1]))
    assert line == f"aimed at the tumour, {angle:.0f} degrees off the surface's normal" and 20.0 < angle < 30.0


@pytest.mark.slow
def test_veins_are_not_a_lesion(head):  # noqa: F811
    """With contrast agent a class of the T1 is what enhances, and a probe was aimed at the sinus as "the enhancing"."""
    vein, tumour, names = np.array([10.0, 8.0, 35.0]), np.array([-12.0, 0.0, 30.0]), (*ILL, "enhancing")
    labels, middle = with_disc(with_ball(head, vein, 7.0, len(names)), 40.0)
    pose, line = opening_pose(labels, names, PROBES["phased"], middle)
    assert line == "" and off_axis_mm(pose, vein) > 10.0
    ring = with_ball(with_ball(head, tumour, 7.0, len(names)), vein, 9.0, len(names))
    inside = np.linalg.norm(places_of(head) - tumour, axis=-1) <= 5.0
    labels, middle = with_disc(ring.with_array(np.where(inside, TUMOUR, ring.array).astype(np.uint8)), 40.0)
    pose, line = opening_pose(labels, names, PROBES["phased"], middle)
    assert line.startswith("aimed at the ") and off_axis_mm(pose, tumour) < 2.5  # with its rim, and not the larger vein


def test_of_what_was_laid_over_a_tumour_comes_before_its_larger_oedema(head):  # noqa: F811
    """The probe was aimed at the oedema, which surrounds the tumour on one side, or at nothing, as it was too far."""
    place = {"tumour": np.array([10.0, 8.0, 35.0]), "oedema": np.array([-14.0, 0.0, 20.0])}
    masks = {
        name: head.with_array((np.linalg.norm(places_of(head) - place[name], axis=-1) <= radius).astype(np.uint8))
        for name, radius in (("tumour", 6.0), ("oedema", 14.0))
    }
    for order, first in ((("tumour", "oedema"), "tumour"), (("oedema", "tumour"), "tumour"), (("oedema",), "oedema")):
        added = add_tissues(head, NAMES, [(name, masks[name], name) for name in order], has_brain_mask=False)
        np.testing.assert_allclose(added.centre_ras(head), place[first], atol=3.0)


def test_the_edge_of_a_turned_face_lies_on_the_surface(head):  # noqa: F811
    """A flat face of 38 mm that is turned by 25 degrees about its middle would be 5 mm in the brain with one edge."""
    probe = PROBES["linear"]
    labels, middle = with_disc(with_ball(head, [14.0, 0.0, 35.0], 7.0), 60.0)
    pose, _ = opening_pose(labels, ILL, probe, middle)
    across = np.linspace(-0.5, 0.5, 31) * probe.face_mm
    radius = np.linalg.norm(probe.face_points_mm(across) @ pose[:3, :3].T + pose[:3, 3], axis=1)
    assert 57.0 < radius.min() < 61.5  # the brain's is 60
    assert off_axis_mm(pose, [14.0, 0.0, 35.0]) < 1.5


def test_a_lesion_too_far_aside_is_reported_and_not_aimed_at(head):  # noqa: F811
    labels, middle = with_disc(with_ball(head, [45.0, 0.0, 15.0], 7.0), 40.0)
    pose, line = opening_pose(labels, ILL, PROBES["phased"], middle)
    np.testing.assert_allclose(pose[:3, 1], [0.0, 0.0, -1.0], atol=0.03)
    assert line == (
        "not aimed at the tumour, which is 44 degrees off the surface's normal at the opening, "
        f"more than {FARTHEST_DEG:.0f}"
    )


@pytest.mark.slow
def test_the_largest_lesion_in_reach_is_aimed_at_and_oedema_last(head):  # noqa: F811
    far, large, small = [-50.0, 0.0, 0.0], [10.0, 0.0, 30.0], [-10.0, 0.0, 40.0]
    labels = head
    for centre, radius in ((far, 9.0), (large, 7.0), (small, 4.0)):
        labels = with_ball(labels, centre, radius)
    labels, middle = with_disc(with_ball(labels, [0.0, 15.0, 20.0], 12.0, OEDEMA), 40.0)
    pose, _ = opening_pose(labels, ILL, PROBES["phased"], middle)
    assert off_axis_mm(pose, large) < 1.5
    swollen, middle = with_disc(with_ball(head, [0.0, 15.0, 20.0], 12.0, OEDEMA), 40.0)
    pose, line = opening_pose(swollen, ILL, PROBES["phased"], middle)
    assert off_axis_mm(pose, [0.0, 15.0, 20.0]) < 1.5 and "aimed at the oedema, " in line


@pytest.mark.slow
def test_specks_are_not_lesions_and_one_before_the_face_needs_no_turn(head):  # noqa: F811
    labels, middle = with_disc(with_ball(head, [10.5, 0.0, 34.5], 2.0), 40.0)
    assert 0 < (labels.array == TUMOUR).sum() * labels.voxel_ml < 0.05
    assert opening_pose(labels, ILL, PROBES["phased"], middle)[1] == ""
    labels, middle = with_disc(with_ball(head, [4.5, 0.0, 56.0], 3.0), 40.0)
    pose, line = opening_pose(labels, ILL, PROBES["phased"], middle)
    assert line == "the tumour lies in front of the face"
    np.testing.assert_allclose(pose[:3, 1], [0.0, 0.0, -1.0], atol=0.03)


def test_the_target_of_a_caller_comes_before_lesions_of_the_labels(head):  # noqa: F811
    labels, middle = with_disc(with_ball(with_ball(head, [12.0, 0.0, 30.0], 7.0), [-8.0, 0.0, 30.0], 5.0, OEDEMA), 40.0)
    pose, line = opening_pose(labels, ILL, PROBES["phased"], middle, np.array([-8.0, 0.0, 30.0]))
    assert off_axis_mm(pose, [-8.0, 0.0, 30.0]) < 1e-6 and "aimed at the oedema, " in line


# ---- bone before the probe ------------------------------------------------------------------------------------------


def test_a_face_that_does_not_fit_an_opening_is_reported_with_both_sizes(head):  # noqa: F811
    wide = ConvexProbe(radius_mm=60.0, field_of_view_deg=60.0, depth_mm=120.0, frequency_mhz=3.5)
    labels, middle = with_disc(head, 30.0)
    for pose in (ON_SKIN, opening_pose(labels, ILL, wide, middle)[0]):  # over the opening, and on the brain in it
        (line,) = notes_of(labels, wide, pose, is_open=True)
        assert line.startswith("the face of the probe is 60 mm wide and does not fit the opening, which leaves ")
        assert float(line.split("leaves ")[1].split(" mm")[0]) == pytest.approx(30.0, abs=3.0)
        assert line.endswith("mm of it free: expect black sectors where it lies on bone or lifts off")
        assert notes_of(labels, PROBES["phased"], pose, is_open=True) == ()
    narrow, _ = with_disc(head, 10.0)
    thick = replace(PROBES["phased"], aperture_mm=8.0, elevation_aperture_mm=20.0)
    assert "is 20 mm thick and does not fit the opening" in notes_of(narrow, thick, ON_SKIN, is_open=True)[0]


def test_an_aimed_face_fits_the_opening_that_was_made_for_it(head):  # noqa: F811
    probe = PROBES["convex"]
    whole = with_ball(head, [14.0, 0.0, 35.0], 7.0)
    labels, _ = opened(whole, ILL, disc_opening(whole, ILL, TOP, max(probe.face_mm, probe.elevation_aperture_mm) + 10))
    pose, line = opening_pose(labels, ILL, probe, middle_of(whole, labels))
    assert line.startswith("aimed at the tumour") and notes_of(labels, probe, pose, is_open=True) == ()


def test_a_closed_skull_that_leaves_no_signal_is_reported(head):  # noqa: F811
    probe = PROBES["phased"]
    pose = default_pose(head, NAMES, probe)
    (line,) = notes_of(head, probe, pose, is_open=False, names=NAMES)
    assert line.startswith("the skull is closed in front of the probe, and 7 mm of bone take ")  # 6 mm obliquely
    assert float(line.split("take ")[1].split(" dB")[0]) > CLOSED_DB
    assert "open the skull (--craniotomy auto, disc:MM or a file; Open skull" in line
    labels, _ = with_disc(head, 30.0)
    assert notes_of(labels, probe, ON_SKIN, is_open=True) == ()
    elsewhere = pose_looking_at((78.5, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    (line,) = notes_of(labels, probe, elsewhere, is_open=True)
    assert "the skull is closed in front of the probe" in line and "the opening is elsewhere (" in line


@pytest.mark.slow
def test_a_skull_is_not_called_closed_where_the_brain_is_seen(head):  # noqa: F811
    pose, _ = view_pose(head, NAMES, "temporal")
    lower = replace(PROBES["transcranial"], frequency_mhz=1.2)
    assert notes_of(head, lower, pose, is_open=False) == ()
    (line,) = notes_of(head, PROBES["transcranial"], pose, is_open=False)  # an adult's vertex was dark without a word
    assert line.endswith("on the page) lets them through")
    assert notes_of(head, PROBES["phased"], pose, is_open=False)  # 5 MHz do not: the image is black
    brain = without_outside(head, NAMES)
    assert notes_of(brain, PROBES["phased"], default_pose(brain, NAMES, PROBES["phased"]), is_open=False) == ()
    away = turned(ON_SKIN, rock_deg=180.0)
    assert notes_of(head, PROBES["phased"], away, is_open=False) == ()
    no_skull = ["bone" if name == "skull" else name for name in NAMES]
    assert notes_of(head, PROBES["phased"], ON_SKIN, is_open=False, names=no_skull) == ()
    labels, _ = with_disc(head, 10.0)  # of a wide face: the lines of a quarter of it see the brain
    assert not any("closed" in line for line in notes_of(labels, LinearProbe(38, 60), ON_SKIN, is_open=True))


def test_a_probe_below_a_closed_skull_triggers_a_warning(head):  # noqa: F811
    below = TOP.copy()
    below[:3, 3] += 25.0 * TOP[:3, 1]
    (line,) = notes_of(head, PROBES["phased"], below, is_open=False, names=NAMES)
    assert line.startswith("the probe is below the closed skull, with ") and "open the skull" in line
    opened_there = with_disc(head, 60.0)[0]
    assert notes_of(opened_there, PROBES["phased"], below, is_open=True) == ()


def test_a_head_whose_skull_is_not_labelled_triggers_a_warning(head):  # noqa: F811
    """It was imaged straight through the skull without a word."""
    mri = Volume(
        np.array([5.0, *(90.0 if "skull" not in name else 10.0 for name in NAMES)])[head.array], head.ijk_to_ras
    )
    brain = without_outside(head, NAMES)
    (line,) = about_missing_skull(brain, NAMES[:2], mri)
    assert "tick Label tissues outside the brain and press Segment" in in_panel(line)
    assert about_missing_skull(head, NAMES, mri) == about_missing_skull(brain, ["liver"], mri) == ()
    stripped = mri.with_array(np.where(brain.array > 0, mri.array, 0.0))
    assert about_missing_skull(brain, NAMES[:2], stripped) == ()
