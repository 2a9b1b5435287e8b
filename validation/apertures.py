"""Checks of what sectors and lenses do to a beam (docs/physics.md#steered-lines, docs/physics.md#the-lens).

Predictions are sums over the paths from points of an aperture, exact distances at all frequencies of the pulse, and not
the paraxial integrals of the simulator.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe
from SlicerUSSim.Logic.probe.beam import FWHM_PER_SIGMA, NOMINAL_SPEED_M_S
from SlicerUSSim.Logic.tissue.table import TissueTable
from validation.checks import Check, Outcome, Row
from validation.measurement import EVEN, full_width
from validation.phantoms import FLUID, uniform_speckle, wires_and_cysts
from validation.speckle import SPECKLE

_SPEED = NOMINAL_SPEED_M_S * 1e-3  # mm / us
_PHASED = replace(PROBES["phased"], element_mm=None)
_RANGE_MM, _ANGLES_DEG, _LEVEL_DEG = 54.0, (0.0, 20.0, 36.0), 38.0
#: In focal lengths of the lens
_PARTS = (0.2, 0.5, 1.0, 1.5)
_SLAB_MM = 0.15
_WIRE_MM = (2.0, 20.0), 0.4  # of wires_and_cysts: its place, and its radius


def _band(probe: Probe) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies in MHz of the pulse, and its amplitude there."""
    deviations = np.linspace(-3.0, 3.0, 41)
    spread = probe.received_bandwidth / FWHM_PER_SIGMA
    return probe.received_mhz * (1.0 + spread * deviations), np.exp(-0.5 * deviations**2)


def _sector_echoes(probe: Probe, angle_deg: float, across_mm: np.ndarray) -> np.ndarray:
    """(across, times) echoes of points on an arc about a steered line's focus, by elements of half a wavelength."""
    count = int(2.0 * probe.aperture_mm / probe.wavelength_mm)
    element = ((np.arange(count) + 0.5) / count - 0.5) * probe.aperture_mm
    steered = np.radians(angle_deg)
    frequency, spectrum = _band(probe)
    waves = frequency[:, None] / _SPEED

    def distances(radius: float, angle: float) -> np.ndarray:
        return np.hypot(radius * np.sin(angle) - element, radius * np.cos(angle))

    received = np.abs(element) <= 0.5 * _RANGE_MM / probe.receive_f_number
    rows = []
    for aside in across_mm:
        angle = steered + aside / _RANGE_MM
        way, seen = (
            distances(_RANGE_MM, angle),
            np.arctan2(_RANGE_MM * np.sin(angle) - element, _RANGE_MM * np.cos(angle)),
        )
        elements = np.sinc(0.5 * probe.wavelength_mm * waves * np.sin(seen)) * np.sqrt(_RANGE_MM / way)
        elements = elements * (np.cos(seen) if probe.directivity == "soft" else 1.0)
        sent = (elements * np.exp(2j * np.pi * waves * (way - distances(probe.focus_mm, steered)))).mean(axis=1)
        back = elements * np.exp(2j * np.pi * waves * (way - distances(_RANGE_MM, steered)))
        rows.append(spectrum * sent * back[:, received].mean(axis=1))
    time = np.linspace(-1.0, 1.0, 301) * 1.4 / (probe.received_mhz * probe.received_bandwidth)
    return np.abs(np.array(rows) @ np.exp(-2j * np.pi * np.outer(frequency, time)))


def sectors(rotation: np.ndarray, device) -> Outcome:
    """Wires and speckle on steered lines of a phased array; as a control, lines whose level nothing lowers."""
    phantom, across = wires_and_cysts(rotation), np.linspace(-4.0, 4.0, 321)
    settings = SimulationSettings(scattering=False, reflections=False)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, settings, device)
    fine, rows = replace(_PHASED, scan_lines=481), []
    for angle in _ANGLES_DEG:
        turn, (wire, radius) = np.radians(angle), _WIRE_MM
        motion = np.eye(4)
        motion[:2, 3] = wire - (_RANGE_MM + radius) * np.array([np.sin(turn), np.cos(turn)])
        frame = simulator.simulate(fine, phantom.probe_to_ras @ motion, EVEN)
        at, line = round(_RANGE_MM / frame.sample_interval_mm), round((turn - fine.first_line) / fine.line_spacing)
        near = np.abs(frame.iq[line - 45 : line + 46, at - 12 : at + 13]).max(axis=1)
        found = full_width(np.arange(len(near)) * float(fine.line_distance_mm(_RANGE_MM)), near)
        exact = full_width(across, _sector_echoes(fine, angle, across).max(axis=1))
        rows.append(Row(f"lateral FWHM at 54 mm, {angle:.0f} degrees", "mm", exact, found, 0.08 * exact))
    tissue = uniform_speckle(SPECKLE, rotation)
    for directivity in ("soft", "rigid", "none"):
        probe, exact = replace(_PHASED, directivity=directivity), 0.0
        if directivity != "none":
            power = [(_sector_echoes(probe, angle, across) ** 2).sum() for angle in (0.0, _LEVEL_DEG)]
            exact = 10.0 * np.log10(power[1] / power[0])
        found = _fall_to_the_edge_db(tissue, probe, device)
        rows.append(Row(f"speckle at 38 degrees re 0, {directivity}", "dB", float(exact), found, 0.8))
    return Outcome(tuple(rows))


