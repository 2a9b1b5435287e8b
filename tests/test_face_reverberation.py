"""Reverberation between the probe's face and what reflects to it (kernels/face_hits.cl)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import SimulationError, SimulationSettings, TissueTable, UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe
from tests.conftest import FLUID, block, rigid

BONE = replace(FLUID, name="bone", impedance_mrayl=3.0 * FLUID.impedance_mrayl, attenuation_db_cm_mhz=5.0)
REFLECTION = 0.5  # of the amplitude, between them
DEPTH_MM = 14.0
SETTINGS = SimulationSettings(ring_down=False, scattering=False)


def plate(tilt_deg: float = 0.0) -> UltrasoundSimulator:
    """Bone below a plane through the origin."""
    slope = np.tan(np.deg2rad(tilt_deg))
    labels = block(lambda x, y, z: 1 + (y > slope * x), half_mm=(32, 32, 14))
    return UltrasoundSimulator(labels, TissueTable({0: FLUID, 1: FLUID, 2: BONE}), SETTINGS)


def peak(simulator: UltrasoundSimulator, probe: Probe, depth_mm: float) -> tuple[float, float]:
    """(depth in mm, level in dB) of the brightest echo of the middle lines within 1.5 mm of a depth."""
    frame = simulator.simulate(probe, rigid(np.eye(3), [0.0, 0.5 - DEPTH_MM, 0.0]))
    middle = len(frame.iq) // 2
    depth = (np.arange(frame.iq.shape[1]) + 0.5) * frame.sample_interval_mm
    near = np.abs(depth - depth_mm) < 1.5
    line = np.abs(frame.iq[middle - 2 : middle + 3][:, near]).mean(axis=0)
    return float(depth[near][line.argmax()]), float(20.0 * np.log10(line.max() + 1e-12))


@pytest.mark.parametrize("name", ["linear", "phased", "convex"])
@pytest.mark.parametrize("reflection", [0.25, 0.8])
def test_a_plane_has_its_image_at_twice_the_depth(name, reflection):
    probe, simulator = replace(PROBES[name], face_reflection=reflection), plate()
    (first, level), (second, image) = (peak(simulator, probe, n * DEPTH_MM) for n in (1, 2))
    assert second == pytest.approx(2.0 * first, abs=0.15)
    assert image - level == pytest.approx(20.0 * np.log10(REFLECTION * reflection), abs=1.5)


def test_without_a_face_or_an_echo_to_it_there_is_no_image():
    probe, simulator = PROBES["linear"], plate()
    level = peak(simulator, probe, DEPTH_MM)[1]
    assert peak(simulator, replace(probe, face_reflection=0.0), 2.0 * DEPTH_MM)[1] < level - 100.0
    assert peak(simulator, probe, 3.0 * DEPTH_MM - 2.0)[1] < level - 100.0  # once
    # At 35 degrees reflected rays pass beside the face, at 12 they meet it so obliquely that their echo vanishes
    assert peak(plate(35.0), probe, 2.0 * DEPTH_MM)[1] < level - 100.0
    assert peak(plate(12.0), probe, 2.0 * DEPTH_MM)[1] < level - 60.0


def test_a_face_reflects_no_more_than_all():
    for wrong in (-0.1, 1.5, float("nan")):
        with pytest.raises(SimulationError, match=r"face_reflection is .*, expected a number between 0 and 1"):
            replace(PROBES["linear"], face_reflection=wrong)
