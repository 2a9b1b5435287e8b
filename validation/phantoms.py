"""Digital phantoms with the theoretical prediction of their image.

A phantom is defined in the probe frame (mm: x lateral, y depth, z elevational, origin at the probe face; objects are
constant along z unless stated otherwise) and voxelised in patient space under any rotation. The rotation changes the
orientation of the object to the voxels, but must not change its image.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, TypeVar, cast

import numpy as np
from scipy.optimize import brentq

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.beam import FWHM_PER_SIGMA
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import Tissue
from validation.wave import mirrored_by_rod

REFERENCE_SPEED_M_S = 1540.0
#: Speckle in a medium with the reference speed of sound
BACKGROUND = Tissue("background", REFERENCE_SPEED_M_S, 1.6, 0.5, mu0=0.33, sigma0=0.15)
#: No scatterers, no attenuation
FLUID = Tissue("fluid", REFERENCE_SPEED_M_S, 1.6, 0.0)
#: Reflects nearly all energy and absorbs the rest, so that no comet-tail artefact covers the region behind
STEEL = Tissue("steel", REFERENCE_SPEED_M_S, 46.0, 30.0)


class _Box(NamedTuple):
    """The minimum extent of a phantom in the probe frame (mm)."""

    half_width: float = 18.0
    top: float = -4.0
    bottom: float = 54.0
    half_thickness: float = 6.0


@dataclass(frozen=True)
class Echo:
    """Prediction: an echo at this position of the image."""

    name: str
    #: (lateral, depth) in the probe frame, position of the echo in the image
    shown_mm: tuple[float, float]
    #: (lateral, depth) of the object that causes it
    object_mm: tuple[float, float]


@dataclass(frozen=True)
class EchoLevel(Echo):
    """Prediction: an echo at this position of the image, with its level."""

    #: In dB relative to the first echo of the phantom
    level_db: float


@dataclass(frozen=True)
class LevelChange:
    """Prediction: the difference of the mean level in this region from that with the `baseline` tissues."""

    name: str
    #: (left, right, top, bottom) in the probe frame
    region_mm: tuple[float, float, float, float]
    change_db: float


@dataclass(frozen=True)
class Level:
    """Prediction: the mean level in this region."""

    name: str
    #: (left, right, top, bottom) in the probe frame
    region_mm: tuple[float, float, float, float]
    #: In dB re tissue of unit scatterer variance without attenuation
    level_db: float


#: A prediction about a phantom's image
Expected = TypeVar("Expected", bound="Echo | LevelChange | Level", covariant=True)


@dataclass(frozen=True, eq=False)
class Phantom(Generic[Expected]):
    """A test object: labels, tissues, the probe's pose, and the predictions for its image."""

    name: str
    labels: Volume
    tissues: TissueTable
    #: (4, 4)
    probe_to_ras: np.ndarray
    #: Predictions for a given probe
    expected: Callable[[Probe], tuple[Expected, ...]]
    #: The same object without the effect it demonstrates, for comparison
    baseline: TissueTable | None = None
    #: Centre of a sphere
    centre_ras: tuple[float, float, float] | None = None


def reflection_coefficient(before: Tissue, behind: Tissue, cos_incidence: float | np.ndarray = 1.0) -> np.ndarray:
    """Pressure reflection coefficient r of an interface between two fluids; 1 beyond the critical angle.

    r = (Z2 cos i - Z1 cos t) / (Z2 cos i + Z1 cos t), sin t / c2 = sin i / c1 (docs/physics.md#3-rays).
    """
    cos_in = np.asarray(cos_incidence, float)
    sin_out = behind.speed_of_sound_m_s / before.speed_of_sound_m_s * np.sqrt(1.0 - cos_in**2)
    z_in = before.impedance_mrayl * np.sqrt(np.clip(1.0 - sin_out**2, 0.0, None))
    z_out = behind.impedance_mrayl * cos_in
    return np.where(sin_out >= 1.0, 1.0, (z_out - z_in) / (z_out + z_in))


# ---- the five phantoms of the paper's Fig. 2 ------------------------------------------------------------------------


def band_power(probe: Probe, loss_db) -> np.ndarray:
    """Power (...,) of a pulse after losses in dB at its centre frequency, which rise with frequency; 1 before.

    A sum over 800 positive frequencies of the Gaussian band that is received, each attenuated by itself.
    """
    sigma = probe.received_bandwidth / FWHM_PER_SIGMA  # relative to the centre
    lowest, highest = max(1.0 - 8.0 * sigma, 0.0), 1.0 + 4.0 * sigma
    frequency = lowest + (np.arange(800) + 0.5) / 800 * (highest - lowest)
    power = np.exp(-(((frequency - 1.0) / sigma) ** 2))
    return (power * 10.0 ** (-0.1 * np.asarray(loss_db)[..., None] * frequency)).sum(axis=-1) / power.sum()


