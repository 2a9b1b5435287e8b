"""Real beside simulated: python -m benchmarks.realism_pictures SEQUENCE --image N --source NAME=LABELS,PRESET ...

One column for the real image, one for every source, and one for a picture of another program (--other NAME=FILE), in
equal millimetres: the whole field, a part of it at its own pixels, and the same magnified. LABELS is a label map; the
PRESET has probe, display and tissues, as from `ussim optimize --save-preset`; a third file has sheets, as from `ussim
segment --sheets`. --credit is written below.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from SlicerUSSim.Logic import Preset, TrackedSequence, UltrasoundSimulator, Volume
from SlicerUSSim.Logic.fitting.tracked_fit import simulated
from SlicerUSSim.Logic.mri.sheets.polydata import read_surfels
from SlicerUSSim.Logic.tracked import TrackedImages

_GAP, _HEAD, _MAGNIFIED = 6, 18, 3


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--image", type=int, required=True)
    parser.add_argument("--source", action="append", default=[], help="NAME=LABELS,PRESET[,SHEETS]")
    parser.add_argument("--other", help="NAME=FILE: a picture with the real image's pixel size, pasted as it is")
    parser.add_argument("--other-at", type=int, nargs=2, default=(0, 0), help="column and row of its face in FILE")
    parser.add_argument("--part", type=int, nargs=4, required=True, help="columns and rows from the field's corner")
    parser.add_argument("--credit", default="")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    sequence = TrackedSequence.read(options.sequence)
    columns: list[tuple[str, np.ndarray]] = []
    for text in options.source:
        name, files = text.split("=", 1)
        labels, preset_file, *sheets = files.split(",")
        preset = Preset.read(preset_file)
        tracked = TrackedImages.of(sequence, [options.image], probe=preset.probe)
        if not columns:
            real = np.where(tracked.mask, tracked.images[0], 0).astype(np.uint8)
            columns.append((f"real, image {options.image}", real))
            shown = tracked
        surfels = read_surfels(sheets[0]) if sheets else None
        simulator = UltrasoundSimulator(Volume.read(labels), preset.tissues, preset.settings, sheets=surfels)
        (image,) = simulated(simulator, tracked, preset.tissues, preset.display)
        columns.append((name, np.where(tracked.mask, image, 0).astype(np.uint8)))
    if options.other:
        name, file = options.other.split("=", 1)
        columns.insert(1, (name, _placed(np.asarray(Image.open(file).convert("L")), options.other_at, shown)))
    _draw(columns, options.part, options.credit).save(options.out)


def _placed(picture: np.ndarray, face: tuple[int, int], tracked: TrackedImages) -> np.ndarray:
    """(rows, columns) of the tracked images, with the picture's face where theirs is."""
    grid = tracked.grid
    column, row = (
        round(-edge / size) for edge, size in zip((grid.left_mm, grid.top_mm), grid.pixel_spacing_mm, strict=True)
    )
    rows, columns = np.indices(tracked.mask.shape)
    y, x = rows - row + face[1], columns - column + face[0]
    inside = (y >= 0) & (y < len(picture)) & (x >= 0) & (x < picture.shape[1])
    found = np.zeros(tracked.mask.shape, np.uint8)
    found[inside] = picture[y[inside], x[inside]]
    return np.where(tracked.mask, found, 0).astype(np.uint8)


def _draw(columns: list[tuple[str, np.ndarray]], part: tuple[int, int, int, int], credit: str) -> Image.Image:
    left, right, top, bottom = part
    rows, width = columns[0][1].shape
    high, wide = bottom - top, right - left
    whole = Image.new(
        "L", (len(columns) * (width + _GAP), 2 * _HEAD + rows + high * (1 + _MAGNIFIED) + 2 * _GAP + _HEAD)
    )
    draw = ImageDraw.Draw(whole)
    for place, (name, image) in enumerate(columns):
        x = place * (width + _GAP)
        draw.text((x + 4, 3), name, fill=255)
        whole.paste(Image.fromarray(image), (x, _HEAD))
        draw.rectangle((x + left, _HEAD + top, x + right, _HEAD + bottom), outline=120)
        piece = Image.fromarray(image[top:bottom, left:right])
        whole.paste(piece, (x, _HEAD + rows + _GAP))
        magnified = piece.resize((wide * _MAGNIFIED, high * _MAGNIFIED), Image.Resampling.NEAREST)
        whole.paste(magnified, (x, _HEAD + rows + high + 2 * _GAP))
    draw.text((4, whole.height - _HEAD), credit, fill=200)
    return whole


if __name__ == "__main__":
    main()
