"""Point spread function by the width of the speckle (fitting/speckle_fit.py): a start, taken only with T2."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import (
    ConvexProbe,
    DisplaySettings,
    SimulationSettings,
    TissueTable,
    TrackedSequence,
    UltrasoundSimulator,
)
from SlicerUSSim.Logic.fitting import fit_speckle
from SlicerUSSim.Logic.fitting.speckle_fit import BAND_SIGMA, PointSpread, point_spread, with_point_spread
from SlicerUSSim.Logic.fitting.speckle_width import SpeckleWidth
from SlicerUSSim.Logic.probe import ImageGrid, tilt_sweep
from SlicerUSSim.Logic.tracked import TrackedImages
from tests.conftest import block, rigid

TRUE = ConvexProbe(12.0, 70.0, 45.0, scan_lines=180, fractional_bandwidth=0.35, aperture_mm=9.0)
GIVEN = replace(TRUE, fractional_bandwidth=0.8, aperture_mm=16.0)
LABELS = block(lambda x, y, z: np.ones_like(x), half_mm=(40, 36, 12))
EVEN = TissueTable.named(["liver"]).replace("liver", texture_db=0.0, specks_per_mm3=0.0)
SHOWN = DisplaySettings(look="even", gain_db=4.0, noise_db=None, image_size=(300, 320))


def recorded(smoothing_mm: float = 0.0) -> TrackedImages:
    """Images of the true probe, by way of a scanner that smooths or not, with the given one for the probe's file."""
    made = UltrasoundSimulator(LABELS, EVEN, SimulationSettings(seed=11, ring_down=False))
    poses = tilt_sweep(rigid(np.eye(3), [0.0, -24.0, 0.0]), 6.0, 2)
    shown = replace(SHOWN, smoothing_axial_mm=smoothing_mm, smoothing_lateral_deg=3.0 * smoothing_mm)
    images = np.stack([made.simulate(TRUE, pose, shown).image for pose in poses])
    to_probe = ImageGrid.for_probe(TRUE, SHOWN.image_size).image_to_probe
    transforms = tuple({"ImageToProbe": to_probe, "ProbeToReference": pose} for pose in poses)
    return TrackedImages.of(TrackedSequence(images, transforms, np.arange(2.0)), probe=GIVEN)


def test_band_and_aperture_follow_from_the_widths_and_frequency_does_not():
    depth = np.array([15.0, 28.0, 40.0])
    lateral = TRUE.speckle_sigma_mm(depth)
    widths = [SpeckleWidth(d, 0.2 + 0.01 * n, w, 9) for n, (d, w) in enumerate(zip(depth, lateral, strict=True))]
    found = point_spread(widths, GIVEN)
    assert found.band_mhz == pytest.approx(BAND_SIGMA / 0.2)
    assert found.aperture_mm_mhz == pytest.approx(9.0 * TRUE.frequency_mhz, rel=0.12)
    made = found.of(GIVEN)
    assert made.frequency_mhz == GIVEN.frequency_mhz
    assert made.fractional_bandwidth == pytest.approx(found.band_mhz / GIVEN.frequency_mhz)
    assert made.aperture_mm == pytest.approx(9.0, rel=0.12)
    assert "the frequency itself cannot be known" in found.in_words()
    assert found.to_dict()["frequency_mhz"] is None
    nothing = point_spread([SpeckleWidth(20.0, float("nan"), float("nan"), 0)], GIVEN)
    assert nothing.of(GIVEN) == GIVEN and json.dumps(nothing.to_dict(), allow_nan=False)


@pytest.mark.slow
def test_a_probe_whose_speckle_is_too_fine_gets_the_true_one_back():
    tracked = recorded()
    made = UltrasoundSimulator(LABELS, EVEN, SimulationSettings(seed=2, ring_down=False))
    first = fit_speckle(made, tracked, EVEN, SHOWN, factors=(1.0,))
    found, images = with_point_spread(made, tracked, first, SHOWN)
    assert found.spread is not None and found.spread.is_taken is True
    assert images.probe.fractional_bandwidth == pytest.approx(0.35, rel=0.3)
    assert images.probe.aperture_mm == pytest.approx(9.0, rel=0.3)
    assert found.after.total < first.after.total and found.after.extrema <= first.after.extrema


@pytest.mark.long
def test_what_is_wide_by_smoothing_is_not_taken_for_the_point_spread():
    """The true probe, whose images a scanner smooths: its widths would say another one."""
    tracked = replace(recorded(0.2), probe=TRUE)
    made = UltrasoundSimulator(LABELS, EVEN, SimulationSettings(seed=2, ring_down=False))
    first = fit_speckle(made, tracked, EVEN, SHOWN, factors=(1.0,))
    found, images = with_point_spread(made, tracked, first, SHOWN)
    assert found.spread is not None and found.spread.is_taken is False
    assert found.spread.band_mhz < 0.8 * TRUE.frequency_mhz * TRUE.fractional_bandwidth
    assert images.probe == TRUE and found.display == first.display
    assert "not taken" in found.spread.in_words()
    assert isinstance(found.spread, PointSpread)
