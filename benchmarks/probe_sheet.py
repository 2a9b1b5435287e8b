"""Speckle with a cyst by every probe preset, side by side in one picture, for the eye.

    python -m benchmarks.probe_sheet PICTURE.png [--folder FOLDER]

The tissue is uniform, of 0.5 dB/(cm MHz); at the transmit focus is a black sphere of 10 mm (4 mm for 10 MHz and more).
With --folder every image is also written unscaled, one PNG each.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from SlicerUSSim.Logic import TissueTable, UltrasoundSimulator, Volume
from SlicerUSSim.Logic.probe import PROBES
from SlicerUSSim.Logic.probe.arrays import Probe
from validation.phantoms import BACKGROUND

COLUMNS, HEIGHT, GAP, TITLE = 4, 224, 6, 16


def image_of(probe: Probe, device: str | None) -> np.ndarray:
    """(rows, columns) uint8 image of the sphere in the tissue; the probe frame is the patient's."""
    radius = 2.0 if probe.frequency_mhz >= 10.0 else 5.0
    spacing = radius / 20.0
    axis = np.arange(-24, 25) * spacing
    x, y, z = np.meshgrid(axis, axis, axis)
    labels = np.where(x**2 + y**2 + z**2 < radius**2, 2, 1).astype(np.uint8)
    matrix = np.diag([spacing, spacing, spacing, 1.0])
    matrix[:3, 3] = axis[0] + np.array([0.0, probe.focus_mm, 0.0])
    cyst = replace(BACKGROUND, name="cyst", mu0=0.0, sigma0=0.0)
    tissues = TissueTable({0: BACKGROUND, 1: BACKGROUND, 2: cyst})  # the tissue continues around the volume
    return UltrasoundSimulator(Volume(labels, matrix), tissues, device=device).simulate(probe, np.eye(4)).image


def tile(name: str, probe: Probe, image: np.ndarray) -> Image.Image:
    """The image, HEIGHT pixels high, under the name, frequency and depth of its probe."""
    width = round(image.shape[1] * HEIGHT / image.shape[0])
    result = Image.new("L", (width, HEIGHT + TITLE))
    result.paste(Image.fromarray(image).resize((width, HEIGHT), Image.Resampling.BOX), (0, TITLE))
    ImageDraw.Draw(result).text((2, 2), f"{name}  {probe.frequency_mhz:g} MHz, {probe.depth_mm:g} mm", fill=255)
    return result


def sheet(tiles: list[Image.Image]) -> Image.Image:
    """All tiles in rows of COLUMNS, each in the middle of its column."""
    wide = max(part.width for part in tiles) + GAP
    high = HEIGHT + TITLE + GAP
    result = Image.new("L", (COLUMNS * wide, -(-len(tiles) // COLUMNS) * high))
    for number, part in enumerate(tiles):
        row, column = divmod(number, COLUMNS)
        result.paste(part, (column * wide + (wide - part.width) // 2, row * high))
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("picture", help="PNG to write")
    parser.add_argument("--folder", type=Path, help="folder for the unscaled images")
    parser.add_argument("--device", help="see `ussim devices`")
    arguments = parser.parse_args()
    images = {name: image_of(probe, arguments.device) for name, probe in PROBES.items()}
    if arguments.folder:
        arguments.folder.mkdir(parents=True, exist_ok=True)
        for name, image in images.items():
            Image.fromarray(image).save(arguments.folder / f"{name}.png")
    sheet([tile(name, PROBES[name], image) for name, image in images.items()]).save(arguments.picture, optimize=True)
    print(f"{len(images)} probes: {arguments.picture}")


if __name__ == "__main__":
    main()
