"""Checks of the speckle (docs/physics.md#5-scatterers): statistics, correlations, level, fixed scatterers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy import stats

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.imaging.scattering import PAPER_SITES_PER_MM3, sites_per_mm3
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import PROBES as SHIPPED, LinearProbe, Probe
from SlicerUSSim.Logic.probe.poses import elevational_motion
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import Tissue
from validation.checks import PROBES, Check, Outcome, Row
from validation.measurement import (
    EVEN,
    correlation,
    depth_window,
    envelope_snr,
    fit_rayleigh,
    level_db,
)
from validation.phantoms import BACKGROUND, Phantom, uniform_speckle
from validation.pictures import (
    Curve,
    Plot,
    View,
    draw_images,
    draw_plots,
    draw_rayleigh,
    draw_views,
)
from validation.wave import speckle_half_length

#: Without attenuation, so that statistics do not change with depth
SPECKLE = replace(BACKGROUND, name="speckle", attenuation_db_cm_mhz=0.0)
#: Mean over standard deviation of a Rayleigh variable
RAYLEIGH_SNR = float(np.sqrt(np.pi / (4.0 - np.pi)))
DEPTHS_MM = (10.0, 30.0, 46.0)
SEEDS = range(8)
#: The brain's echogenic tissues, and the ends of what fits try and the paper has
TISSUES_OF_SPECKLE = {
    tissue.name: replace(tissue, attenuation_db_cm_mhz=0.0, texture_db=0.0, specks_per_mm3=0.0)
    for tissue in TissueTable.brain().all_tissues()
    if tissue.scatterer_variance > 0.0
} | {
    "mu0 = 0": replace(SPECKLE, mu0=0.0),
    "mu1 = -1": replace(SPECKLE, mu1=-1.0),
    "mu1 = 1.5": replace(SPECKLE, mu1=1.5),
    "mu1 = 3": replace(SPECKLE, mu1=3.0),
    "the paper's patient 3": replace(SPECKLE, mu0=0.06, sigma0=0.31),
}


def _simulators(
    rotation: np.ndarray, device, tissue: Tissue = SPECKLE, seeds: Sequence[int] = SEEDS, **settings
) -> tuple[Phantom, list[UltrasoundSimulator]]:
    phantom = uniform_speckle(tissue, rotation)
    return phantom, [
        UltrasoundSimulator(phantom.labels, phantom.tissues, SimulationSettings(seed=seed, **settings), device)
        for seed in seeds
    ]


def statistics(rotation: np.ndarray, device) -> Outcome:
    """First-order statistics in uniform tissue."""
    phantom, simulators = _simulators(rotation, device)
    rows = []
    for name, probe in PROBES.items():
        signals = [s.simulate(probe, phantom.probe_to_ras, EVEN).iq[:, 64:-64] for s in simulators]
        envelope = np.abs(np.stack(signals))
        variance = 10 * np.log10(SPECKLE.scatterer_variance)
        snr = float(envelope.mean() / envelope.std())
        rows += [
            Row(f"mean / standard deviation, {name}", "", RAYLEIGH_SNR, snr, 0.02 * RAYLEIGH_SNR),
            Row(f"level, {name}", "dB", variance, level_db(envelope), 0.5),
            Row(f"spectral peak over surroundings, {name}", "", 8.0, _spectral_peak(envelope), 0.0, "at most"),
        ]
    frame = simulators[0].simulate(PROBES["convex"], phantom.probe_to_ras, replace(EVEN, tgc_db_cm_mhz=0.0))
    return Outcome(tuple(rows), partial(draw_views, views=[View("speckle", phantom, PROBES["convex"], frame)]))


def _spectral_peak(envelope: np.ndarray) -> float:
    """Ratio of the highest peak of the mean intensity spectrum to its surroundings; a lattice or a tiling has peaks.

    The mean of eight exponential variables exceeds its median eightfold less than once in 10^18.
    """
    from scipy.ndimage import median_filter

    intensity = envelope**2 - (envelope**2).mean(axis=(1, 2), keepdims=True)
    power = (np.abs(np.fft.fft2(intensity)) ** 2).sum(axis=0)
    smooth = median_filter(power, size=(9, 31), mode="wrap")
    strong = smooth > 1e-3 * smooth.max()
    return float((power[strong] / smooth[strong]).max())


def everywhere(rotation: np.ndarray, device) -> Outcome:
    """First-order statistics of the probes of the presets at their own frequencies, and of all tissues."""
    rows = []
    phantom, simulators = _simulators(rotation, device)
    for name, shipped in SHIPPED.items():
        probe = replace(shipped, directivity="none")
        frames = [s.simulate(probe, phantom.probe_to_ras, EVEN) for s in simulators]
        for place, depth in {"near the face": 0.1, "at the focus": 0.6, "far": 0.9}.items():
            found = _window_statistics(frames, depth * probe.depth_mm, 0.06 * probe.depth_mm)
            rows += _statistics_rows(f"{place}, {name}", SPECKLE, *found)
    probe = PROBES["linear"]
    for name, tissue in TISSUES_OF_SPECKLE.items():
        phantom, simulators = _simulators(rotation, device, tissue)
        frames = [s.simulate(probe, phantom.probe_to_ras, EVEN) for s in simulators]
        rows += _statistics_rows(name, tissue, *_window_statistics(frames, 28.0, 20.0))
    return Outcome(tuple(rows))


def sparse(rotation: np.ndarray, device) -> Outcome:
    """Rare scatterers (mu1 = 3: 169 per mm^3) where the resolution cells of high frequencies are smallest."""
    tissue = replace(SPECKLE, mu1=3.0)
    phantom, simulators = _simulators(rotation, device, tissue, range(3 * len(SEEDS)))
    rows = []
    for name in ("linear", "hockey_stick", "linear_15", "neonatal"):
        probe = SHIPPED[name]
        half = 0.04 * probe.depth_mm
        depth, cell, expected = smallest_cell(probe, tissue, half)
        frames = [s.simulate(probe, phantom.probe_to_ras, EVEN) for s in simulators]
        found, level = _window_statistics(frames, depth, half)
        few = f"{name}, {PAPER_SITES_PER_MM3 * tissue.scatterer_share * cell:.2g} in a cell"
        rows.append(Row(f"mean / standard deviation, {few}", "", expected, found, 0.015 * expected))
        rows.append(Row(f"level, {few}", "dB", 10 * np.log10(tissue.scatterer_variance), level, 0.3))
    return Outcome(tuple(rows))


def smallest_cell(probe: Probe, tissue: Tissue, half_mm: float) -> tuple[float, float, float]:
    """(depth in mm, volume in mm^3 of the smallest resolution cell; predicted mean / standard deviation around it).

    The prediction is for depths up to `half_mm` away, where the image has them, in tissue without attenuation.
    """
    depth = np.linspace(2.0 * half_mm, probe.depth_mm - 2.0 * half_mm, 257)
    lateral, elevational = probe.beam_sigma_mm(depth)
    at = int(np.argmin(lateral * elevational))
    near = probe.beam_sigma_mm(depth[at] + np.linspace(-half_mm, half_mm, 9))
    sigmas = [(probe.axial_sigma_mm, float(across), float(high)) for across, high in zip(*near, strict=True)]
    density = sites_per_mm3(SimulationSettings(), probe)
    # A site stands for all of the paper's in its cell, and has a scatterer if one of them has.
    occupied = density * (1.0 - (1.0 - tissue.scatterer_share) ** (PAPER_SITES_PER_MM3 / density))
    cell = (2.0 * np.pi) ** 1.5 * probe.axial_sigma_mm * float(lateral[at] * elevational[at])
    return float(depth[at]), cell, envelope_snr(occupied, density, sigmas)


def _window_statistics(frames: Sequence[Frame], depth_mm: float, half_mm: float) -> tuple[float, float]:
    """(mean / standard deviation of the envelope, level in dB) around a depth, whatever the focus does to the level."""
    envelope = np.abs(np.stack([depth_window(frame, depth_mm, half_mm) for frame in frames]))
    return float(envelope.mean() / envelope.std()), level_db(envelope)


def _statistics_rows(name: str, tissue: Tissue, snr: float, level: float) -> list[Row]:
    return [
        Row(f"mean / standard deviation, {name}", "", RAYLEIGH_SNR, snr, 0.015 * RAYLEIGH_SNR),
        Row(f"level, {name}", "dB", 10 * np.log10(tissue.scatterer_variance), level, 0.3),
    ]


def correlations(rotation: np.ndarray, device) -> Outcome:
    """Second-order statistics at three depths."""
    phantom, simulators = _simulators(rotation, device)
    rows, curves = [], []
    for name, probe in PROBES.items():
        frames = [s.simulate(probe, phantom.probe_to_ras, EVEN) for s in simulators]
        for depth in DEPTHS_MM:
            sigma_l = float(probe.speckle_sigma_mm(depth))
            half_l, half_e = _half_lengths_of_waves(probe, depth)
            apart = float(probe.line_distance_mm(depth))
            lag = max(1, round(sigma_l / apart))
            beside = phantom.probe_to_ras @ elevational_motion(half_e)
            others = [s.simulate(probe, beside, EVEN) for s in simulators]
            # Steered lines have wider beams.
            part = slice(len(frames[0].iq) // 3, -(len(frames[0].iq) // 3)) if name == "phased" else slice(None)
            near = [depth_window(f, depth, 1.0)[part] for f in frames]
            wide = [depth_window(f, depth, 3.0)[part] for f in frames]
            dz, sigma_a = frames[0].sample_interval_mm, probe.axial_sigma_mm
            axial = max(1, round(sigma_a / dz))
            found = {
                "lateral": (lag * apart, sigma_l, [correlation(s[:-lag], s[lag:]) for s in near]),
                "elevational": (
                    half_e,
                    half_e / np.sqrt(4.0 * np.log(2.0)),
                    [correlation(s, depth_window(o, depth, 1.0)[part]) for s, o in zip(near, others, strict=True)],
                ),
                "axial": (axial * dz, sigma_a, [correlation(s[:, :-axial], s[:, axial:]) for s in wide]),
            }
            for direction, (distance, sigma, values) in found.items():
                theory = float(np.exp(-(distance**2) / (4 * sigma**2)))
                # The length of a wave is met within 15 %, which is 0.08 to 0.1 of the correlation of one half.
                limit = 0.16 if direction == "elevational" else 0.1
                rows.append(
                    Row(f"{direction} at {depth:.0f} mm, {name}", "", theory, float(np.mean(values)), limit * theory)
                )
            if name != "convex":  # whose elements lie behind the plane of their middle
                lags = np.arange(1, 3 + int(1.5 * half_l / apart))
                measured = [np.mean([correlation(s[:-n], s[n:]) for s in near]) for n in lags]
                length = float(np.interp(-0.5, -np.array(measured), lags * apart))
                # The curvature is that which agrees with PyMUST (within 9 %), whose directive elements make beams wider
                # than these of points, by 5 to 10 %.
                rows.append(
                    Row(f"lateral half length of waves at {depth:.0f} mm, {name}", "mm", half_l, length, 0.18 * half_l)
                )
            if name == "linear":
                lags = np.arange(0, max(2, round(3.2 * sigma_l / apart)))
                measured = [np.mean([correlation(s[: len(s) - n], s[n:]) for s in near]) for n in lags]
                fine = np.linspace(0.0, lags[-1] * apart, 100)
                theory = np.exp(-(fine**2) / (4 * sigma_l**2))
                curves.append(Curve(f"{depth:.0f} mm deep", lags * apart, np.array(measured), fine, theory))
    plot = Plot("lateral correlation of speckle, linear array", "distance [mm]", "correlation", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


def _half_lengths_of_waves(probe: Probe, depth_mm: float) -> tuple[float, float]:
    """(lateral, elevational) distance in mm over which the correlation of the speckle of waves falls to one half."""
    band = {"frequency_mhz": probe.frequency_mhz, "fractional_bandwidth": probe.fractional_bandwidth}
    sent, lens = (
        (probe.aperture_mm, probe.focus_mm),
        (probe.elevation_aperture_mm, probe.elevation_focus_mm),
    )
    received = min(probe.aperture_mm, depth_mm / probe.receive_f_number), depth_mm
    return (
        speckle_half_length(depth_mm, transmit_mm=sent, receive_mm=received, **band),
        speckle_half_length(depth_mm, transmit_mm=lens, receive_mm=lens, **band),
    )


def coherence(rotation: np.ndarray, device) -> Outcome:
    """The probe moves laterally by one scan line; the scatterers remain fixed in the patient."""
    phantom, (simulator,) = _simulators(rotation, device, seeds=(0,))
    rows, images = [], {}
    probes = {"linear": replace(PROBES["linear"], width_mm=36.0, scan_lines=181)} | {
        name: PROBES[name] for name in ("convex", "phased")
    }
    for name, probe in probes.items():
        here = simulator.simulate(probe, phantom.probe_to_ras, EVEN)
        moved = simulator.simulate(probe, phantom.probe_to_ras @ one_line_on(probe), EVEN)
        again = simulator.simulate(probe, phantom.probe_to_ras, EVEN)
        kept = correlation(here.iq[1:], moved.iq[:-1])
        if name == "convex":
            images = {
                "before": here.iq[1:],
                "moved by a line, re-aligned": moved.iq[:-1],
                "difference": moved.iq[:-1] - here.iq[1:],
            }
        rows += [
            Row(f"after re-alignment by one line, {name}", "", 0.95, kept, 0.0, "at least"),
            Row(f"largest change when simulated again, {name}", "", 0.0, float(abs(again.iq - here.iq).max()), 0.0),
        ]
    return Outcome(tuple(rows), partial(draw_images, images=images))


def one_line_on(probe: Probe) -> np.ndarray:
    """(4, 4) motion in the probe frame that moves every scan line to the position of the next."""
    motion = np.eye(4)
    if probe.is_linear:
        motion[0, 3] = probe.line_spacing
        return motion
    angle, radius = probe.line_spacing, probe.apex_radius_mm
    motion[:2, :2] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    motion[:2, 3] = radius * np.array([np.sin(angle), np.cos(angle) - 1.0])  # about the apex, at (0, -radius)
    return motion


def uneven(rotation: np.ndarray, device) -> Outcome:
    """The level of a tissue whose echogenicity varies, relative to the same scatterers without variation."""
    rows = []
    for name, changes in {
        "texture 3.5 dB, 0.8 mm": {"texture_db": 3.5, "texture_mm": 0.8},
        "texture 6 dB, 0.5 mm": {"texture_db": 6.0, "texture_mm": 0.5},
        "specks 14 dB, 0.02/mm3": {"specks_per_mm3": 0.02, "speck_db": 14.0, "texture_mm": 0.5},
    }.items():
        power = np.zeros(2)
        for seed in range(3 * len(SEEDS)):
            for place, tissue in enumerate((SPECKLE, replace(SPECKLE, **changes))):
                phantom, (simulator,) = _simulators(rotation, device, tissue, seeds=(seed,))
                frame = simulator.simulate(PROBES["linear"], phantom.probe_to_ras, EVEN)
                power[place] += 10.0 ** (0.1 * level_db(frame.iq[:, 64:-64]))
        change = float(10.0 * np.log10(power[1] / power[0]))
        rows.append(Row(f"level re even tissue, {name}", "dB", 0.0, change, 0.1))
    return Outcome(tuple(rows))


#: Of lung, fat, skin and skull, m/s
SPEEDS = (950.0, 1430.0, 1624.0, 2800.0)


def echogenicity(rotation: np.ndarray, device) -> Outcome:
    """Var = p (1 - p) mu0^2 + p sigma0^2 alone sets the level, whatever the speed of sound and the array."""
    rows = []
    for name, changes in {
        "mu0 0.33, sigma0 0.15, mu1 0": {},
        "sigma0 alone": {"mu0": 0.0, "sigma0": 0.4},
        "mu0 alone": {"mu0": 0.6, "sigma0": 0.0},
        "rare, mu1 1": {"mu1": 1.0},
    }.items():
        tissue = replace(SPECKLE, **changes)
        phantom, simulators = _simulators(rotation, device, tissue, seeds=range(2))
        frames = [s.simulate(PROBES["linear"], phantom.probe_to_ras, EVEN) for s in simulators]
        level = level_db(np.stack([f.iq[:, 64:-64] for f in frames]))
        rows.append(Row(name, "dB", 10 * np.log10(tissue.scatterer_variance), level, 0.5))
    for speed in SPEEDS:
        tissue = replace(SPECKLE, speed_of_sound_m_s=speed)
        phantom, simulators = _simulators(rotation, device, tissue)
        for name in ("linear", "phased"):
            probe = PROBES[name]
            frames = [s.simulate(probe, phantom.probe_to_ras, EVEN) for s in simulators]
            for part in (0.25, 0.75):
                _, level = _window_statistics(frames, part * probe.depth_mm, 0.2 * probe.depth_mm)
                what = f"{speed:.0f} m/s, {name}, at {part * probe.depth_mm:.0f} mm"
                rows.append(Row(what, "dB", 10 * np.log10(tissue.scatterer_variance), level, 0.3))
    return Outcome(tuple(rows))


#: The paper's Fig. 4: a lattice of 20 um of which one site in a hundred is occupied, 1250 scatterers per mm^3.
RAYLEIGH_SITES_PER_MM3, RAYLEIGH_SHARE = 125_000.0, 0.01
#: A high frequency and a low f-number give many resolution cells in a small volume, each with some 60 scatterers.
RAYLEIGH_PROBE = LinearProbe(
    24.0, 16.0, scan_lines=241, frequency_mhz=10.0, receive_f_number=1.5, aperture_mm=12.0, focus_mm=400.0,
    elevation_aperture_mm=2.4, elevation_focus_mm=10.0,
)  # fmt: skip


def rayleigh(rotation: np.ndarray, device) -> Outcome:
    """The distribution of the envelope, by the paper's protocol."""
    probe, first_mm = RAYLEIGH_PROBE, 3.0
    tissue = replace(SPECKLE, mu1=float(stats.norm.isf(RAYLEIGH_SHARE)))
    phantom, simulators = _simulators(
        rotation, device, tissue, range(3), scatterers_per_mm3=RAYLEIGH_SITES_PER_MM3, reflections=False
    )
    frames = [s.simulate(probe, phantom.probe_to_ras, EVEN) for s in simulators]
    first = int(first_mm / frames[0].sample_interval_mm)
    envelope = np.abs(np.stack([frame.iq[:, first:-64] for frame in frames]))
    fit = fit_rayleigh(envelope)
    # Signals four sigmas apart have the correlation exp(-4) = 2 %. The level is known, so no parameter is fitted.
    deep = first_mm + np.arange(envelope.shape[2]) * frames[0].sample_interval_mm
    lines = int(np.ceil(4 * probe.beam_sigma_mm(deep)[0].max() / probe.line_spacing))
    samples = int(np.ceil(4 * probe.axial_sigma_mm / frames[0].sample_interval_mm))
    apart = envelope[:, ::lines, ::samples].ravel()
    p_value = stats.kstest(apart, stats.rayleigh(scale=np.sqrt(0.5 * tissue.scatterer_variance)).cdf).pvalue
    snr = float(envelope.mean() / envelope.std())
    sigma = 255.0 * float(np.sqrt(0.5 * tissue.scatterer_variance) / envelope.max())
    return Outcome(
        (
            Row("SSE of the fit", "", 3.14e-5, fit.sse, 0.0, "at most"),
            Row("sigma of the fit", "grey levels", sigma, fit.sigma, 0.02 * sigma),
            Row("mean / standard deviation", "", RAYLEIGH_SNR, snr, 0.02 * RAYLEIGH_SNR),
            Row(f"p of Kolmogorov-Smirnov, {apart.size} samples", "", 0.05, float(p_value), 0.0, "at least"),
        ),
        partial(draw_rayleigh, fit=fit, envelope=envelope[0]),
    )  # fmt: skip


CHECKS = (
    Check(
        "speckle statistics",
        "Mean / standard deviation is 1.913, mean power is Var of the scatterers, and the spectrum shows no lattice.",
        statistics,
    ),
    Check(
        "speckle correlation",
        "Signals d apart have the correlation exp(-d^2 / 4 sigma^2), sigma of the beam at that depth; laterally "
        "as its curved phase leaves of that.",
        correlations,
    ),
    Check(
        "speckle everywhere",
        "Speckle is developed for every tissue, and for the probes of the presets at every depth.",
        everywhere,
    ),
    Check(
        "sparse speckle",
        "With few scatterers in the resolution cell, mean / standard deviation agrees with a random walk.",
        sparse,
    ),
    Check("speckle coherence", "The scatterers are the same at every pose.", coherence),
    Check("echogenicity", "Var = p (1 - p) mu0^2 + p sigma0^2 alone sets the level.", echogenicity),
    Check("uneven tissue", "Texture and specks within a tissue keep its mean power within 0.1 dB.", uneven),
    Check(
        "rayleigh",
        "Fully developed speckle has a Rayleigh envelope (the paper's Fig. 4: 1250 scatterers per mm^3 on 20 um).",
        rayleigh,
    ),
)
