"""Calibration and registration of tracked ultrasound on the page, from files."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")

from SlicerUSSim.Logic.tracked.pose_files import write_pose
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence
from SlicerUSSim.Workstation.state import NAMES
from tests.conftest import rigid
from tests.test_workstation import (
    answer_new_patient,
    browser as browser,
    cost,
    dismiss_messages,
    errors,
    eventually,
    first_page as first_page,
    open_new_patient,
    open_section,
    opened,
    pytestmark as pytestmark,
    serving,
    settled,
    state,
)

#: Where the marker is on the probe, the tracker's frame, and that of the reference in the patient
MARKER = rigid(Rotation.from_euler("xyz", [20, -70, 110], degrees=True).as_matrix(), [12, -40, 7])
TRACKER = rigid(Rotation.from_euler("xyz", [-80, 15, 40], degrees=True).as_matrix(), [300, 20, -150])
TO_RAS = rigid(Rotation.from_euler("xyz", [35, -25, 160], degrees=True).as_matrix(), [-60, 90, 30])


@pytest.fixture(scope="module")
def recording(files, tmp_path_factory) -> dict:
    """The sweep of the head as an optical tracker records it, without its calibration, and what is known about it."""
    sweep = TrackedSequence.read(files / "sweep.igs.mha")
    to_probe = np.array(sweep.transforms[0]["ImageToProbe"])
    poses = [np.array(entry["ProbeToReference"]) for entry in sweep.transforms]
    tracked = tuple(
        {
            "ProbeToTracker": TRACKER @ np.linalg.inv(TO_RAS) @ pose @ np.linalg.inv(MARKER),
            "ReferenceToTracker": TRACKER,
            "StylusToTracker": TRACKER,
        }
        for pose in poses
    )
    folder = tmp_path_factory.mktemp("recording")
    TrackedSequence(sweep.images, tracked, sweep.timestamps).write(folder / "phantom.igs.mha")
    calibration = MARKER @ to_probe
    numbers = " ".join(f"{value:.9g}" for value in calibration.ravel())
    (folder / "plus.xml").write_text(
        "<PlusConfiguration><CoordinateDefinitions>"
        f'<Transform From="Image" To="Probe" Matrix="{numbers}"/></CoordinateDefinitions></PlusConfiguration>'
    )
    np.savetxt(folder / "registration.txt", TO_RAS)
    return {"folder": folder, "calibration": calibration, "poses": poses, "image_to_ras": [p @ to_probe for p in poses]}


@pytest.fixture(scope="module")
def url(files):
    with serving(str(files / "head.nii.gz"), "--labels", str(files / "labels.nii.gz")) as address:
        yield address


@pytest.fixture
def page(first_page, recording, files):
    """The page with the head, its labels, and the recording as it is in its file."""
    page, problems = first_page
    dismiss_messages(page)
    if state(page, NAMES.title) != "labels.nii.gz":
        open_new_patient(page, files / "labels.nii.gz")
    page.set_input_files("#open-file", recording["folder"] / "phantom.igs.mha")
    settled(page)
    yield page
    assert not problems


def shown_pose(page, number: int) -> np.ndarray:
    page.evaluate("number => window.trame.trigger('show_number', [number])", number)
    settled(page)
    return np.array(page.evaluate("window.ussim.image.pose"))


@pytest.mark.long
def test_ultrasound_without_a_calibration_asks_for_it(page, recording):
    said = state(page, NAMES.opened)[0]
    assert said.endswith(
        "tracked ultrasound: 6 images of 624x512, transforms ProbeToTracker, ReferenceToTracker, StylusToTracker: "
        "enter its calibration in Tracked ultrasound"
    )
    assert state(page, NAMES.sequence.length) == 6 and not state(page, NAMES.sequence.is_placed)
    assert "no path from Image to Reference" in page.locator("#calibration-from").inner_text()
    page.set_input_files("#calibration-file", recording["folder"] / "plus.xml")
    settled(page)
    assert page.locator("#calibration-from").inner_text() == "Calibration ImageToProbe of plus.xml"
    assert state(page, NAMES.sequence.length) == 6 and not errors(page)
    assert "none: the frame of the ultrasound is assumed" in page.locator("#registration-from").inner_text()
    page.set_input_files("#registration-file", recording["folder"] / "registration.txt")
    settled(page)
    assert page.locator("#registration-from").inner_text() == "Registration registration.txt"
    for number in (0, 5):
        np.testing.assert_allclose(shown_pose(page, number), recording["poses"][number], atol=0.5)
    assert 0 < cost(page) < 0.5 and not errors(page)


@pytest.mark.long
def test_wrong_calibrations_and_registrations_are_reported_without_effect(page, recording, tmp_path):
    def sent(name: str, matrix: np.ndarray) -> None:
        np.savetxt(tmp_path / "matrix.txt", matrix)
        page.set_input_files(f"#{name}-file", tmp_path / "matrix.txt")
        settled(page)

    sent("calibration", np.ones((1, 3)))
    assert "matrix.txt" in errors(page)[-1]
    open_section(page, "Tracked ultrasound")
    page.fill("#calibration-name", "Image")
    sent("calibration", recording["calibration"])
    assert errors(page)[-1] == "transform is 'Image', expected two frames joined by To, such as ImageToReference"
    page.fill("#calibration-name", "ImageToProbe")
    skewed = recording["calibration"] @ np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    sent("calibration", skewed)
    assert "is skewed" in errors(page)[-1] and not state(page, NAMES.sequence.is_placed)
    sent("calibration", recording["calibration"])
    assert page.locator("#calibration-from").inner_text() == "Calibration ImageToProbe of matrix.txt"
    before = shown_pose(page, 2)
    sent("registration", np.diag([2.0, 1.0, 1.0, 1.0]))
    assert "not rigid" in errors(page)[-1]
    np.testing.assert_array_equal(shown_pose(page, 2), before)


@pytest.mark.long
def test_a_transform_is_a_pose_or_of_the_ultrasound_that_comes_next(browser, recording, files, tmp_path):
    with serving("--labels", str(files / "labels.nii.gz")) as address:
        page = opened(browser, address)
        settled(page)
        wanted = np.array(page.evaluate("window.ussim.image.pose"))
        wanted[:3, :3] = np.linalg.svd(wanted[:3, :3])[0] @ np.linalg.svd(wanted[:3, :3])[2]  # the page rounds
        wanted[:3, 3] += [0.0, 0.0, 2.0]
        write_pose(tmp_path / "moved.tfm", wanted)
        page.set_input_files("#open-file", tmp_path / "moved.tfm")
        answer_new_patient(page, "Pose of the probe")
        settled(page)
        np.testing.assert_allclose(page.evaluate("window.ussim.image.pose"), wanted, atol=2e-3)
        assert state(page, NAMES.opened)[-1].endswith("the probe is moved there") and not errors(page)
        page.set_input_files("#open-file", recording["folder"] / "registration.txt")
        answer_new_patient(page, "Registration")
        settled(page)
        page.set_input_files("#open-file", recording["folder"] / "plus.xml")
        eventually(page, lambda: "plus.xml" in "".join(state(page, NAMES.opened)))
        settled(page)
        assert "calibration of the tracked ultrasound that is opened next" in state(page, NAMES.opened)[-1]
        page.set_input_files("#open-file", recording["folder"] / "phantom.igs.mha")
        eventually(page, lambda: state(page, NAMES.sequence.length) == 6)
        settled(page)
        assert page.locator("#registration-from").inner_text() == "Registration registration.txt"
        assert "plus.xml" in page.locator("#calibration-from").inner_text() and not errors(page)
        np.testing.assert_allclose(shown_pose(page, 3), recording["poses"][3], atol=0.5)
        page.close()
