"""Performance of the browser workstation: start-up time, images per second and latency while dragging, memory.

    python -m benchmarks.dragging [--device intel --device pocl] [--seconds 10] [--frames 2000] [--json FILE]

Starts `ussim serve` with the demo brain, opens it in headless Chromium, drags the probe with the mouse in a slice view
and in the 3D view. Server, browser and playwright share the processor. Needs playwright and Chromium.
"""

from __future__ import annotations

import argparse
import math
import shutil
import subprocess
import sys
from contextlib import contextmanager, suppress
from time import perf_counter
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright

from benchmarks.measuring import output_file, resident_mb
from SlicerUSSim.Logic.base import write_json
from SlicerUSSim.Logic.opencl import list_devices
from SlicerUSSim.Workstation.state import NAMES

FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
#: Position of the probe's body in a view, as fractions of its width and height, at the craniotomy of the demo brain.
GRIPS = {"slice view": (1, 0.5, 0.12), "3D view": (0, 0.3, 0.3)}
#: Frames before the first measurement of memory, after which one-time allocations are complete.
WARM_UP_FRAMES = 300


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--device", action="append", help="see `ussim devices`; may be repeated (default: each once)")
    parser.add_argument("--seconds", type=float, default=10.0, help="of dragging, in each view")
    parser.add_argument("--frames", type=int, default=2000, help="over which memory is measured; 0: not measured")
    parser.add_argument("--json", type=output_file, help="write the results to this file")
    arguments = parser.parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        raise SystemExit("benchmarks/dragging.py: Chromium is missing, install it with: apt-get install chromium")
    results = {}
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        for device in arguments.device or [info.index for info in list_devices()]:
            results[device] = numbers = measured(browser, device, arguments.seconds, arguments.frames)
            print(f"{device}: usable after {numbers['usable_s']:.1f} s")
            for view in GRIPS:
                drag = numbers[view]
                print(
                    f"  dragging in the {view:10s} {drag['images_per_s']:5.1f} images/s, mouse to image "
                    f"{drag['median_ms']:4.0f} ms, 95 % within {drag['p95_ms']:4.0f} ms"
                )
            if arguments.frames:
                memory = numbers["memory"]
                for owner in ("server", "page"):
                    was, now = memory[f"{owner}_mb"]
                    print(f"  memory of the {owner} {was:.0f} -> {now:.0f} MB over {memory['frames']} images")
    if arguments.json:
        write_json(arguments.json, results)


def measured(browser, device: str, seconds: float, frames: int) -> dict:
    """All results of one device."""
    start = perf_counter()
    with serving(device) as (url, process):
        page = browser.new_page(viewport={"width": 1500, "height": 900})
        page.goto(url)
        page.wait_for_function("window.ussim && window.ussim.images > 0", timeout=120_000)
        result: dict[str, Any] = {"usable_s": perf_counter() - start}
        _rest(page)
        for name, (number, across, down) in GRIPS.items():
            page.evaluate("window.trame.trigger('press', ['placeButton'])")
            _rest(page)
            box = page.locator(".ussim-anatomy .remote-controlled-area").nth(number).bounding_box()
            result[name] = dragged(page, box["x"] + across * box["width"], box["y"] + down * box["height"], seconds)
        if frames:
            result["memory"] = watched(page, process, frames)
        page.close()
    return result


def dragged(page: Page, x: float, y: float, seconds: float) -> dict[str, float]:
    """Images per second, then milliseconds from mouse to image, while the mouse moves back and forth."""
    page.mouse.move(x, y)
    page.mouse.down()
    images = _move(page, x, y, seconds)
    _set(page, NAMES.show_latency, True)
    page.wait_for_function("window.ussim.measuring")
    _rest(page)
    page.evaluate("window.ussim.measured.length = 0")  # discard images with the stamp of an earlier drag
    _move(page, x, y, seconds)
    times = page.evaluate("window.ussim.measured")
    page.mouse.up()
    _set(page, NAMES.show_latency, False)
    if len(times) < 5:
        raise SystemExit(f"benchmarks/dragging.py: only {len(times)} images came of dragging at {x:.0f}, {y:.0f}")
    return {
        "images_per_s": images,
        "median_ms": float(np.median(times)),
        "p95_ms": float(np.percentile(times, 95)),
        "measured": len(times),
    }


def _set(page: Page, name: object, value: object) -> None:
    """Set one of NAMES on the page."""
    page.evaluate("([name, value]) => window.trame.state.set(name, value)", [name, value])


def _rest(page: Page) -> None:
    """Wait until the server has completed all requests, and for the views to be drawn."""
    page.evaluate("window.trame.trigger('at_rest')")
    page.wait_for_timeout(1500)


def _move(page: Page, x: float, y: float, seconds: float) -> float:
    """Images per second."""
    before, start, step = page.evaluate("window.ussim.images"), perf_counter(), 0
    while perf_counter() - start < seconds:
        step += 1
        page.mouse.move(x + 40 * math.sin(step / 20), y + 4 * math.sin(step / 33))
        page.wait_for_timeout(8)
    return (page.evaluate("window.ussim.images") - before) / (perf_counter() - start)


def watched(page: Page, process: subprocess.Popen, frames: int) -> dict:
    """Memory of server and page before and after this number of images."""
    session = page.context.new_cdp_session(page)

    def page_mb() -> float:
        session.send("HeapProfiler.collectGarbage")
        return page.evaluate("performance.memory.usedJSHeapSize") / 2**20

    def run(count: int) -> None:
        end, step = page.evaluate("window.ussim.images") + count, 0
        while page.evaluate("window.ussim.images") < end:
            step += 1
            for name, angle in (("rock_deg", 20 * math.sin(step / 15)), ("tilt_deg", 15 * math.sin(step / 23))):
                page.evaluate("([n, v]) => window.trame.trigger('set_pose', [n, v])", [name, angle])

    run(WARM_UP_FRAMES)
    before = resident_mb(process.pid), page_mb()
    run(frames)
    after = resident_mb(process.pid), page_mb()
    return {"frames": frames, "server_mb": [before[0], after[0]], "page_mb": [before[1], after[1]]}


@contextmanager
def serving(device: str):
    """(URL, process) of `ussim serve`."""
    process = subprocess.Popen(
        [sys.executable, "-m", "SlicerUSSim.Command.cli", "serve", "--port", "0", "--device", device],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None and process.stderr is not None, "both are pipes"
    try:
        url = process.stdout.readline().strip()
        if not url.startswith("http"):
            raise SystemExit(process.stderr.read().strip())
        yield url, process
    finally:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(10)
        process.kill()


if __name__ == "__main__":
    main()