def attenuating_block(
    attenuation_db_cm_mhz: float = 1.2, rotation: np.ndarray | None = None, *, thickness_mm: float = 12.0
) -> Phantom[LevelChange]:
    """Shadow, or enhancement if the attenuation is below that of the background: a block within speckle.

    Behind it the mean level changes by -2 (alpha_block - alpha_background) f d dB (docs/physics.md#3-rays), summed over
    the frequencies of the pulse.
    """
    block = replace(BACKGROUND, name="block", attenuation_db_cm_mhz=attenuation_db_cm_mhz)
    top = 14.0

    def label(x, y, z):
        return np.where((np.abs(x) < 8.0) & (y > top) & (y < top + thickness_mm), 2, 1)

    def expected(probe: Probe):
        near, far = top + thickness_mm + 6.0, top + thickness_mm + 22.0
        per_mm = 0.2 * probe.frequency_mhz  # dB both ways
        before = BACKGROUND.attenuation_db_cm_mhz * per_mm * np.linspace(near, far, 33)
        more = (attenuation_db_cm_mhz - BACKGROUND.attenuation_db_cm_mhz) * per_mm * thickness_mm
        change = 10 * np.log10(band_power(probe, before + more).mean() / band_power(probe, before).mean())
        return (LevelChange("behind the block", (-2.0, 2.0, near, far), float(change)),)

    tissues = TissueTable({0: BACKGROUND, 1: BACKGROUND, 2: block})
    return _phantom(
        "attenuating block", label, tissues, rotation, 0.5, expected, tissues.replace("block", **_acoustics(BACKGROUND))
    )


def speed_block(
    speed_m_s: float = 1450.0, rotation: np.ndarray | None = None, *, thickness_mm: float = 16.0
) -> Phantom[Echo]:
    """Range distortion: a wire behind a block of another speed of sound is displaced by d (c_ref / c - 1)."""
    block = replace(BACKGROUND, name="block", speed_of_sound_m_s=speed_m_s)
    top, wire, radius = 12.0, (0.0, 40.0), 0.8

    def label(x, y, z):
        labels = np.where((np.abs(x) < 10.0) & (y > top) & (y < top + thickness_mm), 2, 1)
        return np.where(_in_cylinder(x, y, wire, radius), 3, labels)

    def expected(probe: Probe):
        moved = thickness_mm * (REFERENCE_SPEED_M_S / speed_m_s - 1.0)
        front = wire[1] - radius
        return (Echo("wire", (0.0, front + moved), (0.0, front)),)

    tissues = TissueTable({0: BACKGROUND, 1: BACKGROUND, 2: block, 3: STEEL})
    return _phantom(
        "speed block", label, tissues, rotation, 0.25, expected, tissues.replace("block", **_acoustics(BACKGROUND))
    )


def mirror(rotation: np.ndarray | None = None, *, tilt_deg: float = 30.0) -> Phantom[Echo]:
    """Mirroring: a rod in front of an oblique strong reflector appears again behind it, at its mirror image."""
    tilt = np.radians(tilt_deg)
    point, normal = np.array([0.0, 30.0]), np.array([-np.sin(tilt), -np.cos(tilt)])  # towards the probe
    radius, away = 0.6, 9.0
    down = np.array([0.0, 1.0])
    rod = point + away * (down - 2.0 * (down @ normal) * normal)

    def label(x, y, z):
        labels = np.where((x - point[0]) * normal[0] + (y - point[1]) * normal[1] < 0.0, 2, 1)
        return np.where(_in_cylinder(x, y, rod, radius), 3, labels)

    def expected(probe: Probe):
        image = rod - 2.0 * ((rod - point) @ normal) * normal
        return (
            Echo("rod", tuple(rod - radius * _line_direction_at(probe, rod)), tuple(rod)),
            Echo("mirror image", tuple(image - radius * _line_direction_at(probe, image)), tuple(rod)),
        )

    plate = replace(STEEL, name="mirror")
    dim = replace(BACKGROUND, attenuation_db_cm_mhz=0.1, mu0=0.033, sigma0=0.015)
    return _phantom("mirror", label, TissueTable({0: dim, 1: dim, 2: plate, 3: STEEL}), rotation, 0.25, expected)


