"""The acquisition record of one frame, computed from the equations of docs/physics.md and the user's inputs.

Of a probe only its fields are read, no derived values of Probe. The record has the type layout.ACQUISITION, from which
it takes names and number formats, but no values.
"""

from __future__ import annotations

from functools import lru_cache
from typing import cast

import numpy as np
from scipy import optimize, special

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.opencl.layout import ACQUISITION, CONSTANTS
from SlicerUSSim.Logic.probe.arrays import ConvexProbe, LinearProbe, PhasedProbe, Probe
from tests.reference.elementary import hash_mix
from tests.reference.medium import HostMedium

_DESIGN_SPEED_M_S = 1540.0  # for wavelengths and focus widths of an array
_FWHM = np.sqrt(8.0 * np.log(2.0))  # of a Gaussian, in standard deviations
_HALF_OF_SINC = 0.6033545644016142  # sin(pi x) = pi x / 2
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


def acquisition_record(
    probe: Probe, probe_to_ras: np.ndarray, settings: SimulationSettings, medium: HostMedium
) -> np.ndarray:
    """() record of layout.ACQUISITION for `probe` at a pose (4, 4)."""
    record = np.zeros((), ACQUISITION)
    first, spacing, radius = _geometry(probe)
    lateral, guard = _traced_lines(probe, settings)
    traced = 2 * guard + 1 + lateral * (probe.scan_lines - 1)
    step = sample_mm(probe, settings)
    behind = len(pulse_taps(axial_sigma_mm(probe, settings) / step)) // 2  # half a pulse, in samples
    samples = int(np.ceil(_steering(probe)["depth_mm"] / step)) + behind
    membrane = medium.tissues.membrane
    elevational, elevational_length = _elevation(probe)
    density = settings.scatterers_per_mm3 or _automatic_density(probe)
    values = {
        "ras_to_voxel": medium.ras_to_voxel.ravel(),
        "dims": medium.dims,
        "voxel_mm": medium.voxel_mm,
        "smooth_groups": medium.smooth_groups,
        "membrane_reach": medium.membrane_reach,
        "sheet_label": medium.sheets.label
        if medium.sheets and medium.sheets.is_thin.any()
        else 64
        if medium.drawn
        else -1,
        "dura_label": next((n for n, tissue in medium.tissues.items() if tissue.name == "falx"), -1),
        "dura_isotropic": 0.1,
        "sheet_reach_mm": membrane.thickness_mm / 2.0 if membrane else 0.0,
        "membrane_gain": np.exp(membrane.diffuse_db * np.log(10.0) / 20.0) if membrane else 0.0,
        "membrane_exponent": membrane.diffuse_exponent if membrane else 0.0,
        "membrane_phase": 2.0 * np.pi * _cycles_per_mm(probe, settings) * membrane.roughness_mm if membrane else 0.0,
        "probe_to_ras": np.asarray(probe_to_ras, float)[:3].ravel(),
        "linear": _is_parallel(probe),
        "apex_radius_mm": radius,
        "first_line": first,
        "line_spacing": spacing,
        "scan_lines": probe.scan_lines,
        **_steering(probe),
        "face_reflection": probe.face_reflection,
        "face_half_mm": 0.5 * _face_mm(probe),
        "face_half_height_mm": 0.5 * probe.elevation_aperture_mm,
        "traced_mm": _steering(probe)["depth_mm"] + behind * step + medium.voxel_mm,
        "frequency_mhz": _received_mhz(probe),
        "fractional_bandwidth": _received_bandwidth(probe),
        "reference_speed_m_s": settings.reference_speed_m_s,
        "cycles_per_mm": _cycles_per_mm(probe, settings),
        "sample_mm": step,
        "samples": int(np.ceil(samples / CONSTANTS["BLOCK"])) * CONSTANTS["BLOCK"],
        **_transmit(probe),
        "wavefront_curvature": 0.6 if settings.wavefront_curvature else 0.0,
        "receive_sigma_min": _receive_sigma(probe, probe.receive_f_number),
        "receive_sigma_slope": _receive_sigma(probe, 1.0 / probe.aperture_mm),
        "elevation_sigma": elevational,
        "elevation_focus": probe.elevation_focus_mm,
        "elevation_rayleigh": elevational_length,
        "speckle_height_mm": _speckle_heights(probe) if settings.wavefront_curvature else np.zeros(33),
        "aperture_beams": settings.beam == "aperture",
        "aperture_mm": probe.aperture_mm,
        "receive_f_number": probe.receive_f_number,
        "screen_lines": max(2, int(np.ceil(traced / 3))),
        **_fans(probe, medium.voxel_mm, 0.5 * (traced - 1) * spacing / lateral),
        "max_ray_depth": settings.max_ray_depth if settings.reflections else 0,
        "intensity_threshold": settings.intensity_threshold,
        "reflection_threshold": settings.reflection_threshold,
        "reflection_spreading": settings.reflection_spreading,
        "elevational_rays": settings.elevational_rays,
        "lateral_rays": lateral,
        "guard_lines": guard,
        "traced_lines": traced,
        "interface_gain": np.exp(settings.interface_gain_db * np.log(10.0) / 20.0),
        "interface_is_energy": settings.interface_reflection == "energy",
        "specular_exponent": settings.specular_exponent,
        "downshift": (_received_bandwidth(probe) / _FWHM) ** 2 if settings.frequency_downshift else 0.0,
        "band_above": np.log(special.erfc(-_FWHM / _received_bandwidth(probe)))
        if settings.frequency_downshift
        else np.log(2.0),
        "cell_mm": np.cbrt(1.0 / density),
        "seed": hash_mix(np.array([settings.seed], np.uint32))[0] ^ np.uint32(0x2545F491),
        "beam_cutoff": settings.beam_cutoff,
        # Scatterers of unit variance give unit mean square: the integral of the squared point spread function of
        # unit height is the product of its sigmas and pi^1.5.
        "speckle_scale": 1.0 / np.sqrt(density * np.pi**1.5 * axial_sigma_mm(probe, settings)),
    }
    assert set(values) == set(ACQUISITION.names or ())
    for name, value in values.items():
        record[name] = value
    return record


