"""Checks of rough sheets and rough planes: coherent and diffuse echo (docs/physics.md#5-scatterers)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from scipy import ndimage, special

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import PROBES, LinearProbe, Probe
from SlicerUSSim.Logic.tissue import Surfels
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import Membrane
from validation.beams import BEHIND
from validation.checks import Check, Outcome, Row
from validation.measurement import EVEN, depth_window, full_width
from validation.phantoms import FLUID, Phantom, layered, reflection_coefficient, rough_plane
from validation.pictures import Curve, Plot, draw_plots

_DEPTH_MM, _IMAGED_MM = 25.0, 40.0  # of the sheet, and of images: deeper samples are not looked at
_SILENT = SimulationSettings(scattering=False, specular_exponent=0.0, ring_down=False, side_lobes=False)
_LOUD = replace(_SILENT, scattering=True)
_GREY, _PIA = (
    replace(TISSUES[name], attenuation_db_cm_mhz=0.0, texture_db=0.0, specks_per_mm3=0.0)
    for name in ("grey matter", "leptomeninges")
)
#: A sheet thinner than the voxels of the plane beneath it allow for
_MEMBRANE = Membrane(replace(_PIA, speed_of_sound_m_s=FLUID.speed_of_sound_m_s), 0.2, (FLUID.name,))
_TILTS_DEG = (0.0, 4.0, 8.0)
#: Roughness in units of 1 / 2k, so that every frequency loses as much: exp(-x^2) of the power at normal incidence
_PHASES = (0.5, 1.0, 1.5)
#: Full-wave simulation, 2.5 MHz, f/2: {rms height of a rough plane: lowest, highest level relative to a smooth one}
_FULL_WAVE = {0.1: (-7.0, -4.0), 0.2: (-14.0, -10.0)}
_FULL_WAVE_PROBE = LinearProbe(12.0, 32.0, scan_lines=97, frequency_mhz=2.5, focus_mm=_DEPTH_MM, aperture_mm=12.5,
                               receive_f_number=2.0, elevation_focus_mm=_DEPTH_MM)  # fmt: skip
_CORRELATION_MM, _SURFACES = 0.5, 3
_AWAY_MM, _SEEDS = np.arange(-3.0, 3.0, 0.02), 3


def _tilted(tilt_deg: float) -> np.ndarray:
    """(4, 4) motion of the probe in the image plane, about the sheet's point on its axis."""
    tilt, motion = np.radians(tilt_deg), np.eye(4)
    motion[:2, :2] = [[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]]
    motion[:3, 3] = [0.0, _DEPTH_MM, 0.0] - motion[:3, :3] @ [0.0, _DEPTH_MM, 0.0]
    return motion