def refracting_wedge(
    rotation: np.ndarray | None = None, *, tilt_deg: float = 25.0, speeds_m_s: tuple[float, float] = (1450.0, 1620.0)
) -> Phantom[Echo]:
    """Refraction: wires behind an oblique interface are shown on the unrefracted scan line."""
    tilt, radius = np.radians(tilt_deg), 0.6
    point, normal = np.array([0.0, 20.0]), np.array([np.sin(tilt), -np.cos(tilt)])
    wires = [np.array(wire) for wire in ((-8.0, 36.0), (0.0, 40.0), (8.0, 44.0))]

    def label(x, y, z):
        labels = np.where((x - point[0]) * normal[0] + (y - point[1]) * normal[1] < 0.0, 2, 1)
        for wire in wires:
            labels = np.where(_in_cylinder(x, y, wire, radius), 3, labels)
        return labels

    def expected(probe: Probe):
        return tuple(
            Echo(f"wire {n}", _shown_behind_plane(probe, wire, radius, point, normal, speeds_m_s), tuple(wire))
            for n, wire in enumerate(wires, 1)
        )

    # The same impedance on both sides: the ray is refracted by the difference in speed alone.
    above, below = (
        replace(BACKGROUND, name=name, speed_of_sound_m_s=c, mu0=0.1, sigma0=0.045)
        for name, c in zip(("slow", "fast"), speeds_m_s, strict=True)
    )
    return _phantom("refracting wedge", label, TissueTable({1: above, 2: below, 3: STEEL}), rotation, 0.2, expected)


def parallel_plates(
    rotation: np.ndarray | None = None, *, gap_mm: float = 7.2, speed_m_s: float = 1600.0, spacing_mm: float = 0.2
) -> Phantom[EchoLevel]:
    """Reverberation between two plane interfaces: echoes d c_ref / c apart, the level changing by 20 log10(r1 r2)."""
    top = 15.0
    above, gap = FLUID, Tissue("gap", speed_m_s, 9.0, 0.0)
    below = replace(FLUID, name="below", impedance_mrayl=1.8)

    def label(x, y, z):
        return np.where(y < top, 1, np.where(y < top + gap_mm, 2, 3))

    def expected(probe: Probe):
        apart = gap_mm * REFERENCE_SPEED_M_S / speed_m_s
        fall = float(20.0 * np.log10(reflection_coefficient(gap, above) * reflection_coefficient(gap, below)))
        far = top + gap_mm
        return tuple(
            EchoLevel(f"bounce {n}" if n else "far side", (0.0, top + (n + 1) * apart), (0.0, far), n * fall)
            for n in range(3)
        )

    return _phantom(
        "parallel plates",
        label,
        TissueTable({0: above, 1: above, 2: gap, 3: below}),
        rotation,
        spacing_mm,
        expected,
        # Plates extend beyond the widest Gaussian that places them.
        box=_Box(half_width=20.0, half_thickness=max(6.0, 20.0 * spacing_mm)),
    )


def mirrored_power_behind(probe: Probe, radius_mm: float, top_mm: float, away_mm: float, *, is_sphere: bool) -> float:
    """Power of speckle that a ball, or a rod across the image, mirrors at a distance behind its surface, re none."""
    if radius_mm > 1e3:
        return 1.0
    depth = top_mm + away_mm
    lateral = (probe.aperture_mm, probe.focus_mm), (min(probe.aperture_mm, depth / probe.receive_f_number), depth)
    lens = (probe.elevation_aperture_mm, probe.elevation_focus_mm)
    around = [lateral, (lens, lens)][: 1 + is_sphere]
    return float(np.prod([mirrored_by_rod(radius_mm, top_mm, away_mm, of, probe.frequency_mhz) for of in around]))


def curved_mirror(
    rotation: np.ndarray | None = None, *, radius_mm: float = 12.0, is_sphere: bool = True
) -> Phantom[Level]:
    """A steel ball, or a rod across the image, that mirrors the surrounding speckle; the level falls with distance.

    The level follows from the exact waves at a rod, laterally and, for a ball, also elevationally.
    """
    top = 22.0
    plain = replace(BACKGROUND, attenuation_db_cm_mhz=0.0)

    def label(x, y, z):
        return np.where(x**2 + (y - top - radius_mm) ** 2 + is_sphere * z**2 < radius_mm**2, 2, 1)

    def expected(probe: Probe):
        reflectance = reflection_coefficient(plain, STEEL) ** 2
        direct = 10 * np.log10(plain.scatterer_variance)
        levels = []
        for away in (3.0, 6.0, 10.0):
            left = mirrored_power_behind(probe, radius_mm, top, away, is_sphere=is_sphere)
            region = (-1.5, 1.5, top + away - 1.0, top + away + 1.0)
            level = float(direct + 20 * np.log10(reflectance) + 10 * np.log10(left))
            levels.append(Level(f"{away:.0f} mm", region, level))
        return tuple(levels)

    tissues = TissueTable({0: plain, 1: plain, 2: STEEL})
    return _phantom("curved mirror", label, tissues, rotation, 0.4, expected)


# ---- soft tissue -----------------------------------------------------------------------------------------------------