def _transmit(probe: Probe) -> dict[str, object]:
    """Foci of the transmit beam, or its widths where it is in focus at every depth."""
    if probe.transmit == "angles":
        least, slope = _compounded(probe)
        zones, only = [], [least]
    else:
        zones = _zones(probe)
        only = [sigma for sigma, _ in zones]
        slope = 0.0

    def padded(values: list[float]) -> list[float]:
        return values + (8 - len(values)) * [0.0]

    lengths = [_rayleigh_mm(probe, sigma) for sigma, _ in zones]
    return {
        "transmit_zones": len(zones),
        "transmit_sigma": padded(only),
        "transmit_focus": padded([focus for _, focus in zones]),
        "transmit_rayleigh": padded(lengths),
        "transmit_waist": min(lengths) if zones else 2.0 * probe.depth_mm,
        "transmit_sigma_slope": slope,
    }


def _zones(probe: Probe) -> list[tuple[float, float]]:
    """(sigma, depth) of every transmit focus."""
    if probe.transmit == "focus":
        return [(_sent_sigma(probe, max(probe.focus_mm / probe.aperture_mm, 0.5)), probe.focus_mm)]
    count = probe.focal_zones
    foci = [probe.focus_mm * (n + n + 1) / count for n in range(count)]
    return [(_sent_sigma(probe, max(focus / probe.aperture_mm, probe.receive_f_number, 0.5)), focus) for focus in foci]


def _compounded(probe: Probe) -> tuple[float, float]:
    """(sigma, sigma per depth) of n waves: over n / (n - 1) times their range of angles, or of all the face."""
    count = probe.transmit_angles
    whole = 2.0 * np.sin(probe.largest_angle_deg * np.pi / 180.0) * count / (count - 1) if count > 1 else 1e-4
    first, _, radius = _geometry(probe)
    face = probe.width_mm if isinstance(probe, LinearProbe) else 2.0 * radius * np.sin(-first)
    return _one_way_sigma(probe, 1.0 / whole), _one_way_sigma(probe, 1.0 / max(face, probe.aperture_mm))


