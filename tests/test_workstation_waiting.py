"""What is cancelled ends at once, and so does the server; images go on beside surfaces."""

from __future__ import annotations

import asyncio
import shutil
import subprocess
import sys
import threading

import numpy as np
import pytest

pytest.importorskip("greenlet", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")

from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Workstation.state import NAMES
from SlicerUSSim.Workstation.tasks import Tasks
from tests.test_browser_parts import run_in_loop
from tests.test_workstation import (
    answer_new_patient,
    browser as browser,
    click,
    dismiss_messages,
    errors,
    first_page as first_page,
    open_new_patient,
    pixels,
    pytestmark as pytestmark,
    serving,
    settled,
    shown_errors,
    state,
)


@pytest.mark.slow
def test_what_does_not_hear_of_its_cancellation_is_abandoned():
    async def scenario():
        goes_on, happened, renewed = threading.Event(), [], []
        tasks = Tasks(happened.append)
        begun = threading.Event()

        def long() -> str:
            begun.set()
            assert goes_on.wait(150)
            return "too late"

        waiting = []

        def task() -> None:
            from greenlet import getcurrent

            waiting.append(getcurrent())
            try:
                happened.append(tasks.do(long))
            except Cancelled:
                happened.append("cancelled")

        tasks.start(task)
        while not begun.is_set():
            await asyncio.sleep(0.01)
        tasks.start(lambda: happened.append(tasks.do(lambda: "an image")))  # behind it
        await asyncio.sleep(0.05)
        assert happened == []
        waits = []  # seconds that the loop is asked to wait, whatever the machine makes of them
        loop = asyncio.get_running_loop()
        later = loop.call_later
        loop.call_later = lambda delay, *rest, **more: (waits.append(delay), later(delay, *rest, **more))[1]
        tasks.abandonSoon(waiting[0], lambda: True, lambda: renewed.append(1))
        while not tasks.are_done:
            await asyncio.sleep(0.01)
        loop.call_later = later
        is_blocked = not goes_on.is_set()
        goes_on.set()
        await asyncio.sleep(0.1)
        return sorted(happened), renewed, sum(wait for wait in waits if wait > 0.05), is_blocked

    happened, renewed, waited, is_blocked = run_in_loop(scenario)
    assert happened == ["an image", "cancelled"] and renewed == [1] and is_blocked and 0.0 < waited < 1.0


@pytest.mark.slow
def test_images_do_not_wait_for_what_needs_no_device():
    async def scenario():
        goes_on, done = threading.Event(), []
        tasks = Tasks(done.append)
        tasks.start(lambda: done.append(tasks.doAside(lambda: goes_on.wait(150) and "a surface")))
        tasks.start(lambda: done.append(tasks.do(lambda: "an image")))
        while not done:
            await asyncio.sleep(0.01)
        first = list(done)
        goes_on.set()
        while not tasks.are_done:
            await asyncio.sleep(0.01)
        return first, done

    assert run_in_loop(scenario) == (["an image"], ["an image", "a surface"])


_ENDS_DURING_A_CALL_BACK = """
import threading, time, types
import SimpleITK as sitk
from SlicerUSSim.Command.serve import _run
from SlicerUSSim.Workstation.tasks import Tasks

begun, tasks = threading.Event(), Tasks(print)

def compute():
    smooth = sitk.CurvatureFlowImageFilter()
    smooth.SetNumberOfIterations(10**8)
    smooth.AddCommand(sitk.sitkProgressEvent, begun.set)  # from C++ back to Python, again and again
    smooth.Execute(sitk.Image(16, 16, 16, sitk.sitkFloat32))

class Slow:  # Python's end takes a while
    def __del__(self):
        time.sleep(0.5)

time.slow = Slow()
tasks._worker.submit(compute)
handlers = types.SimpleNamespace(add=lambda function: None)
_run(
    types.SimpleNamespace(
        server=types.SimpleNamespace(
            controller=types.SimpleNamespace(on_server_bind=handlers, on_server_ready=handlers),
            start=lambda **options: begun.wait(),
        ),
        take_token=lambda port: "token", end_session=lambda: print("session ended"),
        is_computing=begun.wait() and tasks.are_computing,
    ),
    "127.0.0.1", 0, None,
)
"""


@pytest.mark.slow
def test_the_server_ends_without_a_word_while_a_library_calls_back():
    """ "FATAL: exception not rethrown", or an abort."""
    ended = subprocess.run(
        [sys.executable, "-c", _ENDS_DURING_A_CALL_BACK], capture_output=True, text=True, timeout=300
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "session ended\n", "")


# ---- on the page -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def url(files):
    with serving("--labels", str(files / "labels.nii.gz")) as address:
        yield address


@pytest.fixture
def page(first_page, files):
    page, problems = first_page
    page.mouse.move(600, 500)
    settled(page)
    if state(page, NAMES.title) != "labels.nii.gz":
        open_new_patient(page, files / "labels.nii.gz")
    yield page
    assert not problems and not errors(page)


_AT_WORK = f"title => window.trame.state.get('{NAMES.messages.progress_title}') === title"


def cancel(page) -> None:
    """Press Cancel and wait until the page shows that nothing is under way."""
    page.evaluate("document.getElementById('cancel').click()")  # playwright waits until a button stands still
    page.wait_for_function(_AT_WORK, arg="")


def image_during(page, title: str) -> None:
    """Assert that the image follows the probe while something is under way."""
    count = page.evaluate("window.ussim.images")
    page.keyboard.press("a")
    page.wait_for_function("n => window.ussim.images > n", arg=count)
    assert page.evaluate(_AT_WORK, title)


@pytest.fixture(scope="module")
def large(tmp_path_factory, files):
    """Labels of a ball in voxels of 1 mm, with their table."""
    folder = tmp_path_factory.mktemp("large")
    k, j, i = np.ogrid[-119.5:120, -119.5:120, -119.5:120]
    away = k**2 + j**2 + i**2
    ball = sum((away < radius**2).astype(np.uint8) for radius in (60.0, 90.0, 110.0))
    Volume(ball, np.eye(4)).write(folder / "ball.nii.gz")
    shutil.copy(files / "labels.json", folder / "ball.json")
    return folder


@pytest.mark.slow
def test_a_surface_has_progress_and_can_be_cancelled_while_images_go_on(page, large):
    """A surface held all images for 42 s."""
    page.set_input_files("#open-file", [large / "ball.nii.gz", large / "ball.json"])
    answer_new_patient(page)
    page.wait_for_function(_AT_WORK, arg="Make the surface")
    cancel(page)
    settled(page)
    assert state(page, NAMES.title) == "ball.nii.gz" and state(page, NAMES.pose) is None
    assert state(page, NAMES.messages.status).startswith("no surface of the patient") and pixels(page).any()
    click(page, "#look")
    page.wait_for_function(_AT_WORK, arg="Make the surface")
    image_during(page, "Make the surface")
    settled(page)
    assert abs(state(page, NAMES.pose)["lift_mm"]) < 5


@pytest.mark.slow
def test_a_surface_of_a_patient_who_was_closed_meanwhile_is_not_shown(page, large):
    page.set_input_files("#open-file", [large / "ball.nii.gz", large / "ball.json"])
    answer_new_patient(page)
    page.wait_for_function(_AT_WORK, arg="Make the surface")
    page.evaluate("window.trame.trigger('press', ['closePatient'])")
    page.wait_for_function("window.ussim.image === null")
    settled(page)
    assert state(page, NAMES.title) == "" and state(page, NAMES.pose) is None
    page.keyboard.press("ArrowRight")  # along no surface
    settled(page)
    assert state(page, NAMES.pose) is None and page.evaluate("window.ussim.image") is None


@pytest.mark.slow
def test_exports_are_for_whom_has_the_token(page, browser, url):
    other = browser.new_context()
    address = f"{url.split('?')[0]}exported?kind="
    assert other.request.get(f"{address}json").status == 403
    found = page.request.get(f"{address}json")
    assert found.status == 200 and found.headers["cache-control"] == "no-store" and "probe" in found.json()
    assert page.request.get(f"{address}../secret").status == 204
    shown_errors(page)  # the message comes by the page's socket, after the answer
    assert errors(page) == ["the export is '../secret', expected one of the menu"]
    dismiss_messages(page)
    other.close()