def folds(rotation: np.ndarray | None = None, *, spacing_mm: float = 0.5) -> Phantom[LevelChange]:
    """Brain with sulci of 1.2 to 2 mm, nearly along the beam, down to 26 mm; `baseline` has one speed of sound."""
    brain = Tissue("brain", REFERENCE_SPEED_M_S, 1.607, 0.0, mu0=0.33, sigma0=0.15)
    fluid = Tissue("csf", 1504.5, 1.515, 0.0)
    # (lateral position at the top, inclination, half-width, place of the bend) in millimetres
    sulci = [
        (-23.0, 0.1, 0.9, 3.0), (-15.0, -0.18, 0.7, 11.0), (-8.0, 0.15, 1.0, 7.0), (-2.5, 0.02, 0.6, 0.0),
        (4.0, -0.12, 0.8, 5.0), (10.5, 0.2, 0.7, 9.0), (17.0, -0.05, 1.0, 2.0), (24.0, -0.2, 0.8, 6.0),
    ]  # fmt: skip

    def label(x, y, z):
        labels = np.ones(np.broadcast_shapes(x.shape, y.shape, z.shape), np.uint8)
        for start, inclination, half_width, bend in sulci:
            middle = start + inclination * y + 1.2 * np.sin((y - bend) / 5.0)
            labels[(np.abs(x - middle) < half_width) & (y > 2.0) & (y < 26.0 - 0.2 * bend)] = 2
        return labels

    tissues = TissueTable({0: brain, 1: brain, 2: fluid})
    baseline = tissues.replace("csf", speed_of_sound_m_s=REFERENCE_SPEED_M_S)
    return _phantom("folds", label, tissues, rotation, spacing_mm, lambda probe: (), baseline, _Box(half_width=32.0))


def speed_cyst(
    speed_m_s: float = 1440.0, rotation: np.ndarray | None = None, *, radius_mm: float = 4.0
) -> Phantom[LevelChange]:
    """An echo-free cylinder of another speed of sound at 20 mm, in speckle without attenuation."""
    plain = replace(BACKGROUND, attenuation_db_cm_mhz=0.0)
    fluid = replace(plain, name="cyst", speed_of_sound_m_s=speed_m_s, mu0=0.0, sigma0=0.0)
    tissues = TissueTable({0: plain, 1: plain, 2: fluid})
    baseline = tissues.replace("cyst", speed_of_sound_m_s=REFERENCE_SPEED_M_S)

    def label(x, y, z):
        return np.where(_in_cylinder(x, y, (0.0, 20.0), radius_mm), 2, 1)

    return _phantom("speed cyst", label, tissues, rotation, 0.5, lambda probe: (), baseline)


def behind_object(
    shape: str, tissue: Tissue, rotation: np.ndarray | None = None, *, background: Tissue = BACKGROUND
) -> Phantom[LevelChange]:
    """A "plate" (x > 0) or "strip" (3 mm) from 15 to 18 mm, a "ball" of 3 mm radius or a "rod" of 2 mm at 16 mm.

    The speckle has no attenuation around the object.
    """
    plain = replace(background, attenuation_db_cm_mhz=0.0)
    tissues = TissueTable({0: plain, 1: plain, 2: tissue})
    shapes = {
        "plate": lambda x, y, z: (y > 15.0) & (y < 18.0) & (x > 0.0),
        "strip": lambda x, y, z: (y > 15.0) & (y < 18.0) & (np.abs(x) < 1.5),
        "ball": lambda x, y, z: x**2 + (y - 16.0) ** 2 + z**2 < 9.0,
        "rod": lambda x, y, z: x**2 + (y - 16.0) ** 2 + 0.0 * z < 4.0,
    }
    require(shape in shapes, f"shape is {shape!r}, expected one of {', '.join(shapes)}")
    baseline = TissueTable(dict.fromkeys(tissues, plain))

    def label(x, y, z):
        return np.where(shapes[shape](x, y, z), 2, 1)

    spacing = 0.25 if shape == "rod" else 0.5
    return _phantom(f"behind a {shape}", label, tissues, rotation, spacing, lambda probe: (), baseline)


# ---- resolution and speckle -----------------------------------------------------------------------------------------


def wires_and_cysts(rotation: np.ndarray | None = None, *, spacing_mm: float = 0.2) -> Phantom[Echo | LevelChange]:
    """A quality-assurance phantom: wires every 10 mm of depth, black cysts, and blocks 6 dB above and below."""
    radius = 0.4
    # No wire is on a scan line through another wire or a cyst, for any kind of probe.
    wires = [(-2.0, 10.0), (2.0, 20.0), (-1.0, 30.0), (1.0, 40.0), (0.0, 50.0)]
    cysts = {2: [(-12.0, 20.0), (-12.0, 45.0)], 3: [(12.0, 20.0)], 4: [(12.0, 45.0)]}
    changes_db = {3: 6.0, 4: -6.0}
    plain = replace(BACKGROUND, attenuation_db_cm_mhz=0.0)
    tissues = {0: plain, 1: plain, 2: FLUID, 5: STEEL}
    for number, change in changes_db.items():
        factor = 10.0 ** (change / 20.0)
        name = f"{change:+.0f} dB"
        tissues[number] = replace(tissues[1], name=name, mu0=factor * BACKGROUND.mu0, sigma0=factor * BACKGROUND.sigma0)

    def label(x, y, z):
        labels = np.ones(np.broadcast_shapes(x.shape, y.shape, z.shape), np.uint8)
        for number, centres in cysts.items():
            for centre in centres:
                labels[_in_cylinder(x, y, centre, 4.0)] = number
        for wire in wires:
            labels[_in_cylinder(x, y, wire, radius)] = 5
        return labels

    def expected(probe: Probe):
        echoes = tuple(
            Echo(f"wire at {wire[1]:.0f} mm", tuple(wire - radius * _line_direction_at(probe, wire)), tuple(wire))
            for wire in map(np.array, wires)
        )
        levels = tuple(
            LevelChange(tissues[number].name, (x - 2.5, x + 2.5, y - 2.5, y + 2.5), change)
            for number, change in changes_db.items()
            for x, y in cysts[number]
        )
        return echoes + levels

    table = TissueTable(tissues)
    baseline = table
    for number in changes_db:
        baseline = baseline.replace(tissues[number].name, mu0=BACKGROUND.mu0, sigma0=BACKGROUND.sigma0)
    return _phantom("wires and cysts", label, table, rotation, spacing_mm, expected, baseline)