def _fall_to_the_edge_db(tissue, probe: Probe, device) -> float:
    outer = np.abs(np.degrees(probe.line_positions()))
    powers = np.zeros(2)
    for seed in range(6):
        simulator = UltrasoundSimulator(tissue.labels, tissue.tissues, SimulationSettings(seed=seed), device)
        frame = simulator.simulate(probe, tissue.probe_to_ras, EVEN)
        span = slice(*(round(depth / frame.sample_interval_mm) for depth in (_RANGE_MM - 6.0, _RANGE_MM + 6.0)))
        for n, lines in enumerate((outer < 8.0, np.abs(outer - _LEVEL_DEG) < 2.0)):
            powers[n] += np.mean(np.abs(frame.iq[lines, span]) ** 2)
    return float(10.0 * np.log10(powers[1] / powers[0]))


def _echoes_of_mirror(
    sent: tuple[float, float], received: tuple[float, float], depth_mm: float, tilt: float, waves: np.ndarray
) -> np.ndarray:
    """(waves,) mean over the ways from points of one aperture to those of another over a plane mirror, in its plane.

    Both are (size, focus) in mm, uniform, with exact distances; `waves` are cycles per mm of a way.
    """
    points = (np.arange(160) + 0.5) / 160 - 0.5
    (out, out_focus), (back, back_focus) = ((size * points, focus) for size, focus in (sent, received))
    # Receivers' mirror images
    image = 2.0 * np.cos(tilt) * depth_mm - 2.0 * np.sin(tilt) * back
    x, y = back + np.sin(tilt) * image, np.cos(tilt) * image
    way = np.hypot(out[:, None] - x, y) - (np.hypot(out, out_focus) - out_focus)[:, None]
    way -= np.hypot(back, back_focus) - back_focus + 2.0 * depth_mm
    ways, edges = np.histogram(way, bins=np.arange(way.min() - 0.02, way.max() + 0.02, 1.0 / (64.0 * waves.mean())))
    return np.exp(2j * np.pi * waves[:, None] * (0.5 * (edges[1:] + edges[:-1]))) @ ways / way.size


def mirror_echo_db(probe: Probe, tilt_deg, depth_mm: float, turn_deg: float = 0.0) -> np.ndarray:
    """(tilts,) peaks of the pulse from planes relative to a square one: sums over paths, laterally times those across.

    The tilt is in the image plane, or in a plane turned about the axis of the probe.
    """
    turn, (frequency, spectrum) = np.radians(turn_deg), _band(probe)
    waves = frequency / _SPEED
    time = np.linspace(-3.0, 3.0, 1201) * probe.wavelength_mm / probe.fractional_bandwidth
    sizes = probe.aperture_mm, min(probe.aperture_mm, depth_mm / probe.receive_f_number)
    lens = probe.elevation_aperture_mm, probe.elevation_focus_mm
    peaks = []
    for tilt in (0.0, *np.atleast_1d(np.radians(tilt_deg))):
        along, aside = (float(np.arctan(np.tan(tilt) * part)) for part in (np.cos(turn), np.sin(turn)))
        echo = _echoes_of_mirror((sizes[0], probe.focus_mm), (sizes[1], depth_mm), depth_mm, along, waves)
        echo = spectrum * echo * _echoes_of_mirror(lens, lens, depth_mm, aside, waves)
        peaks.append(np.abs(np.exp(-2j * np.pi * np.outer(time, waves)) @ echo).max())
    return 20.0 * np.log10(np.maximum(np.array(peaks[1:]) / peaks[0], 1e-6))


def lens_profile(probe: Probe, depth_mm: float, across_mm: np.ndarray) -> np.ndarray:
    """(across,) amplitude of the energy of a point's echo beside the image plane: 400 points of the lens, both ways."""
    place = ((np.arange(400) + 0.5) / 400 - 0.5) * probe.elevation_aperture_mm
    apart = np.hypot(depth_mm, across_mm[:, None] - place)
    way = apart - np.hypot(probe.elevation_focus_mm, place)
    energy = np.zeros(len(across_mm))
    for frequency, amplitude in zip(*_band(probe), strict=True):
        field = (np.exp(2j * np.pi * frequency / _SPEED * way) / np.sqrt(apart)).mean(axis=1)
        energy += amplitude**2 * np.abs(field) ** 4
    return np.sqrt(energy)