def _lateral_sigma(probe: Probe, depth: np.ndarray) -> np.ndarray:
    """Of the two-way beam."""
    if probe.transmit == "angles":
        least, slope = _compounded(probe)
        transmit = np.maximum(least, slope * depth)
    else:
        transmit = np.min(
            [sigma * np.hypot(1.0, (depth - at) / _rayleigh_mm(probe, sigma)) for sigma, at in _zones(probe)], axis=0
        )
    receive = _receive_sigma(probe, 1.0) * np.maximum(probe.receive_f_number, depth / probe.aperture_mm)
    return 1.0 / np.sqrt(transmit**-2.0 + receive**-2.0)


def _automatic_density(probe: Probe) -> float:
    """Eight scatterers in the smallest resolution cell, at least 4 per mm^3 and no more than in the paper's lattice."""
    depth = np.linspace(0.0, probe.depth_mm, 257)

    sigma, length = _elevation(probe)
    across = sigma * np.hypot(1.0, (depth - probe.elevation_focus_mm) / length)
    axial = 1e-3 * _DESIGN_SPEED_M_S * _FWHM / (4.0 * np.pi * _received_bandwidth(probe) * _received_mhz(probe))
    cell = (2.0 * np.pi) ** 1.5 * axial * across * _lateral_sigma(probe, depth)
    return min(max(8.0 / float(cell.min()), 4.0), 125_000.0)


def axial_sigma_mm(probe: Probe, settings: SimulationSettings) -> float:
    """Standard deviation of the pulse in depth: c / (4 pi sf), sf = bandwidth f0 / 2.355."""
    sigma_mhz = _received_bandwidth(probe) * _received_mhz(probe) / _FWHM
    return 1e-3 * settings.reference_speed_m_s / (4.0 * np.pi * sigma_mhz)


def sample_mm(probe: Probe, settings: SimulationSettings) -> float:
    """Depth between samples."""
    return 1.0 / (settings.samples_per_cycle * _cycles_per_mm(probe, settings))


def line_roots(acquisition: np.ndarray) -> np.ndarray:
    """(traced lines, 4) float32 origin (x, y) and direction (x, y) of every traced line in the probe frame."""
    n = np.arange(int(acquisition["traced_lines"]))
    step = float(acquisition["line_spacing"]) / float(acquisition["lateral_rays"])
    at = float(acquisition["first_line"]) + (n - float(acquisition["guard_lines"])) * step
    if acquisition["linear"]:
        sine, cosine = float(acquisition["steering_sin"]), float(acquisition["steering_cos"])
        return np.column_stack([at / cosine, 0 * at, 0 * at + sine, 0 * at + cosine]).astype(np.float32)
    towards = np.column_stack([np.sin(at), np.cos(at)])
    if acquisition["steered"]:
        on_face = np.column_stack([float(acquisition["apex_radius_mm"]) * np.tan(at), 0 * at])
        return np.column_stack([on_face, towards]).astype(np.float32)
    start = float(acquisition["apex_radius_mm"]) * (towards - [0.0, 1.0])  # the apex lies a radius above the face
    return np.column_stack([start, towards]).astype(np.float32)


def elevational_quantiles(traced: int, rays: int) -> np.ndarray:
    """(traced, rays) float32 positions of the rays in the elevational beam, in its standard deviations."""
    line, ray = np.arange(traced)[:, None], np.arange(rays)
    place_in_stratum = 0.5 + 0.7 * ((0.5 + line * _GOLDEN) % 1.0 - 0.5)
    return special.ndtri((ray + place_in_stratum) / rays).astype(np.float32)


def stratum_centres(strata: np.ndarray, rays: int) -> np.ndarray:
    """float32 middle quantiles of strata 0 to rays - 1, in standard deviations; all of them have the variance 1."""
    middle = special.ndtri((np.arange(rays) + 0.5) / rays)
    return (middle / np.maximum(np.sqrt(np.mean(middle**2)), 1e-6)).astype(np.float32)[strata]


def pulse_taps(sigma: float) -> np.ndarray:
    """(2 n + 1,) float32 envelope of the pulse; its width with the interpolation of impulses is `sigma` samples."""
    own = np.sqrt(np.maximum(sigma * sigma - 1.0 / 6.0, 0.25))
    at = np.arange(np.ceil(3.7 * own) + 1.0)
    half = sigma / own * np.exp(-(at * at) / (2.0 * own * own))
    return np.concatenate([half[:0:-1], half]).astype(np.float32)