def round_cyst(rotation: np.ndarray | None = None, *, depth_mm: float = 40.0, radius_mm: float = 5.0) -> Phantom[Echo]:
    """A ball without scatterers in speckle, without attenuation; see clutter_power."""
    plain = replace(BACKGROUND, attenuation_db_cm_mhz=0.0)
    cyst = replace(plain, name="cyst", mu0=0.0, sigma0=0.0)

    def label(x, y, z):
        return np.where(x**2 + (y - depth_mm) ** 2 + z**2 < radius_mm**2, 2, 1)

    return _phantom("round cyst", label, TissueTable({0: plain, 1: plain, 2: cyst}), rotation, 0.5, lambda probe: ())


def clutter_power(probe: Probe, depth_mm: float, radius_mm: float, within_mm: float = 0.0) -> float:
    """Power received from outside a disc across the beam at a depth, relative to all power; without attenuation.

    It belongs to lines through the centre of the disc, or the mean of those within `within_mm` of it laterally.

    By diffraction (Goodman, Introduction to Fourier Optics, section 3.4): the sum of the waves of 512 points of each
    aperture, by their exact distances. The transmit aperture and the elements are focused once, the receive aperture at
    the depth, with its weights. The second harmonic is fed by the square of what is transmitted at half its frequency.
    To this comes the probe's clutter, which falls as 1 + cos(pi u / 48), u in wavelengths x f-number.
    """
    across = np.linspace(0.0, 60.0, 2401)
    unit = probe.wavelength_mm * max(probe.receive_f_number, depth_mm / probe.aperture_mm)
    receive = probe.wavelength_mm * depth_mm / unit
    order, pulse = (2, replace(probe, harmonic=False)) if probe.harmonic else (1, probe)
    lateral = _pressure(pulse, probe.aperture_mm, probe.focus_mm, across, depth_mm) ** order
    lateral *= _pressure(probe, receive, depth_mm, across, depth_mm, probe.receive_apodization)
    lens = probe.elevation_aperture_mm, probe.elevation_focus_mm, across, depth_mm
    elevational = _pressure(pulse, *lens) ** order * _pressure(probe, *lens)
    aside = np.linspace(-within_mm, within_mm, 41)[:, None] + across
    reach = np.sqrt(np.maximum(radius_mm**2 - aside**2, 0.0))
    seen = np.interp(reach, across, np.cumsum(elevational**2) - 0.5 * elevational**2).mean(axis=0)
    beyond = 1.0 - float((lateral**2 * seen).sum() / ((lateral**2).sum() * (elevational**2).sum()))
    clutter = 0.0 if probe.clutter_db is None else 10.0 ** (probe.clutter_db / 10.0)
    part = min(radius_mm / (48.0 * unit), 1.0)
    return (beyond + clutter * (1.0 - part - np.sin(np.pi * part) / np.pi)) / (1.0 + clutter)


def _pressure(
    probe: Probe, aperture: float, focus: float, across: np.ndarray, depth: float, apodization: float = 0.0
) -> np.ndarray:
    """(across,) amplitude of an aperture's field at distances from the axis, of cylindrical waves."""
    point = ((np.arange(512) + 0.5) / 512 - 0.5) * aperture
    weight = 1.0 - apodization + apodization * np.cos(np.pi * point / aperture) ** 2
    distance = np.hypot(across[:, None] - point, depth)
    phase = 2.0 * np.pi / probe.wavelength_mm * (distance - np.hypot(point, focus))
    return np.abs((np.exp(1j * phase) * depth * distance**-1.5) @ weight)