def _deviation_and_width(across_mm: np.ndarray, profile: np.ndarray) -> tuple[float, float]:
    """RMS distance by power, and full width at half of the amplitude, of one half of a profile of amplitudes."""
    power = profile**2
    power[0] *= 0.5  # which is half a step
    below = int(np.argmax(profile < 0.5 * profile.max()))
    ends = across_mm[below - 1 : below + 1][::-1], profile[below - 1 : below + 1][::-1]
    width = 2.0 * float(np.interp(0.5 * profile.max(), ends[1], ends[0]))
    return float(np.sqrt((power * across_mm**2).sum() / power.sum())), width


def slices(rotation: np.ndarray, device) -> Outcome:
    """The power of a thin slab of scatterers against the probe's distance from it, without the lobes in dark tissue."""
    rows = []
    for name in ("linear", "phased", "cardiac", "abdominal"):
        probe = PROBES[name]
        depths = [part * probe.elevation_focus_mm for part in _PARTS]
        depths = [depth for depth in depths if depth < probe.depth_mm - 4.0]
        offsets = np.linspace(0.0, 1.02 * float(probe.lens().main_mm.max()), 41)
        powers = _slab_powers(probe, rotation, offsets, depths, device)
        fine = np.linspace(0.0, 3.0 * probe.elevation_aperture_mm, 2001)
        for part, depth, power in zip(_PARTS, depths, powers, strict=False):
            exact = _deviation_and_width(fine, lens_profile(probe, depth, fine))
            found = _deviation_and_width(offsets, np.sqrt(power))
            spread = float(np.sqrt(max(found[0] ** 2 - _SLAB_MM**2 / 12.0, 0.0)))
            where = f"at {part:g} F, {name}"
            rows.append(Row(f"RMS thickness {where}", "mm", exact[0], spread, 0.12 * exact[0]))
            rows.append(Row(f"FWHM {where}", "mm", exact[1], found[1], 0.12 * exact[1]))
            if (part, name) == (0.5, "phased"):  # a Gaussian beam of the same waist would not do
                sigma, focus, rayleigh = probe.elevation_waist()
                gauss = FWHM_PER_SIGMA * sigma / np.sqrt(2.0) * np.hypot(1.0, (depth - focus) / rayleigh)
                rows.append(Row(f"FWHM of a Gaussian beam {where}", "mm", 1.8 * exact[1], gauss, 0.0, "at least"))
    return Outcome(tuple(rows))


def _slab_powers(probe: Probe, rotation: np.ndarray, offsets: np.ndarray, depths: list[float], device) -> np.ndarray:
    """(depths, offsets) mean power of the middle lines within 3 mm of a depth, from both sides, as one smooth curve."""
    step = np.array([2.0, 2.0, _SLAB_MM])
    layers = 2 * int(offsets[-1] / _SLAB_MM) + 5
    counts = np.array([40, int(probe.depth_mm / 2.0) + 4, layers])
    labels = np.zeros(counts[::-1], np.uint8)
    labels[layers // 2] = 1
    to_ras = np.eye(4)
    to_ras[:3, :3] = rotation * step
    to_ras[:3, 3] = rotation @ (step * [-19.5, -2.0, -(layers // 2)])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    tissues = TissueTable({0: FLUID, 1: replace(SPECKLE, impedance_mrayl=FLUID.impedance_mrayl)})
    settings = SimulationSettings(side_lobes=False, interfaces=False, reflections=False)
    simulator = UltrasoundSimulator(Volume(labels, to_ras), tissues, settings, device)
    middle = np.abs(probe.line_positions()) * (1.0 if probe.is_linear else probe.apex_radius_mm + 30.0) < 14.0
    powers = np.zeros((len(depths), len(offsets)))
    for seed in range(2):
        simulator.settings = replace(settings, seed=seed)
        for n, offset in enumerate(offsets):
            for side in (-1.0, 1.0):
                moved = pose.copy()
                moved[:3, 3] += side * offset * rotation[:, 2]
                frame = simulator.simulate(probe, moved, EVEN)
                for row, depth in enumerate(depths):
                    span = slice(*(max(round(at / frame.sample_interval_mm), 0) for at in (depth - 2.0, depth + 2.0)))
                    powers[row, n] += np.mean(np.abs(frame.iq[middle, span]) ** 2)
    return powers


CHECKS = (
    Check(
        "sectors",
        "Beams of steered lines are as wide as the foreshortened aperture makes them, and fainter by their elements.",
        sectors,
    ),
    Check("slices", "The thickness of a slice agrees with the lens: sums over its points, at all depths.", slices),
)
