"""The acquisition record of one frame, computed from the equations of docs/physics.md and the user's inputs.

Of a probe only its fields are read, no derived values of Probe. The record has the type layout.ACQUISITION, from which
it takes names and number formats, but no values.
"""

from __future__ import annotations

import numpy as np
from scipy import optimize, special

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.opencl.layout import ACQUISITION, CONSTANTS
from SlicerUSSim.Logic.probe.arrays import ConvexProbe, LinearProbe, PhasedProbe, Probe
from SlicerUSSim.Logic.verification.numpy_model.elementary import hash_mix
from SlicerUSSim.Logic.verification.numpy_model.medium import HostMedium

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
    samples = int(np.ceil(probe.depth_mm / sample_mm(probe, settings)))
    membrane = medium.tissues.membrane
    transmit = _one_way_sigma(probe, max(probe.focus_mm / probe.aperture_mm, 0.5))
    elevational = _one_way_sigma(probe, max(probe.elevation_focus_mm / probe.elevation_aperture_mm, 0.5))
    density = settings.scatterers_per_mm3 or _automatic_density(probe)
    values = {
        "ras_to_voxel": medium.ras_to_voxel.ravel(),
        "dims": medium.dims,
        "voxel_mm": medium.voxel_mm,
        "smooth_groups": medium.smooth_groups,
        "membrane_reach": medium.membrane_reach,
        "membrane_gain": np.exp(membrane.diffuse_db * np.log(10.0) / 20.0) if membrane else 0.0,
        "membrane_exponent": membrane.diffuse_exponent if membrane else 0.0,
        "membrane_phase": 2.0 * np.pi * _cycles_per_mm(probe, settings) * membrane.roughness_mm if membrane else 0.0,
        "probe_to_ras": np.asarray(probe_to_ras, float)[:3].ravel(),
        "linear": isinstance(probe, LinearProbe),
        "apex_radius_mm": radius,
        "first_line": first,
        "line_spacing": spacing,
        "scan_lines": probe.scan_lines,
        "depth_mm": probe.depth_mm,
        "frequency_mhz": probe.frequency_mhz,
        "fractional_bandwidth": probe.fractional_bandwidth,
        "reference_speed_m_s": settings.reference_speed_m_s,
        "cycles_per_mm": _cycles_per_mm(probe, settings),
        "sample_mm": sample_mm(probe, settings),
        "samples": int(np.ceil(samples / CONSTANTS["BLOCK"])) * CONSTANTS["BLOCK"],
        "transmit_sigma": transmit,
        "transmit_focus": probe.focus_mm,
        "transmit_rayleigh": _rayleigh_mm(probe, transmit),
        "receive_sigma_min": _receive_sigma(probe, probe.receive_f_number),
        "receive_sigma_slope": _receive_sigma(probe, 1.0 / probe.aperture_mm),
        "elevation_sigma": elevational / np.sqrt(2.0),
        "elevation_focus": probe.elevation_focus_mm,
        "elevation_rayleigh": _rayleigh_mm(probe, elevational),
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
        "downshift": (probe.fractional_bandwidth / _FWHM) ** 2 if settings.frequency_downshift else 0.0,
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


def _automatic_density(probe: Probe) -> float:
    """Eight scatterers in the smallest resolution cell, at least 4 per mm^3 and no more than in the paper's lattice."""
    depth = np.linspace(0.0, probe.depth_mm, 257)

    def beam(focus: float, aperture: float) -> np.ndarray:
        sigma = _one_way_sigma(probe, max(focus / aperture, 0.5))
        return sigma * np.hypot(1.0, (depth - focus) / _rayleigh_mm(probe, sigma))

    transmit = beam(probe.focus_mm, probe.aperture_mm)
    receive = _receive_sigma(probe, 1.0) * np.maximum(probe.receive_f_number, depth / probe.aperture_mm)
    across = beam(probe.elevation_focus_mm, probe.elevation_aperture_mm) / np.sqrt(2.0)
    axial = 1e-3 * _DESIGN_SPEED_M_S * _FWHM / (4.0 * np.pi * probe.fractional_bandwidth * probe.frequency_mhz)
    cell = (2.0 * np.pi) ** 1.5 * axial * across / np.sqrt(transmit**-2.0 + receive**-2.0)
    return min(max(8.0 / float(cell.min()), 4.0), 125_000.0)


def axial_sigma_mm(probe: Probe, settings: SimulationSettings) -> float:
    """Standard deviation of the pulse in depth: c / (4 pi sf), sf = bandwidth f0 / 2.355."""
    sigma_mhz = probe.fractional_bandwidth * probe.frequency_mhz / _FWHM
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
        return np.column_stack([at, 0 * at, 0 * at, 0 * at + 1.0]).astype(np.float32)
    towards = np.column_stack([np.sin(at), np.cos(at)])
    start = float(acquisition["apex_radius_mm"]) * (towards - [0.0, 1.0])  # the apex lies a radius above the face
    return np.column_stack([start, towards]).astype(np.float32)


def elevational_quantiles(traced: int, rays: int) -> np.ndarray:
    """(traced, rays) float32 positions of the rays in the elevational beam, in its standard deviations."""
    line, ray = np.arange(traced)[:, None], np.arange(rays)
    place_in_stratum = 0.05 + 0.9 * ((0.5 + line * _GOLDEN) % 1.0)
    return special.ndtri((ray + place_in_stratum) / rays).astype(np.float32)


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
        length += 2.0 * edge * (radius if isinstance(probe, ConvexProbe) else 1.0)
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
        whole, radius = probe.width_mm, 0.0
    else:
        if not isinstance(probe, ConvexProbe | PhasedProbe):
            name = type(probe).__name__
            raise SimulationError(f"the numpy model has no {name}, expected LinearProbe, ConvexProbe or PhasedProbe")
        whole = probe.field_of_view_deg * np.pi / 180.0
        radius = probe.radius_mm if isinstance(probe, ConvexProbe) else 0.0
    return -0.5 * whole, whole / (probe.scan_lines - 1), radius


def _wavelength_mm(probe: Probe) -> float:
    return 1e-3 * _DESIGN_SPEED_M_S / probe.frequency_mhz


def _cycles_per_mm(probe: Probe, settings: SimulationSettings) -> float:
    return 2.0 * probe.frequency_mhz / (1e-3 * settings.reference_speed_m_s)


def _one_way_sigma(probe: Probe, f_number: float) -> float:
    """At a focus: FWHM = 1.21 wavelength x f-number."""
    return 1.21 * _wavelength_mm(probe) * f_number / _FWHM


def _receive_sigma(probe: Probe, f_number: float) -> float:
    """Of an aperture of the weights 1 - a / 2 + a / 2 cos(2 pi x): as much wider as its pattern at half its peak."""
    half = 0.5 * probe.receive_apodization

    def above_half(u: float) -> float:
        return (1.0 - half) * (np.sinc(u) - 0.5) + 0.5 * half * (np.sinc(u - 1.0) + np.sinc(u + 1.0))

    return (
        _one_way_sigma(probe, f_number)
        * float(optimize.root_scalar(above_half, bracket=(0.5, 1.1)).root)
        / _HALF_OF_SINC
    )


def _rayleigh_mm(probe: Probe, sigma_mm: float) -> float:
    return 2.0 * np.pi * sigma_mm * sigma_mm / _wavelength_mm(probe)


def _traced_lines(probe: Probe, settings: SimulationSettings) -> tuple[int, int]:
    """(traced lines per scan line, traced lines beyond either edge of the field)."""
    depth = np.linspace(0.0, probe.depth_mm, 65)
    waist = _one_way_sigma(probe, max(probe.focus_mm / probe.aperture_mm, 0.5))
    transmit = waist * np.hypot(1.0, (depth - probe.focus_mm) / _rayleigh_mm(probe, waist))
    receive = _receive_sigma(probe, 1.0) * np.maximum(probe.receive_f_number, depth / probe.aperture_mm)
    lateral = (transmit**-2.0 + receive**-2.0) ** -0.5
    _, spacing, radius = _geometry(probe)
    apart = spacing * (np.ones_like(depth) if isinstance(probe, LinearProbe) else radius + depth)
    count = settings.lateral_rays or int(np.clip(np.ceil((apart / lateral).max() / 1.5), 1, 128))
    below = depth >= 0.1 * probe.depth_mm  # near the apex of a phased array all lines are within the beam
    reach = np.ceil(settings.beam_cutoff * (lateral[below] / apart[below]).max() * count)
    return count, int(min(reach, 16 * count))