def uniform_speckle(tissue: Tissue = BACKGROUND, rotation: np.ndarray | None = None) -> Phantom[Level]:
    """A single tissue: the level is Var of its scatterers, the envelope is Rayleigh, the PSF sets correlations."""

    def expected(probe: Probe):
        if tissue.attenuation_db_cm_mhz > 0.0:
            return ()  # the level falls with depth
        region = (-0.2 * probe.depth_mm, 0.2 * probe.depth_mm, 0.2 * probe.depth_mm, 0.9 * probe.depth_mm)
        return (Level("speckle", region, 10 * np.log10(tissue.scatterer_variance)),)

    tissues = TissueTable({0: tissue, 1: tissue})
    return _phantom("uniform speckle", lambda x, y, z: np.ones_like(x + y + z), tissues, rotation, 1.0, expected)


def thin_rod(rotation: np.ndarray | None = None, *, depth_mm: float = 30.0, width_mm: float = 1.2) -> Phantom[Echo]:
    """A thin echogenic bar of square cross-section along the lateral axis, in a fluid, to measure slice thickness."""

    def label(x, y, z):
        return np.where((np.abs(y - depth_mm) < 0.5 * width_mm) & (np.abs(z) < 0.5 * width_mm), 1, 0)

    bar = replace(FLUID, name="bar", mu0=2.0, sigma0=1.0)
    tissues = TissueTable({0: FLUID, 1: bar})
    place = (0.0, depth_mm)
    return _phantom(
        "thin rod", label, tissues, rotation, 0.3, lambda probe: (Echo("bar", place, place),), box=_Box(half_width=12.0)
    )


def layered(
    tissues: Sequence[Tissue],
    borders_mm: Sequence[float],
    rotation: np.ndarray | None = None,
    *,
    tilt_deg: float = 0.0,
    spacing_mm: float = 0.5,
    half_width_mm: float = 50.0,
    half_thickness_mm: float = _Box().half_thickness,
) -> Phantom[Echo]:
    """Plane layers of labels 1, 2, ... with interfaces at the given depths on the axis, tilted about z."""
    require(
        len(tissues) == len(borders_mm) + 1,
        f"there are {len(borders_mm)} borders, expected {len(tissues) - 1} between {len(tissues)} tissues",
    )
    tilt = np.radians(tilt_deg)

    def label(x, y, z):
        along = np.sin(tilt) * x + np.cos(tilt) * y
        return sum((along > np.cos(tilt) * border for border in borders_mm), np.ones(along.shape, np.uint8))

    def expected(probe: Probe):
        if tilt_deg != 0.0:
            return ()  # lines do not meet the layers at right angles
        thickness = np.diff([0.0, *borders_mm])
        speeds = [tissue.speed_of_sound_m_s for tissue in tissues[:-1]]
        shown = np.cumsum(thickness * REFERENCE_SPEED_M_S / speeds)
        return tuple(
            Echo(f"border {n}", (0.0, float(depth)), (0.0, border))
            for n, (depth, border) in enumerate(zip(shown, borders_mm, strict=True), 1)
        )

    table = TissueTable(dict(enumerate(tissues, 1)))
    # In a fast layer the field extends beyond its nominal depth.
    box = _Box(half_width=half_width_mm, bottom=60.0, half_thickness=half_thickness_mm)
    return _phantom("layers", label, table, rotation, spacing_mm, expected, box=box)


def small_sheet(rotation: np.ndarray | None = None, *, depth_mm: float = 20.0, half_mm: float = 2.0) -> Phantom[Echo]:
    """A square plate that faces the probe, so small that the beam hardly changes over it; voxels of 0.1 mm."""

    def label(x, y, z):
        return np.where((y > depth_mm) & (y < depth_mm + 1.5) & (np.abs(x) < half_mm) & (np.abs(z) < half_mm), 1, 0)

    tissues = TissueTable({0: FLUID, 1: replace(FLUID, name="sheet", impedance_mrayl=1.8)})
    box = _Box(half_mm + 2.0, depth_mm - 2.0, depth_mm + 4.0, half_mm + 6.0)
    return _phantom("small sheet", label, tissues, rotation, 0.1, _facing(depth_mm), box=box)


# ---- voxels ---------------------------------------------------------------------------------------------------------


def voxel_sphere(
    rotation: np.ndarray | None = None,
    *,
    radius_mm: float = 20.0,
    spacing_mm: float = 1.0,
    centre_mm=(0.31, 0.17, -0.42),
) -> Phantom[Echo]:
    """A sphere on coarse voxels, with its centre off the voxel centres (docs/physics.md#2-interfaces).

    `centre_mm` is in RAS; the probe face is 29 mm in front of it.
    """
    centre = np.asarray(centre_mm, float)
    half = int(np.ceil((radius_mm + 10.0) / spacing_mm))
    axis = spacing_mm * np.arange(-half, half + 1)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    inside = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2 < radius_mm**2
    matrix = np.diag([spacing_mm] * 3 + [1.0])
    matrix[:3, 3] = axis[0]
    pose = _pose(rotation)
    pose[:3, 3] = -(radius_mm + 9.0) * pose[:3, 1]
    # A different impedance makes it an interface; a different speed of sound would refract the rays.
    tissues = TissueTable({0: FLUID, 1: replace(FLUID, name="sphere", impedance_mrayl=2.0)})
    x0, y0, z0 = pose[:3, :3].T @ (centre - pose[:3, 3])  # in the probe frame

    def expected(probe: Probe):
        # The image plane cuts the sphere off its centre; the line to the centre of the cut meets it at right angles.
        front = np.array([x0, y0]) - np.sqrt(radius_mm**2 - z0**2) * _line_direction_at(probe, (x0, y0))
        return (Echo("front", tuple(front), tuple(front)),)

    volume = Volume(inside.astype(np.uint8), matrix)
    return Phantom("voxel sphere", volume, tissues, pose, expected, centre_ras=tuple(centre))


