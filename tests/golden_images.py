"""One image per shipped probe as it was when somebody last looked at it, to see what a change does to all of them.

    python -m tests.golden_images              tells how much today's images differ; with --show DIR also pictures of
                                               those that do: before, now, and eight times the difference
    python -m tests.golden_images --accept     writes today's images to tests/golden

Commit accepted images together with the change, and say in the message what it does to them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from SlicerUSSim.Logic import DisplaySettings, TissueTable, UltrasoundSimulator, Volume
from SlicerUSSim.Logic.probe import PROBES, pose_looking_at

FOLDER = Path(__file__).parent / "golden"
#: Rows and columns of the images: pixels of .2 to 1 mm
SIZE = (224, 192)
#: Height of the patient's surface and of the middle, mm
_TOP = 84.0
_SPACING = 1.5
POSE = pose_looking_at((0.0, 0.0, _TOP + 1.0), (0.0, 0.0, 0.0))


def patient() -> tuple[Volume, TissueTable]:
    """Brain with ventricles, folded grey matter, a tumour and a plate that casts a shadow, in voxels of 1.5 mm."""
    half = np.array([57.0, 33.0, _TOP])
    x, y, z = np.meshgrid(*[np.arange(-h, h + 0.1, _SPACING) for h in half], indexing="ij")
    depth = _TOP - z
    labels = np.full(x.shape, 3, np.uint8)
    folds = 7.0 + 2.5 * np.sin(x / 4.0 + 1.0) * np.cos(y / 5.0)
    labels[depth < folds] = 2
    labels[(depth < folds - 3.5) & (np.abs((x + 3.0) % 17.0 - 8.5) < 1.6)] = 1
    for centre, radius in (((-9, 0, 22), 5.0), ((12, 4, 38), 8.0), ((-22, -3, 62), 11.0), ((18, 0, 110), 16.0)):
        labels[(x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (depth - centre[2]) ** 2 < radius**2] = 1
    labels[(x - 2) ** 2 + y**2 + (depth - 14) ** 2 < 16.0] = 4
    labels[(x + 24) ** 2 + y**2 + (depth - 92) ** 2 < 196.0] = 4
    labels[(np.abs(depth - 50 - 0.3 * x) < 1.5) & (x > 22) & (x < 34)] = 5
    ijk_to_ras = np.diag([_SPACING, _SPACING, _SPACING, 1.0])
    ijk_to_ras[:3, 3] = -half
    tissues = TissueTable.brain(("csf", "grey matter", "white matter", "tumour", "bone"))
    return Volume(np.ascontiguousarray(labels.transpose(2, 1, 0)), ijk_to_ras), tissues


def images() -> dict[str, np.ndarray]:
    """{name of a probe: (rows, columns) uint8}, with each probe's defaults, 1 mm above the brain."""
    simulator = UltrasoundSimulator(*patient())
    display = DisplaySettings(image_size=SIZE)
    return {name: simulator.simulate(probe, POSE, display, noise_seed=1).image for name, probe in PROBES.items()}


def golden(name: str) -> np.ndarray | None:
    """(rows, columns) uint8 of the accepted image; None if there is none."""
    path = FOLDER / f"{name}.png"
    return np.asarray(Image.open(path)) if path.exists() else None


def difference(one: np.ndarray, other: np.ndarray) -> str:
    """How much two images differ, in words; "" if as much as those of two devices may."""
    if one.shape != other.shape:
        return f"has {one.shape[1]}x{one.shape[0]} pixels, before {other.shape[1]}x{other.shape[0]}"
    levels = np.abs(one.astype(int) - other)
    if np.mean(levels > 1) <= 0.002 and np.mean(levels > 8) <= 0.0002:
        return ""
    return (
        f"{np.mean(levels > 1):.1%} of the pixels differ by more than a level, by {levels[levels > 0].mean():.1f} on "
        f"average and by {levels.max()} at most; mean {other.mean():.1f} -> {one.mean():.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--accept", action="store_true", help="write today's images to tests/golden")
    parser.add_argument("--show", type=Path, metavar="DIR", help="write pictures of what differs into this folder")
    options = parser.parse_args()
    for name, image in images().items():
        before = golden(name)
        what = "is new" if before is None else difference(image, before)
        print(f"{name:14s} {what or 'as before'}")
        if options.show and before is not None and what and before.shape == image.shape:
            options.show.mkdir(parents=True, exist_ok=True)
            change = np.clip(128 + 8 * (image.astype(int) - before), 0, 255).astype(np.uint8)
            Image.fromarray(np.hstack([before, image, change])).save(options.show / f"{name}.png")
        if options.accept and what:
            FOLDER.mkdir(exist_ok=True)
            Image.fromarray(image).save(FOLDER / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
