"""The image of every shipped probe is as it was when somebody last looked at it."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic import UltrasoundSimulator
from SlicerUSSim.Logic.imaging.self_check import FAMILIES, GOLDEN, difference, golden_image, golden_scene, golden_view
from SlicerUSSim.Logic.probe import PROBES
from tests.golden_images import FOLDER, accepted, images

#: Factors of values in the record of a frame that an image is to be different for
WRONG_RECORDS = {
    "elevation_sigma": 1.1, "transmit_sigma": 1.2,
    "transmit_focus": 1.2, "transmit_rayleigh": 1.3, "receive_sigma_min": 1.1, "receive_sigma_slope": 1.1,
    "speckle_scale": 1.05, "cell_mm": 1.01, "cycles_per_mm": 1.01, "sample_mm": 1.01, "line_spacing": 1.01,
    "first_line": 1.02, "apex_radius_mm": 1.05, "interface_gain": 2.0, "membrane_reach": 1.2, "beam_cutoff": 0.7,
    "reference_speed_m_s": 1.01, "frequency_mhz": 1.1, "fractional_bandwidth": 2.0,
    "membrane_gain": 1.1, "membrane_exponent": 1.5, "screen_step": 1.2, "fan_step": 1.3,
}  # fmt: skip


def test_images_are_those_that_were_accepted():
    found = {name: difference(image, golden_image(accepted(name))) for name, image in images().items()}
    changed = [f"{name}: {what}" for name, what in found.items() if what]
    assert not changed, "\n".join([*changed, "look at them: python -m tests.golden_images --show DIR"])


def test_accepted_images_exist_once_and_those_of_the_package_are_small():
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


def test_a_wrong_value_in_the_record_of_a_frame_is_noticed(monkeypatch):
    simulator, golden = UltrasoundSimulator(*golden_scene()), golden_image(accepted("microconvex"))
    right = simulator.acquisition
    unnoticed = []
    for field, factor in WRONG_RECORDS.items():

        def wrong(*inputs, field=field, factor=factor):
            record = right(*inputs)
            record[field] *= factor
            return record

        monkeypatch.setattr(simulator, "acquisition", wrong)
        image = golden_view(simulator, PROBES["microconvex"]).image
        unnoticed += [] if difference(image, golden) else [field]
    assert not unnoticed