def noise_key(acquisition: np.ndarray, noise_seed: int) -> np.uint32:
    """Initial value of the noise's hash."""
    seed, draw = np.array([acquisition["seed"]], np.uint32), np.array([noise_seed], np.uint32)
    return (seed * np.uint32(0x9E3779B1) + np.uint32(0x7F4A7C15) + hash_mix(draw))[0]


def _fans(probe: Probe, voxel_mm: float, edge: float) -> dict[str, float]:
    """Fans and screens of beams, for lines traced between -edge and edge (radians about the apex, or millimetres)."""
    _, _, radius = _geometry(probe)
    longest = 1.06 * probe.depth_mm  # paths in the fastest soft tissue
    screens = min(max(int(np.ceil(longest / 8.0)), 8), 24)
    # By the triangle inequality, no point of the aperture is further from a target than the axis and half of it.
    reach = longest + 0.5 * probe.aperture_mm
    depths = min(int(np.ceil(reach / min(max(voxel_mm, 0.25), 1.0))) + 1, 192)
    # The aperture's edges are seen under 1 / (2 f-number); from a curved array, also under its own angle.
    half_angle, length, pitch = 0.5 / probe.receive_f_number, probe.aperture_mm, probe.aperture_mm / 12.0
    if isinstance(probe, PhasedProbe):
        half_angle += edge
    else:
        scale = radius if isinstance(probe, ConvexProbe) else 1.0
        if isinstance(probe, LinearProbe) and probe.trapezoid_deg:
            scale = radius * np.tan(edge) / edge
            half_angle += edge
        elif isinstance(probe, LinearProbe):
            tilt = np.abs(probe.steering_deg) * np.pi / 180.0
            scale = 1.0 / np.cos(tilt)
            half_angle += tilt
        length += 2.0 * edge * scale
        pitch = max(pitch, length / 95.0)
        if isinstance(probe, ConvexProbe):
            half_angle += 0.5 * (probe.aperture_mm + pitch) / radius
    half_angle = min(half_angle, 1.5)
    points, angles = round(length / pitch) + 1, int(np.ceil(2.0 * half_angle / 0.022)) + 1
    return {
        "screen_depths": screens,
        "screen_step": longest / screens,
        "fan_points": points,
        "fan_first": 0.5 * pitch * (1 - points),
        "fan_pitch": pitch,
        "fan_angles": angles,
        "fan_first_angle": -half_angle,
        "fan_angle_step": 2.0 * half_angle / (angles - 1),
        "fan_depths": depths,
        "fan_step": reach / (depths - 1),
    }


def _geometry(probe: Probe) -> tuple[float, float, float]:
    """(first line, step between lines, radius of the face): radians about the apex, or millimetres and 0 if linear."""
    if isinstance(probe, LinearProbe):
        whole, radius = probe.width_mm * np.cos(probe.steering_deg * np.pi / 180.0), 0.0
        if probe.trapezoid_deg:
            whole = 2.0 * probe.trapezoid_deg * np.pi / 180.0
            radius = 0.5 * probe.width_mm / np.tan(0.5 * whole)
    else:
        if not isinstance(probe, ConvexProbe | PhasedProbe):
            name = type(probe).__name__
            raise SimulationError(f"the numpy model has no {name}, expected LinearProbe, ConvexProbe or PhasedProbe")
        whole = probe.field_of_view_deg * np.pi / 180.0
        radius = probe.radius_mm if isinstance(probe, ConvexProbe) else 0.0
    return -0.5 * whole, whole / (probe.scan_lines - 1), radius


def _received_mhz(probe: Probe) -> float:
    return probe.frequency_mhz + (probe.frequency_mhz if probe.harmonic else 0.0)


def _received_bandwidth(probe: Probe) -> float:
    """Re the received frequency: twice that of the pulse, whose square has a band wider by the root of 2."""
    return probe.fractional_bandwidth * (np.sqrt(0.5) if probe.harmonic else 1.0)


