"""The pictures of docs/workstation.md: python examples/workstation_pictures.py OUT_FOLDER

The console with the demo brain in headless Chromium: still, and while the probe moves.

Needs pip install "SlicerUSSim[serve]" playwright, and Chromium.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright

FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
#: Pictures of a round and milliseconds of each
FRAMES, FRAME_MS = 56, 120


def move(page: Page, **degrees: float) -> None:
    """Set angles of the probe, and wait until image and views show them."""
    for name, value in degrees.items():
        page.evaluate("([name, value]) => window.trame.trigger('set_pose', [name, value])", [name, value])
    page.evaluate("window.trame.trigger('at_rest')")
    page.wait_for_timeout(400)


def pictures(address: str, folder: Path) -> None:
    """Write workstation.png and workstation-moving.webp."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1440, "height": 860})
        page.goto(address)
        page.wait_for_function("window.ussim?.images > 0", timeout=120_000)
        move(page, tilt_deg=0.0)
        page.wait_for_timeout(4000)  # until the views are sharp
        still = Image.open(io.BytesIO(page.screenshot())).convert("RGB").quantize(256, dither=Image.Dither.NONE)
        still.save(folder / "workstation.png", optimize=True)
        page.set_viewport_size({"width": 1200, "height": 740})
        frames = []
        for turn in np.linspace(0.0, 2.0 * np.pi, FRAMES, endpoint=False):
            move(page, tilt_deg=18.0 * np.sin(turn), rock_deg=14.0 * np.sin(2.0 * turn))
            shot = page.screenshot(clip={"x": 0, "y": 0, "width": 1200, "height": 714})  # without the rate of images
            frames.append(Image.open(io.BytesIO(shot)).convert("RGB").resize((900, 536), Image.Resampling.LANCZOS))
        browser.close()
    moving = folder / "workstation-moving.webp"
    frames[0].save(moving, save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, quality=50, method=6)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "SlicerUSSim.Command.cli", "serve", "--port", "0", "--no-autosave"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        pictures(server.stdout.readline().strip(), folder)
    finally:
        server.terminate()
        server.wait(20)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
