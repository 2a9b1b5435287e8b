"""Calibration and registration of tracked ultrasound on the page: from files, from values, and by landmarks."""

from __future__ import annotations

import re

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
    click,
    cost,
    dismiss_messages,
    drawn,
    errors,
    eventually,
    first_page as first_page,
    in_view,
    open_new_patient,
    opened,
    picture,
    pytestmark as pytestmark,
    serving,
    settled,
    state,
    views,
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


def text(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:.9g}" for value in row) for row in matrix)


def fill(page, name: str, matrix: np.ndarray | str) -> None:
    page.fill(f"#{name}-values", matrix if isinstance(matrix, str) else text(matrix))
    click(page, "#calibrate" if name == "calibration" else "#register")
    settled(page)


def shown_pose(page, number: int) -> np.ndarray:
    page.evaluate("number => window.trame.trigger('show_number', [number])", number)
    settled(page)
    return np.array(page.evaluate("window.ussim.image.pose"))


@pytest.mark.long
def test_ultrasound_without_a_calibration_asks_for_it(page, recording):
    said = state(page, NAMES.opened)[0]
    assert said.endswith(
        "tracked ultrasound: 6 images of 624x512, transforms ProbeToTracker, ReferenceToTracker, StylusToTracker: its "
        "calibration is asked for in Tracked ultrasound"
    )
    assert state(page, NAMES.sequence.length) == 0 and "Tracked ultrasound" in state(page, NAMES.open_sections)
    assert "no path from Image to Reference" in page.locator("#calibration-from").inner_text()
    page.set_input_files("#calibration-file", recording["folder"] / "plus.xml")
    settled(page)
    assert page.locator("#calibration-from").inner_text() == "Calibration ImageToProbe of plus.xml"
    assert state(page, NAMES.sequence.length) == 6 and not errors(page)
    assert "none: the frame of the ultrasound is taken" in page.locator("#registration-from").inner_text()
    page.set_input_files("#registration-file", recording["folder"] / "registration.txt")
    settled(page)
    assert page.locator("#registration-from").inner_text() == "Registration registration.txt"
    for number in (0, 5):
        np.testing.assert_allclose(shown_pose(page, number), recording["poses"][number], atol=0.5)
    assert 0 < cost(page) < 0.5 and not errors(page)


@pytest.mark.long
def test_values_are_typed_and_wrong_ones_are_said_and_change_nothing(page, recording):
    fill(page, "calibration", "1 0 0")
    assert errors(page)[-1] == "Calibration has 3 numbers, expected 16 numbers, the 4x4 matrix by rows"
    page.fill("#calibration-name", "Image")
    fill(page, "calibration", recording["calibration"])
    assert errors(page)[-1] == "Its name is 'Image', expected two frames joined by To, such as ImageToProbe"
    page.fill("#calibration-name", "ImageToProbe")
    assert state(page, NAMES.sequence.length) == 0
    skewed = recording["calibration"] @ np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    fill(page, "calibration", skewed)
    assert "is skewed" in errors(page)[-1] and state(page, NAMES.sequence.length) == 0
    fill(page, "calibration", recording["calibration"])
    assert page.locator("#calibration-from").inner_text() == "Calibration ImageToProbe as typed"
    assert state(page, NAMES.sequence.length) == 6
    before = shown_pose(page, 2)
    fill(page, "registration", np.diag([2.0, 1.0, 1.0, 1.0]))
    assert errors(page)[-1].startswith("Registration is not rigid")
    np.testing.assert_array_equal(shown_pose(page, 2), before)
    fill(page, "registration", TO_RAS)
    np.testing.assert_allclose(shown_pose(page, 2), recording["poses"][2], atol=0.5)


def add(page, recording, number: int, pixel: tuple[float, float], off_mm=(0.0, 0.0, 0.0)) -> None:
    """Type a landmark of an image, which is found `off_mm` beside its place in the patient."""
    shown_pose(page, number)
    point = (recording["image_to_ras"][number] @ [*pixel, 0.0, 1.0])[:3] + off_mm
    page.fill("#landmark-pixel", f"{pixel[0]} {pixel[1]}")
    page.fill("#landmark-point", ", ".join(f"{value:.3f}" for value in point))
    click(page, "#add-landmark")
    settled(page)