def _elevation(probe: Probe) -> tuple[float, float]:
    """(sigma at the focus, Rayleigh length) of the two-way elevational beam."""
    sigma = _one_way_sigma(probe, max(probe.elevation_focus_mm / probe.elevation_aperture_mm, 0.5))
    if probe.harmonic:  # of the pulse sigma and length are twice as large; transmitted, squared, received
        return np.sqrt(2.0 / 3.0) * sigma, np.sqrt(2.0) * _rayleigh_mm(probe, sigma)
    return np.sqrt(0.5) * sigma, _rayleigh_mm(probe, sigma)


@lru_cache(maxsize=16)
def _speckle_heights(probe: Probe) -> np.ndarray:
    """(33,) elevational sigma of speckle at depths from the face on, from Fresnel's integral over the aperture."""
    focus, wavelength = probe.elevation_focus_mm, received_wavelength_mm(probe)
    aperture = min(probe.elevation_aperture_mm, 2.0 * focus)
    step, heights = aperture / 512.0, []
    for depth in np.linspace(0.0, _steering(probe)["depth_mm"], 33):
        half = 2.0 * aperture + 24.0 * wavelength * depth / aperture
        place = (np.arange(2 * round(half / step)) + 0.5) * step - step * round(half / step)
        both = _field_of_lens(place, wavelength, aperture, focus, depth)
        both = both * (_field_of_lens(place, 2.0 * wavelength, aperture, focus, depth) ** 2 if probe.harmonic else both)
        energy, lag, before, here = (np.abs(both) ** 2).sum(), 0, 1.0, 1.0
        while here >= 0.5:
            lag, before = lag + 1, here
            here = float(np.abs((both[lag:] * both[:-lag].conj()).sum()) / energy)
        heights.append((lag - (0.5 - here) / (before - here)) * step / np.sqrt(np.log(16.0)))
    return np.array(heights)


def _field_of_lens(x: np.ndarray, wavelength: float, aperture: float, focus: float, depth: float) -> np.ndarray:
    """The field of a uniform aperture with one focus, at distances x from the axis, by Fresnel's integrals."""
    if depth == 0.0:
        return np.exp(-1j * np.pi * x**2 / (wavelength * focus)) * (np.abs(x) < 0.5 * aperture)
    bend, phase = (1.0 / depth - 1.0 / focus) / wavelength, np.pi * x**2 / (wavelength * depth)
    if abs(bend) * aperture**2 < 1e-4:
        return np.exp(1j * phase) * np.sinc(x * aperture / (wavelength * depth))
    centre, scale = x / (wavelength * depth * bend), np.sqrt(2.0 * abs(bend))
    (sine, cosine), (sine0, cosine0) = (special.fresnel(scale * (0.5 * s * aperture - centre)) for s in (1.0, -1.0))
    return np.exp(1j * (phase - np.pi * bend * centre**2)) * (cosine - cosine0 + 1j * np.sign(bend) * (sine - sine0))


def _sent_sigma(probe: Probe, f_number: float) -> float:
    """Of a transmit beam at its focus: of the pulse, or its square at half the received frequency."""
    return _one_way_sigma(probe, f_number) * (np.sqrt(2.0) if probe.harmonic else 1.0)


def harmonic_level(probe: Probe, depth: np.ndarray) -> np.ndarray:
    """Amplitude of the second harmonic, 1 at the focus: what the square of the pulse's beam has fed up to a depth."""
    edges = np.linspace(0.0, max(float(depth.max()), probe.focus_mm), 20_001)
    middle, step = 0.5 * (edges[1:] + edges[:-1]), edges[1]
    lens = _one_way_sigma(probe, max(probe.elevation_focus_mm / probe.elevation_aperture_mm, 0.5))
    source = (1.0 + 1j * (middle - probe.elevation_focus_mm) / (2.0 * _rayleigh_mm(probe, lens))) ** -0.5
    if probe.transmit == "angles":
        grown = np.abs(np.cumsum(source) * step)
    else:
        each, width = [], []
        for sigma, focus in _zones(probe):
            away = (middle - focus) / _rayleigh_mm(probe, sigma)
            each.append(np.abs(np.cumsum(source * (1.0 + 1j * away) ** -0.5) * step) / np.sqrt(sigma))
            width.append(sigma * np.hypot(1.0, (edges[1:] - focus) / _rayleigh_mm(probe, sigma)))
        zone = np.argmin(width, axis=0)
        grown = np.choose(zone, each)
        # Logarithms have the steps between neighbouring depths of one zone, also where another one takes over.
        steps = np.diff(np.log(grown))
        for n in np.flatnonzero(np.diff(zone)):
            steps[n] = np.log(each[zone[n]][n + 1] / each[zone[n]][n])
        grown = grown[0] * np.exp(np.append(0.0, np.cumsum(steps)))
    grown = np.append(0.0, grown)
    grown /= np.interp(probe.focus_mm, edges, grown)
    return np.interp(depth, edges, np.sqrt((grown**2 + 0.01) / 1.01))


