"""Checks of the beam: level and width of interface echoes (docs/physics.md#3-rays), resolution and slice thickness
(docs/physics.md#4-beam-and-pulse)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.beam import FWHM_PER_SIGMA
from SlicerUSSim.Logic.probe.poses import elevational_motion, sample, slide_sweep, tilt_sweep
from validation.apertures import lens_profile, mirror_echo_db
from validation.checks import PROBES, Check, Outcome, Row
from validation.measurement import EVEN, depth_window, echo_near, full_width
from validation.phantoms import (
    FLUID,
    Echo,
    layered,
    reflection_coefficient,
    small_sheet,
    thin_rod,
    wires_and_cysts,
)
from validation.pictures import Curve, Plot, draw_cross_sections, draw_plots

#: Forms an interface with FLUID that does not refract
BEHIND = replace(FLUID, name="behind", impedance_mrayl=1.9)


def echo_level(rotation: np.ndarray, device) -> Outcome:
    """A plane interface across the beam, with the pressure and the energy reflection coefficient."""
    r = reflection_coefficient(FLUID, BEHIND)
    rows = []
    phantom = layered([FLUID, BEHIND], [25.0], rotation, spacing_mm=0.25, half_width_mm=14.0)
    settings = SimulationSettings(scattering=False)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, settings, device)
    for kind, expected in (("pressure", r), ("energy", r * r)):
        simulator.settings = replace(simulator.settings, interface_reflection=kind)
        for name, probe in PROBES.items():
            low = replace(probe, frequency_mhz=2.0)  # as for reverberation
            peak = echo_near(simulator.simulate(low, phantom.probe_to_ras, EVEN), low, (0.0, 25.0), 1.0)[2]
            # The lines of a sector meet a plane at right angles only in the middle: at y it is y^2 / 2 R further away.
            radius = low.apex_radius_mm + 25.0
            turns = 2 * np.pi * low.cycles_per_mm * float(low.beam_sigma_mm(25.0)[0]) ** 2 / radius
            predicted = 20 * np.log10(expected * (1 + turns**2) ** -0.25) + settings.interface_gain_db
            rows.append(Row(f"{kind} echo, {name}", "dB", predicted, 20 * np.log10(peak), 0.5))
    return Outcome(tuple(rows))


def specular_echoes(rotation: np.ndarray, device) -> Outcome:
    """The echo of every hit is w A |r| cos^n(i): a plane tilted by 15 degrees, two exponents."""
    before = replace(FLUID, attenuation_db_cm_mhz=0.4)
    r = reflection_coefficient(before, BEHIND)  # the same speed on both sides, so independent of the angle
    phantom = layered([before, BEHIND], [20.0], rotation, tilt_deg=15.0)
    settings = SimulationSettings(reflections=False)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, settings, device)
    rows = []
    for exponent in (0.0, 3.0):
        simulator.settings = replace(simulator.settings, specular_exponent=exponent)
        for name, probe in PROBES.items():
            hits = simulator.trace(probe, phantom.probe_to_ras).hits
            loss = 10 ** (-0.4 * probe.frequency_mhz * 2 * hits["path_mm"].astype(float) / 10 / 20)
            gain = 10 ** (settings.interface_gain_db / 20) / settings.elevational_rays
            ratio = hits["echo"] / (loss * r * gain * hits["cos_incidence"].astype(float) ** exponent)
            # If a voxelised normal is tilted out of the plane, the echo of a ray is slightly lower, but never higher;
            # the mean attenuation over an aperture has the noise of its voxels.
            rows += [
                Row(f"median, n = {exponent:.0f}, {name}", "", 1.0, float(np.median(ratio)), 0.01),
                Row(f"largest, n = {exponent:.0f}, {name}", "", 1.0, float(ratio.max()), 0.04, "at most"),
            ]
    return Outcome(tuple(rows))


def tilted_in_elevation(rotation: np.ndarray, device) -> Outcome:
    """A plane tilted out of the image plane: its echo agrees with its mirror images over the lens.

    Where the beam is wide, rays meet a steep plane at ranges that differ by a pulse length or more. The integral over
    the stratum of each ray still vanishes, as does the integral over the whole beam. Without it, the image would show
    one line per ray.
    """
    phantom = layered([FLUID, BEHIND], [25.0], rotation, spacing_mm=0.25, half_width_mm=14.0)
    settings = SimulationSettings(scattering=False, specular_exponent=0.0)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, settings, device)
    rows = []
    for name, probe in PROBES.items():
        low = replace(probe, frequency_mhz=2.0)

        def peak(probe, tilt: float, depth: float) -> float:
            motion = elevational_motion(angle_deg=tilt)
            # The plane's point on the axis lies `depth` before the face.
            motion[:3, 3] = [0.0, 25.0, 0.0] - motion[:3, :3] @ [0.0, depth, 0.0]
            frame = simulator.simulate(probe, phantom.probe_to_ras @ motion, EVEN)
            return echo_near(frame, probe, (0.0, depth), 2.0)[2]

        peaks = {tilt: peak(low, tilt, 25.0) for tilt in (0.0, 2.0, 3.0, 8.0)}
        for tilt, theory in zip((2.0, 3.0), mirror_echo_db(low, (2.0, 3.0), 25.0, 90.0).tolist(), strict=True):
            rows.append(Row(f"{tilt:.0f} degrees, {name}", "dB", theory, 20 * np.log10(peaks[tilt] / peaks[0.0]), 1.0))
        rows.append(Row(f"8 degrees, {name}", "dB", -15.0, 20 * np.log10(peaks[8.0] / peaks[0.0]), 0.0, "at most"))
        wide = replace(probe, elevation_focus_mm=55.0)
        fall = 20 * np.log10(max(peak(wide, 16.0, 12.0), 1e-9) / peak(wide, 0.0, 12.0))
        rows.append(Row(f"16 degrees in a wide beam, {name}", "dB", -36.0, fall, 0.0, "at most"))
    return Outcome(tuple(rows))


def interface_width(rotation: np.ndarray, device) -> Outcome:
    """A small sheet away from the focus: its profile is a box convolved with the beam."""
    half, depth = 1.5, 20.0
    phantom = small_sheet(rotation, depth_mm=depth, half_mm=half)
    # The second moment belongs to the main beam.
    settings = SimulationSettings(scattering=False, side_lobes=False, elevational_rays=16, specular_exponent=0.0)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, settings, device)
    offsets = np.arange(-5.0, 5.01, 0.5)
    rows, plots = [], []
    for name, probe in PROBES.items():
        # At 2 MHz the echo of a flat sheet is in phase over the curved wavefront of a sector.
        low = replace(probe, focus_mm=35.0, elevation_focus_mm=35.0, frequency_mhz=2.0)
        sigma_l, sigma_e = (float(s) for s in low.beam_sigma_mm(depth))

        def echo(offset_mm: float, low=low) -> np.ndarray:
            frame = simulator.simulate(low, phantom.probe_to_ras @ elevational_motion(offset_mm), EVEN)
            return np.abs(depth_window(frame, depth, 2.0)).max(axis=1)

        across = low.line_positions() / low.line_spacing * low.line_distance_mm(depth)
        profiles = {
            "lateral": (across, echo(0.0), sigma_l),
            "elevational": (offsets, np.array([echo(offset)[79:82].mean() for offset in offsets]), sigma_e),
        }
        for axis, (positions, values, sigma) in profiles.items():
            predicted = float(np.sqrt((2 * half) ** 2 / 12 + sigma**2))
            spread = _spread(positions, values)
            rows.append(Row(f"{axis} standard deviation, {name}", "mm", predicted, spread, 0.1 * predicted))
            if name == "linear":
                # A box convolved with a Gaussian.
                theory = ndtr((positions + half) / sigma) - ndtr((positions - half) / sigma)
                curve = Curve(
                    f"sigma {sigma:.2f} mm", positions, values / values.max(), positions, theory / theory.max()
                )
                plots.append(Plot(f"sheet of {2 * half:.0f} mm", f"{axis} [mm]", "echo", [curve]))
    return Outcome(tuple(rows), partial(draw_plots, plots=plots))


def _spread(positions: np.ndarray, values: np.ndarray) -> float:
    """Standard deviation of a profile: square root of the second moment about its mean."""
    mean = np.average(positions, weights=values)
    return float(np.sqrt(np.average((positions - mean) ** 2, weights=values)))


def resolution(rotation: np.ndarray, device) -> Outcome:
    """Wires thinner than the beam: their echoes have the width of the point spread function at their depth."""
    phantom = wires_and_cysts(rotation)
    settings = SimulationSettings(scattering=False, reflections=False)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, settings, device)
    rows, curves = [], []
    for name, probe in PROBES.items():
        fine = replace(probe, scan_lines=481)
        frame = simulator.simulate(fine, phantom.probe_to_ras, EVEN)
        for wire in (
            e
            for e in phantom.expected(fine)
            if isinstance(e, Echo) and e.name in ("wire at 20 mm", "wire at 30 mm", "wire at 40 mm")
        ):
            depth = float(fine.line_through(*wire.shown_mm)[1])
            at = round(depth / frame.sample_interval_mm)
            band = np.abs(frame.iq[:, at - 12 : at + 13]).max(axis=1)
            x = np.arange(len(band)) * fine.line_distance_mm(depth)
            width = full_width(x, band)
            predicted = float(fine.beam_sigma_mm(depth)[0]) * FWHM_PER_SIGMA
            rows.append(Row(f"lateral FWHM, {wire.name}, {name}", "mm", predicted, width, 0.15 * predicted))
            if name == "linear":
                x = x - x[np.argmax(band)]
                near = abs(x) < 1.5
                theory = np.exp(-4 * np.log(2) * (x[near] / predicted) ** 2)
                curves.append(Curve(wire.name, x[near], band[near] / band.max(), x[near], theory))
    plot = Plot("wires, linear array", "lateral [mm]", "echo", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


def slice_thickness(rotation: np.ndarray, device) -> Outcome:
    """A thin bar in the image plane of a probe that moves away from it: its power follows the elevational profile."""
    depth, width = 30.0, 1.2
    phantom = thin_rod(rotation, depth_mm=depth, width_mm=width)
    # Dense scatterers, so that the power depends on the beam and not on individual scatterers.
    settings = SimulationSettings(scatterers_per_mm3=1000.0)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, settings, device)
    rows, curves = [], []
    for name, probe in PROBES.items():
        wide = replace(probe, elevation_focus_mm=55.0)
        sigma = float(wide.beam_sigma_mm(depth)[1])
        offsets = sigma * np.array([0.0, 0.5, 1.0, 1.5, 2.0])
        # To both sides: one has too few independent scatterers for the limits below.
        poses = [phantom.probe_to_ras @ elevational_motion(offset) for offset in (*offsets, *-offsets)]
        powers = [_band_power(frame, wide, depth) for frame in simulator.sweep(wide, poses, EVEN)]
        powers = np.reshape(powers, (2, -1)).mean(0)
        measured = 10 * np.log10(np.maximum(powers, 1e-30) / powers[0])
        expected = _bar_fall_db(wide, depth, offsets, width)
        rows += [
            Row(f"fall at {offset / sigma:.1f} sigma out of plane, {name}", "dB", e, m, 0.5 + 0.08 * abs(e))
            for offset, e, m in zip(offsets[1:], expected[1:], measured[1:], strict=True)
        ]
        curves.append(Curve(name, offsets, measured, offsets, expected))
    plot = Plot("a thin bar", "distance from the image plane [mm]", "power [dB]", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


def _bar_fall_db(probe: Probe, depth_mm: float, offsets_mm: np.ndarray, width_mm: float) -> np.ndarray:
    """Theoretical power in dB of a bar of this width at distances from the image plane, relative to the first."""
    across = np.linspace(-0.5 * width_mm, 0.5 * width_mm, 25)
    beside = np.abs(across - offsets_mm[:, None])
    power = (lens_profile(probe, depth_mm, beside.ravel()) ** 2).reshape(beside.shape).mean(axis=1)
    return 10 * np.log10(power / power[0])


def _band_power(frame, probe, depth_mm: float) -> float:
    """Mean power around the bar on the middle lines; the outer lines of curved arrays meet it at a larger range."""
    middle = slice(len(frame.iq) // 2 - 40, len(frame.iq) // 2 + 41)
    # Range of the bar on the outermost of these lines.
    origin, direction = probe.line_at(probe.line_positions()[middle][-1])
    farthest = (depth_mm - origin[1]) / direction[1]
    ends = (depth_mm - 2.0, farthest + 2.0)
    samples = slice(*(int(end / frame.sample_interval_mm) for end in ends))
    return float((np.abs(frame.iq[middle, samples]) ** 2).mean())


def compounding(rotation: np.ndarray, device) -> Outcome:
    """The thin bar in volumes compounded from a slide, a tilt (as by a matrix array) and a freehand sweep."""
    depth, width = 30.0, 1.2
    phantom = thin_rod(rotation, depth_mm=depth, width_mm=width)
    settings = SimulationSettings(scatterers_per_mm3=300.0)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, settings, device)
    probe = replace(PROBES["linear"], width_mm=20.0, scan_lines=101, elevation_focus_mm=55.0)
    display = DisplaySettings(look="even", gain_db=-25.0, dynamic_range_db=100.0, tgc_db_cm_mhz=0.0, noise_db=None)
    sigma = float(probe.beam_sigma_mm(depth)[1])
    sweeps = {
        "slide": slide_sweep(phantom.probe_to_ras, 10.0, 41),
        "tilt": tilt_sweep(phantom.probe_to_ras, 18.0, 41),
        "freehand": freehand_sweep(phantom.probe_to_ras, 10.0, 60),
    }
    offsets = sigma * np.array([0.0, 0.5, 1.0, 1.5])
    theory = _bar_fall_db(probe, depth, offsets, width)
    rows, volumes = [], {}
    for name, poses in sweeps.items():
        volume = volumes[name] = simulator.volume(probe, poses, display, spacing_mm=0.35)
        level = _bar_level_db(volume, phantom.probe_to_ras, depth, offsets) * display.dynamic_range_db / 255.0
        rows += [
            Row(f"fall at {offset / sigma:.1f} sigma, {name}", "dB", e, m - level[0], 0.8)
            for offset, e, m in zip(offsets[1:], theory[1:], level[1:], strict=True)
        ]
        _, y, z = _bar_centre(volume, phantom.probe_to_ras, depth)
        off = float(np.hypot(y - depth, z))
        rows.append(Row(f"position error of the bar, {name}", "mm", 0.0, off, 0.3, "at most"))
    draw = partial(draw_cross_sections, volumes=volumes, probe_to_ras=phantom.probe_to_ras, depth_mm=depth)
    return Outcome(tuple(rows), draw)


def freehand_sweep(probe_to_ras: np.ndarray, length_mm: float, frames: int, seed: int = 0) -> list[np.ndarray]:
    """A freehand slide: uneven steps, drift and tilt in every direction."""
    rng = np.random.default_rng(seed)
    along = np.cumsum(rng.uniform(0.3, 1.7, frames))
    along = (along - along[0]) / (along[-1] - along[0]) - 0.5
    # Slow oscillations of a few degrees and half a millimetre, different for every axis.
    wave = np.sin(2 * np.pi * (along[:, None] * rng.uniform(0.5, 2.0, 6) + rng.uniform(0, 1, 6)))
    poses = []
    for offset, (a, b, c, x, y, z) in zip(along * length_mm, wave, strict=True):
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_euler("xyz", [3 * a, 2 * b, 2 * c], degrees=True).as_matrix()
        motion[:3, 3] = [0.5 * x, 0.2 * y, offset + 0.2 * z]
        poses.append(probe_to_ras @ motion)
    return poses


def _bar_level_db(volume: Volume, probe_to_ras: np.ndarray, depth_mm: float, offsets_mm: np.ndarray) -> np.ndarray:
    """(offsets,) mean grey level of the bar at distances from its plane, on both sides."""
    x, y = np.meshgrid(np.linspace(-7, 7, 80), depth_mm + np.linspace(-0.3, 0.3, 5))
    levels = []
    for offset in offsets_mm:
        sides = [np.stack([x, y, np.full_like(x, side * offset), np.ones_like(x)], axis=-1) for side in (-1, 1)]
        points = np.stack(sides) @ probe_to_ras.T
        levels.append(sample(volume, points[..., :3]).mean())
    return np.array(levels)


def _bar_centre(volume: Volume, probe_to_ras: np.ndarray, depth_mm: float) -> np.ndarray:
    """Centroid of the brightest voxels near the bar, in the probe frame."""
    grey = volume.array.astype(float)
    ijk = np.argwhere(grey > 0.85 * np.percentile(grey[grey > 0], 99.5))[:, ::-1]
    points = np.c_[ijk, np.ones(len(ijk))] @ (np.linalg.inv(probe_to_ras) @ volume.ijk_to_ras).T
    near = (abs(points[:, 0]) < 8) & (np.hypot(points[:, 1] - depth_mm, points[:, 2]) < 4)
    return points[near, :3].mean(axis=0)


CHECKS = (
    Check(
        "echo level",
        "The echo of a plane interface across the beam is r, or r^2 by the paper's eq. 2, times the gain.",
        echo_level,
    ),
    Check("specular echoes", "The echo of a hit is w A |r| cos^n of the angle of incidence.", specular_echoes),
    Check(
        "elevational tilt",
        "The echo of a plane tilted out of the image agrees with its mirror images: sums over the ways of the lens.",
        tilted_in_elevation,
    ),
    Check("interface width", "The echo of a small sheet is widened by the beam in both directions.", interface_width),
    Check("resolution", "The echo of a wire has the width of the beam at its depth.", resolution),
    Check(
        "slice thickness",
        "The power of a thin bar out of plane falls as the lens says: sums over its points, averaged over the bar.",
        slice_thickness,
    ),
    Check(
        "compounding",
        "In a volume compounded from many images the bar has its position and the thickness of the elevational beam.",
        compounding,
    ),
)