def voxel_sheet(
    rotation: np.ndarray | None = None, *, depth_mm: float = 20.5, spacing_mm: float = 1.0
) -> Phantom[Echo]:
    """A sheet one voxel thick across the beam (falx, dura); if oblique, its voxels are connected at least by edges."""
    thickness = spacing_mm if rotation is None or np.allclose(np.abs(rotation).max(axis=0), 1.0) else 1.5 * spacing_mm

    def label(x, y, z):
        return np.where(np.abs(y - depth_mm) < 0.5 * thickness, 1, 0)

    tissues = TissueTable({0: FLUID, 1: replace(FLUID, name="sheet", impedance_mrayl=1.9)})
    return _phantom(
        "voxel sheet",
        label,
        tissues,
        rotation,
        spacing_mm,
        _facing(depth_mm - 0.5 * thickness),
        box=_Box(half_width=50.0),
    )


def thin_slab(thickness_mm: float, rotation: np.ndarray | None = None, *, depth_mm: float = 15.0) -> Phantom[Echo]:
    """A slab across the beam, thinner than a pulse, in voxels of 0.05 mm; 6 mm wide, more than a narrow beam."""

    def label(x, y, z):
        return np.where((y > depth_mm) & (y < depth_mm + thickness_mm), 1, 0)

    tissues = TissueTable({0: FLUID, 1: replace(FLUID, name="slab", impedance_mrayl=1.9)})
    box = _Box(3.0, depth_mm - 1.0, depth_mm + 1.0 + thickness_mm, 3.0)
    return _phantom("thin slab", label, tissues, rotation, 0.05, _facing(depth_mm), box=box)


def rough_plane(
    heights_mm: np.ndarray,
    step_mm: float,
    tissues: Sequence[Tissue],
    rotation: np.ndarray | None = None,
    *,
    depth_mm: float = 25.0,
    spacing_mm: float = 0.05,
) -> Phantom[Echo]:
    """Two tissues, labels 1 and 2, whose border is a plane across the beam with heights that vary laterally.

    Parameters
    ----------
    heights_mm : (n,) deviation from the plane, away from the probe, at lateral positions `step_mm` apart about the axis
    tissues : before and behind it
    rotation : (3, 3), of the probe to the voxels
    """
    at = step_mm * (np.arange(len(heights_mm)) - 0.5 * (len(heights_mm) - 1))

    def label(x, y, z):
        return np.where(y > depth_mm + np.interp(x, at, heights_mm), 2, 1).astype(np.uint8)

    # Beyond the volume is the tissue before the plane: its bottom, another border, is well behind the echo.
    table = TissueTable({0: tissues[0], **dict(enumerate(tissues, 1))})
    box = _Box(7.0, depth_mm - 1.5, depth_mm + 4.0, 3.0)
    return _phantom("rough plane", label, table, rotation, spacing_mm, _facing(depth_mm), box=box)


def curved_wall(
    shape: str,
    radius_mm: float,
    rotation: np.ndarray | None = None,
    *,
    depth_mm: float = 25.0,
    spacing_mm: float = 0.5,
) -> Phantom[Echo]:
    """A "ball", "rod across the image" (along z) or "rod in the image" (along x) whose front is on the probe's axis.

    Its impedance differs from that of the fluid around it, not its speed of sound.
    """
    shapes = {"ball": (1.0, 1.0), "rod across the image": (1.0, 0.0), "rod in the image": (0.0, 1.0)}
    require(shape in shapes, f"shape is {shape!r}, expected one of {', '.join(shapes)}")
    along_x, along_z = shapes[shape]

    def label(x, y, z):
        return np.where(along_x * x**2 + (y - depth_mm - radius_mm) ** 2 + along_z * z**2 < radius_mm**2, 1, 0)

    inside = replace(FLUID, name="inside", impedance_mrayl=1.9)
    beyond = 8.0 * spacing_mm
    # A rod is longer than the smoothing of its border is wide.
    half_x, half_z = (radius_mm + beyond if bent else 18.0 * spacing_mm for bent in (along_x, along_z))
    box = _Box(half_x, depth_mm - beyond, depth_mm + 2.0 * radius_mm + beyond, half_z)
    return _phantom(shape, label, TissueTable({0: FLUID, 1: inside}), rotation, spacing_mm, _facing(depth_mm), box=box)