def _is_parallel(probe: Probe) -> bool:
    return isinstance(probe, LinearProbe) and not probe.trapezoid_deg


def _face_mm(probe: Probe) -> float:
    if isinstance(probe, LinearProbe):
        return probe.width_mm
    if not isinstance(probe, ConvexProbe):
        return probe.aperture_mm
    return max(2.0 * probe.radius_mm * np.sin(np.deg2rad(0.5 * probe.field_of_view_deg)), probe.aperture_mm)


def _steering(probe: Probe) -> dict[str, float]:
    """Lines that leave a flat face obliquely: their depths count from a common surface behind it."""
    tilt = probe.steering_deg * np.pi / 180.0 if isinstance(probe, LinearProbe) else 0.0
    fan = isinstance(probe, LinearProbe) and probe.trapezoid_deg > 0.0
    first = _geometry(probe)[0]
    before = -first * np.abs(np.tan(tilt))  # of the middle line
    return {
        "depth_mm": probe.depth_mm + 2.0 * before,
        "steered": fan or tilt != 0.0,
        "flat_face": isinstance(probe, LinearProbe | PhasedProbe),
        "steering_sin": np.sin(tilt),
        "steering_cos": np.cos(tilt),
        "start_mm": before,
        "top_mm": 0.0 if fan or tilt else -1e6,
        "bottom_mm": probe.depth_mm * np.cos(tilt) if tilt else 1e6,
    }


def received_wavelength_mm(probe: Probe) -> float:
    """Of the echoes, at the speed of sound that arrays are designed for."""
    return 1e-3 * _DESIGN_SPEED_M_S / _received_mhz(probe)


def _cycles_per_mm(probe: Probe, settings: SimulationSettings) -> float:
    return 2.0 * _received_mhz(probe) / (1e-3 * settings.reference_speed_m_s)


def _one_way_sigma(probe: Probe, f_number: float) -> float:
    """At a focus: FWHM = 1.21 wavelength x f-number."""
    return 1.21 * received_wavelength_mm(probe) * f_number / _FWHM


def _receive_sigma(probe: Probe, f_number: float) -> float:
    """Of an aperture of the weights 1 - a / 2 + a / 2 cos(2 pi x): as much wider as its pattern at half its peak."""
    half = 0.5 * probe.receive_apodization

    def above_half(u: float) -> float:
        return (1.0 - half) * (np.sinc(u) - 0.5) + 0.5 * half * (np.sinc(u - 1.0) + np.sinc(u + 1.0))

    return _one_way_sigma(probe, f_number) * cast(float, optimize.brentq(above_half, 0.5, 1.1)) / _HALF_OF_SINC


def _rayleigh_mm(probe: Probe, sigma_mm: float) -> float:
    return 2.0 * np.pi * sigma_mm * sigma_mm / received_wavelength_mm(probe)


def _traced_lines(probe: Probe, settings: SimulationSettings) -> tuple[int, int]:
    """(traced lines per scan line, traced lines beyond either edge of the field)."""
    depth = np.linspace(0.0, probe.depth_mm, 65)
    lateral = _lateral_sigma(probe, depth)
    _, spacing, radius = _geometry(probe)
    apart = spacing * (np.ones_like(depth) if _is_parallel(probe) else radius + depth)
    count = settings.lateral_rays or int(np.clip(np.ceil((apart / lateral).max() / 1.5), 1, 128))
    below = depth >= 0.1 * probe.depth_mm  # near the apex of a phased array all lines are within the beam
    reach = np.ceil(settings.beam_cutoff * (lateral[below] / apart[below]).max() * count)
    return count, int(min(reach, 16 * count))