def _shipped_at(name: str, frequency_mhz: float) -> Probe:
    """A shipped probe, focused at the sheet, with a middle line."""
    shipped = PROBES[name]
    return replace(shipped, focus_mm=_DEPTH_MM, elevation_focus_mm=_DEPTH_MM, frequency_mhz=frequency_mhz,
                   scan_lines=shipped.scan_lines // 2 * 2 + 1, depth_mm=min(shipped.depth_mm, _IMAGED_MM))  # fmt: skip


def _shipped() -> list[tuple[str, Probe]]:
    """Every shipped probe at its own frequency and at 5 MHz."""
    return [
        (f"{name} {frequency:g} MHz", _shipped_at(name, frequency))
        for name, shipped in PROBES.items()
        for frequency in dict.fromkeys((shipped.frequency_mhz, 5.0))
    ]


def _of_phase(probe: Probe, phase: float) -> float:
    """The roughness in mm whose deviation of the echo's phase, 2 k s, is `phase` radians."""
    return phase / (2.0 * np.pi * probe.cycles_per_mm)


def _middle_db(frame: Frame, probe: Probe) -> float:
    return float(20 * np.log10(np.abs(depth_window(frame, _DEPTH_MM, 3.0)[probe.scan_lines // 2]).max() + 1e-12))


def coherent_part(rotation: np.ndarray, device) -> Outcome:
    """The border beneath a rough membrane, and a sheet of dura, re smooth ones at the same tilt."""
    wall = layered([FLUID, BEHIND], [_DEPTH_MM], rotation, spacing_mm=0.15, half_width_mm=12.0)
    around = layered([FLUID, FLUID], [_DEPTH_MM], rotation, spacing_mm=0.5, half_width_mm=12.0)
    # Dura lies in tissue; where there is no fluid, the membrane has no layer of its own.
    tissues = TissueTable({**wall.tissues, 0: FLUID}, _MEMBRANE)
    in_tissue = TissueTable({**around.tissues, 0: FLUID}, replace(_MEMBRANE, fluids=("csf",)))
    objects = {
        "border": (UltrasoundSimulator(wall.labels, tissues, _SILENT, device), wall, tissues),
        "dura": (
            UltrasoundSimulator(
                around.labels, in_tissue, _SILENT, device, sheets=plane_of_dura(around.probe_to_ras, _DEPTH_MM)
            ),
            around,
            in_tissue,
        ),
    }  # fmt: skip
    rows, curves = [], []
    for what, (simulator, phantom, table) in objects.items():
        for where, probe in _shipped():
            levels = np.zeros((1 + len(_PHASES), len(_TILTS_DEG)))
            for n, phase in enumerate((0.0, *_PHASES)):
                assert table.membrane is not None
                membrane = replace(table.membrane, roughness_mm=_of_phase(probe, phase))
                simulator.set_tissues(table.with_membrane(membrane))
                for m, tilt in enumerate(_TILTS_DEG):
                    frame = simulator.simulate(probe, phantom.probe_to_ras @ _tilted(tilt), EVEN)
                    levels[n, m] = _middle_db(frame, probe)
            lost = levels[1:] - levels[0]
            power = np.outer(np.square(_PHASES), np.cos(np.radians(_TILTS_DEG)) ** 2)
            predicted = -10.0 * np.log10(np.e) * power
            for n, phase in enumerate(_PHASES):
                worst = int(np.abs(lost[n] - predicted[n]).argmax())
                name = f"{what}, 2 k s = {phase:g}, {where} (worst of tilts: {_TILTS_DEG[worst]:g} degrees)"
                rows.append(Row(name, "dB", float(predicted[n, worst]), float(lost[n, worst]), 0.5))
            if "5 MHz" in where:
                phases = np.array(_PHASES)
                curves.append(Curve(f"{what}, {where}", phases, lost[:, 0], phases, predicted[:, 0]))
    rows += _diffuse_rows(*objects["border"][1:], device)
    plot = Plot("coherent part", "2 k s", "relative to a smooth sheet [dB]", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


def _diffuse_rows(phantom: Phantom, tissues: TissueTable, device) -> list[Row]:
    """Of a border with a membrane whose scatterers echo: what is the same for all seeds and lines is its coherent part.

    The rest has mean 0 and does not depend on the height of the surface.
    """
    probe = replace(_FULL_WAVE_PROBE, frequency_mhz=5.0)
    rows, smooth = [], np.zeros(2)
    silent = {label: replace(tissue, mu0=0.0, sigma0=0.0) for label, tissue in tissues.items()}
    for phase in (0.0, *_PHASES):
        table = TissueTable(silent, replace(_MEMBRANE, roughness_mm=_of_phase(probe, phase)))
        simulator = UltrasoundSimulator(phantom.labels, table, _LOUD, device)
        echoes = []
        for seed in range(_SEEDS):
            simulator.settings = replace(_LOUD, seed=seed)
            frame = simulator.simulate(probe, phantom.probe_to_ras, EVEN)
            near = np.abs(probe.line_positions()) < 5.0
            echoes.append(frame.iq[near, round(_DEPTH_MM / frame.sample_interval_mm)])
        levels = 10 * np.log10([np.abs(np.mean(echoes)) ** 2, np.var(echoes)])
        if phase == 0.0:
            smooth = levels
            continue
        lost = levels - smooth
        rows.append(Row(f"mean over seeds, 2 k s = {phase:g}", "dB", -10.0 * np.log10(np.e) * phase**2, lost[0], 1.5))
        rows.append(Row(f"variance over seeds, 2 k s = {phase:g}", "dB", 0.0, lost[1], 0.5))
    return rows


def plane_of_dura(probe_to_ras: np.ndarray, depth_mm: float) -> Surfels:
    """A plane of falx across the beam, 0.4 mm thick."""
    across = np.arange(-12.0, 12.0, 0.4)
    x, z = (grid.ravel() for grid in np.meshgrid(across, across))
    place = np.stack([x, np.full_like(x, depth_mm), z], axis=1) @ probe_to_ras[:3, :3].T + probe_to_ras[:3, 3]
    return Surfels.of("falx", place, np.broadcast_to(probe_to_ras[:3, 1], place.shape), 0.4, 1.0, 0.16)


def _surface(seed: int, rms_mm: float, step_mm: float = 0.01) -> np.ndarray:
    """(n,) heights in mm of a random surface with a Gaussian correlation, `step_mm` apart over 24 mm."""
    white = np.random.default_rng(seed).normal(size=int(24.0 / step_mm))
    heights = ndimage.gaussian_filter1d(white, _CORRELATION_MM / np.sqrt(2.0) / step_mm)
    return heights * rms_mm / heights.std()


def _kirchhoff_db(heights: np.ndarray, step_mm: float, probe: LinearProbe, lateral_mm: np.ndarray) -> np.ndarray:
    """(lines,) peak relative to a smooth plane: each surface element echoes from its depth, weighted by the beam."""
    at = step_mm * (np.arange(len(heights)) - 0.5 * (len(heights) - 1))
    sigma, _ = probe.beam_sigma_mm(_DEPTH_MM)
    depth = np.arange(-1.5, 1.5, 0.02)[:, None]
    pulses = np.exp(-2j * np.pi * probe.cycles_per_mm * heights - 0.5 * ((depth - heights) / probe.axial_sigma_mm) ** 2)
    beams = np.exp(-0.5 * ((at[:, None] - lateral_mm) / sigma) ** 2)
    return 20 * np.log10(np.abs(pulses @ (beams / beams.sum(axis=0))).max(axis=0))


def rough_planes(rotation: np.ndarray, device) -> Outcome:
    """Planes whose roughness is in the labels, in voxels far smaller than it; heights are the same along z."""
    square = 20 * np.log10(reflection_coefficient(FLUID, BEHIND)) + _SILENT.interface_gain_db
    step, rows = 0.01, []
    for frequency in (2.5, 5.0):
        probe = replace(_FULL_WAVE_PROBE, frequency_mhz=frequency)
        positions = probe.line_positions()
        near = np.abs(positions) < 4.0
        for rms in (height * 2.5 / frequency for height in _FULL_WAVE):
            found, predicted = [], []
            for seed in range(_SURFACES):
                heights = _surface(seed, rms)
                phantom = rough_plane(heights, step, [FLUID, BEHIND], rotation, depth_mm=_DEPTH_MM)
                frame = UltrasoundSimulator(phantom.labels, phantom.tissues, _SILENT, device).simulate(
                    probe, phantom.probe_to_ras, EVEN
                )
                peaks = np.abs(depth_window(frame, _DEPTH_MM, 1.5)).max(axis=1)[near]
                found.append(20 * np.log10(peaks) - square)
                predicted.append(_kirchhoff_db(heights, step, probe, positions[near]))
            mean, what = float(np.mean(found)), f"rms height {rms:g} mm, {frequency:g} MHz"
            rows.append(Row(f"mean level, {what}", "dB", float(np.mean(predicted)), mean, 1.5))
            # Of lines in the middle half: others are in dips of the interference, where a little is many decibels.
            off = float(np.median(np.abs(np.subtract(found, predicted))))
            rows.append(Row(f"median difference of lines, {what}", "dB", 0.0, off, 2.5, "at most"))
            if frequency == 2.5:
                low, high = _FULL_WAVE[rms]
                rows.append(Row(f"full wave, {what}", "dB", 0.5 * (low + high), mean, 0.5 * (high - low) + 1.0))
    return Outcome(tuple(rows))


def thickness_of_sheets(rotation: np.ndarray, device) -> Outcome:
    """Sheets of 0.1 to 0.45 mm: level and thickness of the diffuse echo of membranes, and of the echo of dura."""
    silent = replace(FLUID, mu0=0.0, sigma0=0.0)
    phantom = layered([silent, replace(silent, name="brain")], [_DEPTH_MM], rotation, half_width_mm=26.0,
                      half_thickness_mm=10.0)  # fmt: skip
    rows = []
    simulator = UltrasoundSimulator(
        phantom.labels, TissueTable({**phantom.tissues, 0: silent}, _MEMBRANE), _LOUD, device
    )
    for thickness in (0.1, 0.15, 0.3, 0.45):
        membrane = replace(_MEMBRANE, thickness_mm=thickness)
        simulator.set_tissues(TissueTable({**phantom.tissues, 0: silent}, membrane))
        for where, probe in _shipped() if thickness in (0.1, 0.45) else [("linear 5 MHz", _shipped_at("linear", 5.0))]:
            power = 0.0
            for seed in range(_SEEDS):
                simulator.settings = replace(_LOUD, seed=seed, interfaces=False)
                frame = simulator.simulate(probe, phantom.probe_to_ras, EVEN)
                power = power + _profile(frame, probe)
            measured = np.sqrt(power / _SEEDS)
            sigma = probe.axial_sigma_mm
            edges = [special.erf((_AWAY_MM + side * 0.5 * thickness) / sigma) for side in (1, -1)]
            variance = membrane.tissue.scatterer_variance * 10.0 ** (membrane.diffuse_db / 10.0)
            predicted = np.sqrt(0.5 * variance * (edges[0] - edges[1]))
            what = f"sheet of {thickness:g} mm, {where}"
            expected, level = (float(20 * np.log10(profile.max())) for profile in (predicted, measured))
            # In the thinnest there are few scatterers.
            rows.append(Row(f"level, {what}", "dB", expected, level, 4.0 if thickness == 0.1 else 3.0))
            # Along a sheet that is oblique to voxels of half a millimetre, its place varies by a tenth of it.
            for at, name, more in ((0.5, "-6", 0.12), (0.1, "-20", 0.17)):
                thin, width = (full_width(_AWAY_MM, profile, at) for profile in (predicted, measured))
                rows.append(Row(f"thickness at {name} dB, {what}", "mm", thin, width, more, "at most"))
    return Outcome(tuple(rows))


def _profile(frame: Frame, probe: Probe) -> np.ndarray:
    """Mean power at `_AWAY_MM` from the plane, over the scan lines within 8 mm of the axis."""
    origins, directions = probe.origins_mm(), probe.directions()
    along = np.arange(frame.iq.shape[1]) * frame.sample_interval_mm
    power = []
    for line, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        # Oblique lines meet the sheet at an angle, at which it is thicker.
        reached = (_DEPTH_MM - origin[1]) / direction[1]
        if abs(origin[0] + reached * direction[0]) < 8.0 and direction[1] > np.cos(np.radians(12.0)):
            power.append(np.interp(reached + _AWAY_MM, along, np.abs(frame.iq[line]) ** 2))
    return np.mean(power, axis=0)


CHECKS = (
    Check(
        "rough planes",
        "A plane that is rough in its labels echoes as the sum over its heights does, and as full-wave simulation of "
        "rough planes.",
        rough_planes,
    ),
    Check(
        "thickness of sheets", "A sheet thinner than the pulse is one line as thick as the pulse.", thickness_of_sheets
    ),
    Check(
        "rough sheets",
        "The coherent echo of a sheet of rms height s falls as exp(-(2 k s cos t)^2) of its power; the rest is "
        "diffuse.",
        coherent_part,
    ),
)
