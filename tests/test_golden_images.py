"""The image of every shipped probe is as it was when somebody last looked at it."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.probe import PROBES
from tests.golden_images import FOLDER, difference, golden, images


def test_images_are_those_that_were_accepted():
    assert {path.stem for path in FOLDER.glob("*.png")} == set(PROBES)
    changed = []
    for name, image in images().items():
        before = golden(name)
        assert before is not None
        what = difference(image, before)
        if what:
            changed.append(f"{name}: {what}")
    assert not changed, "\n".join([*changed, "look at them: python -m tests.golden_images --show DIR"])


def test_a_change_of_the_image_is_one_and_that_of_a_device_is_none():
    image = golden("phased")
    assert image is not None
    rng = np.random.default_rng(0)
    rounded = np.clip(image.astype(int) + rng.integers(-1, 2, image.shape), 0, 255).astype(np.uint8)
    assert difference(rounded, image) == "" == difference(image, image)
    brighter = np.clip(image.astype(int) + 3, 0, 255).astype(np.uint8)  # about a decibel of gain
    assert "of the pixels differ by more than a level, by 3.0 on average" in difference(brighter, image)
    assert "has 192x223 pixels, before 192x224" in difference(image[1:], image)
    spot = image.copy()
    spot[60:70, 100:110] = 255 - spot[60:70, 100:110]
    assert difference(spot, image)