def _facing(depth_mm: float) -> Callable[[Probe], tuple[Echo, ...]]:
    """The prediction for a face perpendicular to the axis."""
    return lambda probe: (Echo("face", (0.0, depth_mm), (0.0, depth_mm)),)


def _phantom(
    name: str,
    label: Callable[..., np.ndarray],
    tissues: TissueTable,
    rotation: np.ndarray | None,
    spacing_mm: float,
    expected: Callable[[Probe], tuple[Expected, ...]],
    baseline: TissueTable | None = None,
    box: _Box | None = None,
) -> Phantom[Expected]:
    pose = _pose(rotation)
    labels = _voxelise(label, pose[:3, :3], spacing_mm, box or _Box())
    return Phantom(name, labels, tissues, pose, expected, baseline)


def _pose(rotation: np.ndarray | None) -> np.ndarray:
    pose = np.eye(4)
    if rotation is not None:
        require(np.shape(rotation) == (3, 3), f"rotation has shape {np.shape(rotation)}, expected (3, 3)")
        pose[:3, :3] = rotation
    return check_rigid("rotation", pose)


def _voxelise(label, rotation: np.ndarray, spacing_mm: float, box: _Box) -> Volume:
    """Labels on a grid along RAS. Voxel centres are at odd multiples of half the spacing, so that a plane at a multiple
    of the spacing is half-way between two layers: borders of aligned objects are exact."""
    sides = (-box.half_width, box.half_width), (box.top, box.bottom), (-box.half_thickness, box.half_thickness)
    corners = np.array(list(itertools.product(*sides))) @ rotation.T
    low = np.floor(corners.min(axis=0) / spacing_mm).astype(int)
    high = np.ceil(corners.max(axis=0) / spacing_mm).astype(int)
    x, y, z = (spacing_mm * (np.arange(a, b) + 0.5) for a, b in zip(low, high, strict=True))
    array = np.empty((len(z), len(y), len(x)), np.uint8)
    yx = np.stack(np.meshgrid(y, x, indexing="ij"))
    for k, depth in enumerate(z):  # slice by slice, since volumes of coordinates would need too much memory
        points = [rotation[0, a] * yx[1] + rotation[1, a] * yx[0] + rotation[2, a] * depth for a in range(3)]
        array[k] = label(*points)
    matrix = np.diag([spacing_mm] * 3 + [1.0])
    matrix[:3, 3] = spacing_mm * (low + 0.5)
    return Volume(array, matrix)


def _acoustics(tissue: Tissue) -> dict[str, float]:
    return {name: getattr(tissue, name) for name in ("speed_of_sound_m_s", "impedance_mrayl", "attenuation_db_cm_mhz")}


def _in_cylinder(x, y, centre, radius: float):
    """Inside the cylinder along z."""
    return (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2


# ---- geometrical acoustics in the image plane, independent of the kernels -------------------------------------------


def _line_at(probe: Probe, position) -> tuple[np.ndarray, np.ndarray]:
    """(origin, direction), both (lateral, depth), of the scan line at `position`."""
    origin, direction = probe.line_at(position)
    return origin[:2], direction[:2]


def _line_direction_at(probe: Probe, point) -> np.ndarray:
    """Direction of the scan line through a point (lateral, depth)."""
    return _line_at(probe, probe.line_through(*point)[0])[1]


def _shown_behind_plane(probe, target, radius, point, normal, speeds_m_s) -> tuple[float, float]:
    """Position in the image of a cylinder behind a plane interface: on the line whose refracted ray meets its axis.

    Snell's law in vector form; `normal` points towards the probe, `speeds_m_s` are in front of and behind the plane.
    """

    def bent(position: float):
        origin, direction = _line_at(probe, position)
        before = ((point - origin) @ normal) / (direction @ normal)
        ratio, cos_in = speeds_m_s[1] / speeds_m_s[0], -(direction @ normal)
        cos_out = np.sqrt(1.0 - ratio**2 * (1.0 - cos_in**2))
        return before, origin + before * direction, ratio * direction + (ratio * cos_in - cos_out) * normal

    def miss(position: float) -> float:
        _, crossing, direction = bent(position)
        to_target = target - crossing
        return direction[0] * to_target[1] - direction[1] * to_target[0]

    end = 0.9 * abs(probe.first_line)
    position = cast(float, brentq(miss, -end, end))  # its return type depends on its arguments
    before, crossing, _ = bent(position)
    behind = np.linalg.norm(target - crossing) - radius
    depth = REFERENCE_SPEED_M_S * (before / speeds_m_s[0] + behind / speeds_m_s[1])
    origin, direction = _line_at(probe, position)
    shown = origin + depth * direction
    return float(shown[0]), float(shown[1])
