"""What is cancelled ends within a second, the server within two; images go on beside files and surfaces."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading
from time import monotonic, sleep

import pytest

pytest.importorskip("greenlet", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")

from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Workstation.tasks import Tasks
from tests.test_browser_parts import run_in_loop


def test_what_does_not_hear_of_its_cancellation_is_abandoned_within_a_second():
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


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT])
def test_the_server_ends_within_two_seconds_whatever_it_computes(tmp_path, end):
    """It took 110 s while it extracted a brain."""
    mri = head_mri(1.0)
    mri.write(tmp_path / "head.nii.gz")
    server = subprocess.Popen(
        [sys.executable, "-m", "SlicerUSSim.Command.cli", "serve", "--port", "0", str(tmp_path / "head.nii.gz"),
         "--skull-strip", "atlas"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    try:
        assert server.stdout.readline().startswith("http")
        sleep(1.5)  # it segments
        start = monotonic()
        server.send_signal(end)
        _, errors = server.communicate(timeout=60)
        took = monotonic() - start
    finally:
        server.kill()
    start = monotonic()
    subprocess.run([sys.executable, "-c", "import numpy, scipy.ndimage, SimpleITK"], check=True)
    usual = monotonic() - start  # about half a second, and more on a busy machine
    assert took < 1.0 + 2.0 * usual and "Traceback" not in errors, (took, usual, errors[-500:])
