"""The image of every shipped probe is as it was when somebody last looked at it."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.imaging.self_check import FAMILIES, GOLDEN, difference, golden_image
from SlicerUSSim.Logic.probe import PROBES
from tests.golden_images import FOLDER, accepted, images


def test_images_are_those_that_were_accepted():
    found = {name: difference(image, golden_image(accepted(name))) for name, image in images().items()}
    changed = [f"{name}: {what}" for name, what in found.items() if what]
    assert not changed, "\n".join([*changed, "look at them: python -m tests.golden_images --show DIR"])


def test_every_accepted_image_exists_once_and_those_of_the_package_are_small():
    assert {path.stem for path in FOLDER.glob("*.png")} == set(PROBES) - set(FAMILIES)
    assert {path.stem for path in GOLDEN.iterdir()} == set(FAMILIES)
    assert sum(path.stat().st_size for path in GOLDEN.iterdir()) < 100_000


def test_a_change_of_the_image_is_one_and_that_of_a_device_is_none():
    image = golden_image(accepted("phased"))
    rng = np.random.default_rng(0)
    rounded = np.clip(image.astype(int) + rng.integers(-1, 2, image.shape), 0, 255).astype(np.uint8)
    assert difference(rounded, image) == "" == difference(image, image)
    brighter = np.clip(image.astype(int) + 3, 0, 255).astype(np.uint8)  # about a decibel of gain
    assert "of the pixels differ by more than a level, by 3.0 on average" in difference(brighter, image)
    assert "has 192x223 pixels, before 192x224" in difference(image[1:], image)
    spot = image.copy()
    spot[60:70, 100:110] = 255 - spot[60:70, 100:110]
    assert difference(spot, image)
