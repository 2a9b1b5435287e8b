"""Checks of transmission: focal zones, compounded angles, steered lines, harmonic imaging (docs/physics.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import LinearProbe, Probe
from SlicerUSSim.Logic.probe.beam import FWHM_PER_SIGMA, LEAKED, MAIN_LOBE
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from validation.checks import PROBES, Check, Outcome, Row
from validation.measurement import EVEN, correlation, depth_window, echo_near, full_width, level_db
from validation.phantoms import Echo, Phantom, uniform_speckle, wires_and_cysts
from validation.pictures import Curve, Plot, View, draw_plots, draw_views
from validation.speckle import SPECKLE

_FINE = 481  # scan lines, for profiles across a wire
#: Lines that differ most in where they begin
_WIDE = LinearProbe(36.0, 40.0, scan_lines=240, focus_mm=25.0, elevation_focus_mm=25.0, trapezoid_deg=45.0)
_STEERED: dict[str, Probe] = {
    "trapezoid": LinearProbe(36.0, 52.0, scan_lines=241, focus_mm=30.0, elevation_focus_mm=30.0, trapezoid_deg=18.0),
    "to the right": LinearProbe(36.0, 52.0, scan_lines=241, focus_mm=30.0, elevation_focus_mm=30.0, steering_deg=15.0),
    "to the left": LinearProbe(36.0, 52.0, scan_lines=241, focus_mm=30.0, elevation_focus_mm=30.0, steering_deg=-20.0),
}


def focal_zones(rotation: np.ndarray, device) -> Outcome:
    """Wires in three foci: each is as sharp as the aperture of its zone allows, and sharper than with one focus."""
    simulator, phantom = _wires(rotation, device)
    rows = []
    for name, probe in PROBES.items():
        zones = replace(probe, scan_lines=_FINE, transmit="zones", focal_zones=3)  # at 10, 30 and 50 mm
        one = replace(zones, transmit="focus")
        wide = _wire_widths(simulator, phantom, one)
        for depth, width in _wire_widths(simulator, phantom, zones).items():
            if depth not in (10, 30):  # the far wire of a sector is beyond its depth
                continue
            f_number = max(probe.receive_f_number, depth / probe.aperture_mm)
            theory = MAIN_LOBE * probe.wavelength_mm * f_number / np.sqrt(2.0)
            rows.append(Row(f"lateral FWHM at {depth} mm, {name}", "mm", theory, width, 0.15 * theory))
            if depth == 10:
                rows.append(Row(f"relative to one focus, {name}", "", 0.85, width / wide[depth], 0.0, "at most"))
    return Outcome(tuple(rows))


def compounded_angles(rotation: np.ndarray, device) -> Outcome:
    """Five waves at up to 10 degrees: as sharp everywhere as an aperture seen under their angles, and so is speckle."""
    simulator, phantom = _wires(rotation, device)
    tissue = uniform_speckle(SPECKLE, rotation)
    speckle = [
        UltrasoundSimulator(tissue.labels, tissue.tissues, SimulationSettings(seed=seed), device) for seed in range(4)
    ]
    rows, curves = [], []
    for name, (frequency, receive, angles, largest) in {
        "5 MHz, f/2": (5.0, 2.0, 5, 10.0),
        "7.5 MHz, f/2.5": (7.5, 2.5, 7, 8.0),
    }.items():
        probe = LinearProbe(
            36.0, 52.0, scan_lines=361, frequency_mhz=frequency, receive_f_number=receive, aperture_mm=20.0,
            focus_mm=30.0, elevation_focus_mm=30.0, transmit="angles", transmit_angles=angles,
            largest_angle_deg=largest,
        )  # fmt: skip
        # n angles in steps of d are the samples of an aperture that is seen under n d.
        transmit = (angles - 1) / angles / (2.0 * np.sin(np.deg2rad(largest)))
        width, length = _two_apertures(transmit * probe.wavelength_mm, receive * probe.wavelength_mm)
        found = _wire_widths(simulator, phantom, replace(probe, scan_lines=_FINE))
        rows += [
            Row(f"lateral FWHM at {depth} mm, {name}", "mm", width, found[depth], 0.15 * width) for depth in (20, 30)
        ]
        frames = [s.simulate(probe, tissue.probe_to_ras, EVEN) for s in speckle]
        depths = np.array([8.0, 22.0, 38.0])
        lengths = np.array([_correlation_length(frames, probe, depth) for depth in depths])
        rows += [
            Row(f"half length of correlation at {depth:.0f} mm, {name}", "mm", length, found, 0.15 * length)
            for depth, found in zip(depths, lengths, strict=True)
        ]
        rows.append(
            Row(f"level, {name}", "dB", 10 * np.log10(SPECKLE.scatterer_variance),
                level_db(np.stack([frame.iq[:, 64:-64] for frame in frames])), 0.3)
        )  # fmt: skip
        curves.append(Curve(name, depths, lengths, depths, np.full(3, length)))
    plot = Plot("compounded angles", "depth [mm]", "half length of lateral correlation [mm]", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


def _two_apertures(transmit_mm: float, receive_mm: float) -> tuple[float, float]:
    """(FWHM, lag of half the autocorrelation) of the product of two sinc functions with these first zeros."""
    x = np.arange(-60.0, 60.0, 0.005)
    pattern = np.sinc(x / transmit_mm) * np.sinc(x / receive_mm)
    spectrum = np.abs(np.fft.fft(pattern, 2 * len(x))) ** 2
    correlated = np.abs(np.fft.ifft(spectrum))[: len(x)]
    half = int(np.argmax(correlated < 0.5 * correlated[0]))
    return full_width(x, np.abs(pattern)), 0.005 * half


def _correlation_length(frames: Sequence[Frame], probe: Probe, depth_mm: float) -> float:
    windows = [depth_window(frame, depth_mm, 2.0) for frame in frames]
    lags = np.arange(1, 30)
    values = np.array([np.mean([correlation(w[:-lag], w[lag:]) for w in windows]) for lag in lags])
    return float(np.interp(-0.5, -values, lags * float(probe.line_distance_mm(depth_mm))))


def steered_lines(rotation: np.ndarray, device) -> Outcome:
    """Wires keep their places whatever the lines; the field begins at the face and ends at the outermost lines."""
    simulator, phantom = _wires(rotation, device)
    tissue = uniform_speckle(SPECKLE, rotation)
    speckle = UltrasoundSimulator(tissue.labels, tissue.tissues, device=device)
    rows, views = [], []
    for name, probe in _STEERED.items():
        frame = simulator.simulate(probe, phantom.probe_to_ras, EVEN)
        for wire in _echoes(phantom, probe):
            if not probe.holds(*np.array(wire.shown_mm)):
                continue
            x, y, _ = echo_near(frame, probe, wire.shown_mm, 1.5)
            off = float(np.hypot(x - wire.shown_mm[0], y - wire.shown_mm[1]))
            rows.append(Row(f"position error of the {wire.name}, {name}", "mm", 0.0, off, 0.15, "at most"))
        full = DisplaySettings(look="even", dynamic_range_db=200.0, tgc_db_cm_mhz=0.0)
        frame = speckle.simulate(probe, tissue.probe_to_ras, full)
        field = ImageGrid.for_probe(probe, None).field(probe)
        wrong = float(((frame.image > 0) != field).mean())
        rows.append(Row(f"pixels on the wrong side of the field's edge, {name}", "", 0.0, wrong, 0.01, "at most"))
        inside = depth_window(frame, 30.0 + float(probe.line_starts_mm(0.0)), 5.0)
        level = _level_of_elements_db(probe, probe.directions()[:, 0])
        rows.append(Row(f"level of speckle, {name}", "dB", level, level_db(inside), 1.0))
        views.append(View(name, phantom, probe, simulator.simulate(probe, phantom.probe_to_ras, EVEN)))
    rows += _levels_of_lines(tissue, device)
    return Outcome(tuple(rows), partial(draw_views, views=views))


def _levels_of_lines(tissue: Phantom, device) -> list[Row]:
    """Near the face and deeper, the level of speckle along the inner and outer lines of a wide trapezoid."""
    frames = [
        UltrasoundSimulator(tissue.labels, tissue.tissues, SimulationSettings(seed=seed), device).simulate(
            _WIDE, tissue.probe_to_ras, EVEN
        )
        for seed in range(8)
    ]
    count, dz = _WIDE.scan_lines, frames[0].sample_interval_mm
    starts = _WIDE.line_starts_mm(_WIDE.line_positions())
    rows = []
    for depths in ((3.0, 9.0), (20.0, 30.0)):
        spans = [slice(*(round((start + depth) / dz) for depth in depths)) for start in starts]
        power = [np.mean([np.mean(np.abs(frame.iq[n, span]) ** 2) for frame in frames]) for n, span in enumerate(spans)]
        inner = np.abs(np.arange(count) - 0.5 * (count - 1)) < count / 6
        for name, lines in (("inner", inner), ("outer", ~inner)):
            found = 10 * np.log10(np.mean(np.array(power)[lines]))
            level = _level_of_elements_db(_WIDE, _WIDE.directions()[lines, 0])
            text = f"level at {depths[0]:.0f} to {depths[1]:.0f} mm, {name} lines of a trapezoid of 45 degrees"
            rows.append(Row(text, "dB", level, float(found), 0.3))
    return rows


def _level_of_elements_db(probe: Probe, sines: np.ndarray) -> float:
    """Of speckle along lines at angles of these sines: elements of half a wavelength in a soft baffle, wider beams."""
    assert probe.element_mm is None and probe.directivity == "soft"
    cosines = np.sqrt(1.0 - sines**2)
    power = (np.sinc(0.5 * sines) * cosines) ** 4 / cosines
    return float(10 * np.log10(SPECKLE.scatterer_variance * power.mean()))


def harmonic(rotation: np.ndarray, device) -> Outcome:
    """Width of a wire relative to the fundamental, frequency, and level against depth in the quasi-linear solution."""
    simulator, phantom = _wires(rotation, device)
    tissue = uniform_speckle(SPECKLE, rotation)
    speckle = [
        UltrasoundSimulator(tissue.labels, tissue.tissues, SimulationSettings(seed=seed), device) for seed in range(4)
    ]
    rows, curves = [], []
    for name, probe in PROBES.items():
        fundamental = replace(probe, frequency_mhz=2.5, aperture_mm=12.0, elevation_aperture_mm=12.0)
        second = replace(fundamental, harmonic=True)
        widths = [_wire_widths(simulator, phantom, replace(p, scan_lines=_FINE))[30] for p in (fundamental, second)]
        # At equal f-numbers: transmitted twice at half the frequency, received once at the whole.
        ratio = np.sqrt(2.0 / 6.0)
        rows.append(Row(f"width of a wire over that at f0, {name}", "", ratio, widths[1] / widths[0], 0.1 * ratio))
        frames = [s.simulate(second, tissue.probe_to_ras, DisplaySettings(look="even", noise_db=None)) for s in speckle]
        windows = [depth_window(frame, 30.0, 8.0) for frame in frames]
        turn = sum((w[:, 1:] * w[:, :-1].conj()).sum() for w in windows)
        carrier = frames[0].cycles_per_mm + float(np.angle(turn)) / (2 * np.pi * frames[0].sample_interval_mm)
        rows.append(Row(f"frequency over the pulse's, {name}", "", 2.0, carrier / fundamental.cycles_per_mm, 0.02))
        depths = np.array([4.0, 8.0, 15.0, 30.0, 45.0])
        found = np.array([level_db(np.stack([depth_window(f, d, 1.0) for f in frames])) for d in depths])
        theory = _level_of_equal_foci(second, depths)
        found, theory = found - found[3], theory - theory[3]
        rows += [
            Row(f"level at {depth:.0f} mm relative to the focus, {name}", "dB", t, f, 1.2)
            for depth, t, f in zip(depths, theory, found, strict=True)
            if depth != 30.0
        ]
        fine = np.linspace(2.0, 48.0, 100)
        curves.append(Curve(name, depths, found, fine, _level_of_equal_foci(second, fine) - _level_of_equal_foci(
            second, np.array([30.0]))))  # fmt: skip
    plot = Plot("level of the second harmonic", "depth [mm]", "dB re the focus", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


def _level_of_equal_foci(probe: Probe, depth_mm: np.ndarray) -> np.ndarray:
    """dB of the second harmonic of a Gaussian beam with one focus: the logarithm of (1 + i b) / (1 + i b0).

    To it comes 1 % of its power at the focus, which is sent.
    """
    sigma = MAIN_LOBE * 2.0 * probe.wavelength_mm * probe.focus_mm / probe.aperture_mm / FWHM_PER_SIGMA
    length = 2.0 * np.pi * sigma**2 / (2.0 * probe.wavelength_mm)
    b = (np.append([0.0, probe.focus_mm], depth_mm) - probe.focus_mm) / length
    grown = np.abs(np.log((1.0 + 1j * b[1:]) / (1.0 + 1j * b[0]))) ** 2
    return 10.0 * np.log10(grown[1:] / grown[0] + LEAKED**2)


def _wires(rotation: np.ndarray, device):
    phantom = wires_and_cysts(rotation)
    settings = SimulationSettings(scattering=False, reflections=False, side_lobes=False)
    return UltrasoundSimulator(phantom.labels, phantom.tissues, settings, device), phantom


def _echoes(phantom, probe: Probe) -> list[Echo]:
    return [echo for echo in phantom.expected(probe) if isinstance(echo, Echo)]


def _wire_widths(simulator: UltrasoundSimulator, phantom, probe: Probe) -> dict[int, float]:
    """{depth of a wire in mm: lateral FWHM of its echo}."""
    frame = simulator.simulate(probe, phantom.probe_to_ras, EVEN)
    widths = {}
    for wire in _echoes(phantom, probe):
        position, depth = (float(v) for v in probe.line_through(*wire.shown_mm))
        if depth > probe.depth_mm - 3.0:
            continue
        at, line = round(depth / frame.sample_interval_mm), round((position - probe.first_line) / probe.line_spacing)
        half = round(0.4 / frame.sample_interval_mm)
        band = np.abs(frame.iq[:, at - half : at + half + 1]).max(axis=1)
        apart = float(probe.line_distance_mm(depth))
        near, across = slice(max(line - round(4.0 / apart), 0), line + round(4.0 / apart)), np.arange(len(band)) * apart
        widths[int(wire.name.split()[-2])] = full_width(across[near], band[near])
    return widths


CHECKS = (
    Check(
        "focal zones",
        "Each focus is as sharp as its aperture allows: FWHM 1.21 wavelength x f-number / sqrt 2 of both ways.",
        focal_zones,
    ),
    Check(
        "compounded angles",
        "Width and correlation of speckle agree with two apertures at every depth (product of two sinc functions).",
        compounded_angles,
    ),
    Check("steered lines", "Wires have their places, and the field its edges, with steered lines too.", steered_lines),
    Check(
        "harmonic",
        "Wires are narrower by sqrt(1/3), and the level agrees with the quasi-linear solution for a Gaussian beam.",
        harmonic,
    ),
)
