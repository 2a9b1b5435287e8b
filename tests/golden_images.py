"""One image per shipped probe as it was when somebody last looked at it, to see what a change does to all of them.

    python -m tests.golden_images              tells how much today's images differ; with --show DIR also pictures of
                                               those that do: before, now, and eight times the difference
    python -m tests.golden_images --accept     writes today's images to tests/golden, and those of
                                               `ussim check` to SlicerUSSim/Logic/imaging/golden

Commit accepted images together with the change, and say in the message what it does to them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from SlicerUSSim.Logic import UltrasoundSimulator
from SlicerUSSim.Logic.imaging.self_check import FAMILIES, GOLDEN, difference, golden_image, golden_scene, golden_view
from SlicerUSSim.Logic.probe import PROBES

FOLDER = Path(__file__).parent / "golden"


def images() -> dict[str, np.ndarray]:
    """{name of a probe: (rows, columns) uint8}, with each probe's defaults, 1 mm above the brain."""
    simulator = UltrasoundSimulator(*golden_scene())
    return {name: golden_view(simulator, probe).image for name, probe in PROBES.items()}


def accepted(name: str) -> Path:
    """The file of a probe's accepted image: one per family is in the package, for `ussim check`."""
    return (GOLDEN if name in FAMILIES else FOLDER) / f"{name}.png"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--accept", action="store_true", help="write today's images in their place")
    parser.add_argument("--show", type=Path, metavar="DIR", help="write pictures of what differs into this folder")
    options = parser.parse_args()
    for name, image in images().items():
        path = accepted(name)
        before = golden_image(path) if path.exists() else None
        what = "is new" if before is None else difference(image, before)
        print(f"{name:14s} {what or 'as before'}")
        if options.show and before is not None and what and before.shape == image.shape:
            options.show.mkdir(parents=True, exist_ok=True)
            change = np.clip(128 + 8 * (image.astype(int) - before), 0, 255).astype(np.uint8)
            Image.fromarray(np.hstack([before, image, change])).save(options.show / f"{name}.png")
        if options.accept and what:
            Image.fromarray(image).save(path, optimize=True)


if __name__ == "__main__":
    main()