@pytest.mark.long
def test_landmarks_register_and_what_remains_is_told(page, recording):
    page.set_input_files("#calibration-file", recording["folder"] / "plus.xml")
    settled(page)
    page.fill("#landmark-pixel", "-50 10")
    page.fill("#landmark-point", "1 2 3")
    click(page, "#add-landmark")
    settled(page)
    assert "column -50, expected 0 to 623" in errors(page)[-1] and not state(page, NAMES.registration.landmarks)
    assert page.locator("#landmark-pixel").input_value() == "-50 10"  # to be corrected
    add(page, recording, 0, (200.0, 150.0))
    add(page, recording, 0, (420.0, 160.0))
    click(page, "#fit-landmarks")
    settled(page)
    assert errors(page)[-1] == "2 pairs of landmarks, expected three or more"
    add(page, recording, 0, (310.0, 155.0))
    click(page, "#fit-landmarks")
    settled(page)
    assert re.match(r"landmarks in the ultrasound lie within .* mm of a line", errors(page)[-1])
    add(page, recording, 3, (300.0, 400.0))
    add(page, recording, 5, (330.0, 280.0), (3.0, 0.0, 0.0))
    click(page, "#fit-landmarks")
    settled(page)
    found = page.locator("#registration-from").inner_text()
    left = float(re.search(r"5 landmarks agree to ([0-9.]+) mm \(root mean square\)", found)[1])
    assert 0.3 < left < 3.0
    remaining = [float(line["remaining"].split()[0]) for line in state(page, NAMES.registration.landmarks)]
    assert np.argmax(remaining) == 4 and np.sqrt(np.mean(np.square(remaining))) == pytest.approx(left, abs=0.01)
    page.get_by_role("button", name="Remove landmark 5").click()
    click(page, "#fit-landmarks")
    settled(page)
    assert "4 landmarks agree to 0.00 mm" in page.locator("#registration-from").inner_text()
    np.testing.assert_allclose(shown_pose(page, 4), recording["poses"][4], atol=0.5)
    assert 0 < cost(page) < 0.5


@pytest.mark.long
def test_a_landmark_is_picked_in_the_real_image_and_in_a_slice(page, recording):
    page.set_input_files("#calibration-file", recording["folder"] / "plus.xml")
    settled(page)
    page.set_input_files("#registration-file", recording["folder"] / "registration.txt")
    settled(page)
    shown_pose(page, 1)
    click(page, "#pick-landmark")
    page.locator("#picking").get_by_text("click the landmark in the real image").wait_for()
    box = page.locator("#real canvas").bounding_box()
    page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 0.6 * box["height"])
    page.locator("#picking").get_by_text("click the same landmark in a slice view").wait_for()
    page.mouse.click(*in_view(views(page)[1], 0.5, 0.5))
    eventually(page, lambda: len(state(page, NAMES.registration.landmarks)) == 1)
    (line,) = state(page, NAMES.registration.landmarks)
    column, row = map(float, line["ultrasound"].removeprefix("image 1: ").split(","))
    assert abs(column - 312) < 2 and abs(row - 307) < 4  # of 624x512
    in_image = np.linalg.inv(recording["image_to_ras"][1]) @ [*map(float, line["patient"].split(",")), 1.0]
    assert abs(in_image[2]) < 0.5  # the view is in the image plane
    # It is drawn where it was clicked: in the real image of its number, and in the views
    mark, (x, y) = page.locator(".ussim-landmark"), in_view(views(page)[1], 0.5, 0.5)
    assert mark.inner_text() == "1"
    at, box = mark.bounding_box(), page.locator("#real canvas").bounding_box()
    assert at["x"] == pytest.approx(box["x"] + 0.5 * box["width"], abs=3)
    assert at["y"] == pytest.approx(box["y"] + 0.6 * box["height"], abs=3)
    drawn(page)
    near = picture(page, {"x": x - 12, "y": y - 12, "width": 24, "height": 24})
    assert ((near[..., 0] > 200) & (abs(near[..., 1] - 158) < 40) & (near[..., 2] < 110)).any()  # orange
    shown_pose(page, 2)
    assert mark.count() == 0
    shown_pose(page, 1)
    click(page, "#pick-landmark")
    eventually(page, lambda: state(page, NAMES.registration.picking) == "ultrasound")
    page.mouse.move(600, 500)
    page.keyboard.press("Escape")
    eventually(page, lambda: page.locator("#picking").inner_text() == "")
    assert len(state(page, NAMES.registration.landmarks)) == 1 and not errors(page)


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
