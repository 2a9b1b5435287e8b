"""Probes: origins and directions of the scan lines, and widths of the beam.

Probe frame (millimetres): origin at the centre of the probe face, +x lateral (left to right in the image), +y depth,
+z elevational. A scan line is a polar line around the apex of a curved array, or a parallel line of a linear one.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from SlicerUSSim.Logic.base.declaration import (
    Parameter,
    Shown,
    built,
    kind_of,
    parameter,
    parameter_of,
    parameters_of,
    short,
)
from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.probe.beam import TRANSMIT_OF, Beam

if TYPE_CHECKING:
    from typing_extensions import Self

#: With less the apex is so far behind the face that depths from it are not exact in single precision
_LEAST_TRAPEZOID_DEG = 1.0
#: {name in a preset: class} of all kinds of probe
PROBE_KINDS: dict[str, type[Probe]] = {}


@dataclass(frozen=True, kw_only=True)
class Probe(Beam):
    """What all probes share. Use LinearProbe, ConvexProbe or PhasedProbe.

    The two-way beam (amplitude, docs/physics.md#4-beam-and-pulse) is Gaussian across its axis. Laterally it is the
    product of a transmit beam, by default focused once at `focus_mm`, and a receive beam that is focused at every
    depth, with an aperture that grows at constant f-number until it is fully open; elevationally the lens focuses both
    ways at one depth.
    Each one-way beam has the width of a uniform aperture at its focus: FWHM = 1.21 x wavelength x f-number. With
    `receive_apodization` the receive beam is wider, as much as the main lobe of its aperture (beam.widening).

    >>> from dataclasses import replace
    >>> from SlicerUSSim.Logic.probe import PROBES
    >>> " ".join(PROBES)
    'phased convex linear microconvex abdominal cardiac transcranial neonatal linear_15 burr_hole hockey_stick matrix'
    >>> replace(PROBES["convex"], frequency_mhz=3.5).depth_mm
    100.0
    """

    scan_lines: int = parameter(
        192, "Scan lines", "Number of scan lines in an image", bounds=(2, 4096), shown=Shown(16, 512)
    )
    ring_down_mm: float = parameter(
        1.5, "Ring-down", "Depth in which reverberation between face and skin falls by 40 dB; 0: none", unit="mm",
        bounds=(0, 10),
    )  # fmt: skip
    ring_down_db: float = parameter(
        0.0, "Ring-down level", "Level of this reverberation at the face", unit="dB",
        bounds=(-100, 100),
    )  # fmt: skip
    face_reflection: float = parameter(
        0.25, "Face reflection",
        "Amplitude reflected at the face: bone and gas appear again at twice their depth; 0: none",
        bounds=(0, 1),
    )  # fmt: skip

    #: Name of the kind in a preset, and a description for tool tips
    kind: ClassVar[str]
    geometry: ClassVar[str]

    def __post_init__(self) -> None:
        # A field of each kind, so that it can be given by position after the kind's own fields.
        self.depth_mm: float
        super().__post_init__()
        for name in ("focus_mm", "elevation_focus_mm"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, self.default_focus_mm(self.depth_mm))
        self._check_band()
        self._check_transmission()

    def __new__(cls, *_: Any, **values: Any) -> Self:
        """Raises SimulationError that lists the parameters of this kind if `values` has another one."""
        known = [entry.name for entry in fields(cls)]
        for name in values:
            require(
                name in known,
                f"{cls.__name__} has no {name}, expected one of {', '.join(known)}",
            )
        return super().__new__(cls)

    def _check_band(self) -> None:
        if self.band_mhz is None:
            return
        low, high = self.band_mhz
        name = type(self).__name__
        require(low < high, f"{name}: band_mhz is {low:g} to {high:g}, expected the lower frequency first")
        require(
            not self.harmonic or low <= self.received_mhz <= high,
            f"{name}: the second harmonic of frequency_mhz {self.frequency_mhz:g} is {self.received_mhz:g} MHz, "
            f"expected within band_mhz, {low:g} to {high:g}; set frequency_mhz to between {0.5 * low:g} and "
            f"{0.5 * high:g}",
        )

    def _check_transmission(self) -> None:
        """Raise SimulationError for a parameter of one kind of transmission, set for another."""
        for name, kind in TRANSMIT_OF.items():
            value, entry = getattr(self, name), parameter_of(type(self), name)
            require(
                self.transmit == kind or value == entry.default,
                f"{type(self).__name__}: {name} is {value:g} with transmit {self.transmit!r}, expected transmit "
                f"{kind!r}, or {entry.default:g}, the default",
            )

    def __init_subclass__(cls) -> None:
        kind = cls.__dict__.get("kind")
        if kind in PROBE_KINDS:
            raise TypeError(f"{cls.__name__}: kind is {kind!r}, which is {PROBE_KINDS[kind].__name__} already")
        if kind is not None:  # otherwise a variant of its base, which presets do not distinguish
            PROBE_KINDS[kind] = cls

    @staticmethod
    def default_focus_mm(depth_mm: float) -> float:
        """Default depth of a focus."""
        return 0.6 * depth_mm

    # ---- geometry, defined by each kind ------------------------------------------------------------------------

    @property
    def apex_radius_mm(self) -> float:
        """Distance from the apex to the face; 0 for a phased array, inf for a linear one."""
        raise NotImplementedError

    @property
    def line_spacing(self) -> float:
        """Step between scan lines: radians around the apex, or millimetres along a linear face."""
        raise NotImplementedError

    @property
    def first_line(self) -> float:
        """Position of scan line 0, in the unit of line_spacing."""
        return -0.5 * self.line_spacing * (self.scan_lines - 1)

    @property
    def is_linear(self) -> bool:
        """True where scan lines are parallel."""
        return bool(np.isinf(self.apex_radius_mm))

    @property
    def has_flat_face(self) -> bool:
        """True where scan lines start on a plane, or at one point."""
        return self.is_linear or self.apex_radius_mm == 0.0

    @property
    def steering_rad(self) -> float:
        """Angle of parallel scan lines to the normal of the face."""
        return 0.0

    def line_levels(self) -> np.ndarray | None:
        """(scan_lines,) float32 factor of every line's echoes by steered_level; None where no line is steered."""
        return _levels_of(self)

    def line_starts_mm(self, position) -> np.ndarray:
        """Distance from line_at's origin to where lines at these positions leave the face.

        Signals along lines begin at that origin. It is behind a flat face with steered lines: on a surface that all
        lines leave at right angles.
        """
        return np.zeros_like(np.asarray(position, float))

    @property
    def displayed_mm(self) -> float:
        """Largest distance from line_at's origin within the imaged field."""
        return self.depth_mm

    @property
    def face_mm(self) -> float:
        """Lateral size of the array: of a phased array its aperture, otherwise that between the outermost lines."""
        return max(float(np.ptp(self.origins_mm()[:, 0])), self.aperture_mm)

    def face_points_mm(self, lateral_mm) -> np.ndarray:
        """(..., 3) points of the face in the probe frame at these lateral places, in the middle of its height."""
        x = np.asarray(lateral_mm, float)
        radius = self.apex_radius_mm
        y = 0.0 * x if self.has_flat_face else np.sqrt(np.maximum(radius**2 - x**2, 0.0)) - radius
        return np.stack([x, y, 0.0 * x], axis=-1)

    def line_positions(self) -> np.ndarray:
        """(scan_lines,) position of every line: radians around the apex, or millimetres along a linear face."""
        return self.first_line + self.line_spacing * np.arange(self.scan_lines)

    def line_at(self, position) -> tuple[np.ndarray, np.ndarray]:
        """((..., 3) origin in mm, (..., 3) unit direction) in the probe frame of the lines at these positions."""
        position = np.asarray(position, float)
        zero = np.zeros_like(position)
        if self.is_linear:
            sine, cosine = np.sin(self.steering_rad), np.cos(self.steering_rad)
            direction = np.stack([zero + sine, zero + cosine, zero], axis=-1)
            face = np.stack([position / cosine, zero, zero], axis=-1)
            return face - self.line_starts_mm(position)[..., None] * direction, direction
        sine, cosine, radius = np.sin(position), np.cos(position), self.apex_radius_mm
        return (
            np.stack([radius * sine, radius * (cosine - 1.0), zero], axis=-1),
            np.stack([sine, cosine, zero], axis=-1),
        )

    def origins_mm(self) -> np.ndarray:
        """(scan_lines, 3) starting points of signals in the probe frame: on the face, unless lines are steered."""
        return self.line_at(self.line_positions())[0]

    def directions(self) -> np.ndarray:
        """(scan_lines, 3) unit vectors along the scan lines in the probe frame."""
        return self.line_at(self.line_positions())[1]

    def line_through(self, lateral_mm, depth_mm) -> tuple[np.ndarray, np.ndarray]:
        """(position of the line, millimetres along it) of points of the image plane; the inverse of line_at."""
        x, y = np.asarray(lateral_mm, float), np.asarray(depth_mm, float)
        if self.is_linear:
            sine, cosine = np.sin(self.steering_rad), np.cos(self.steering_rad)
            across, before = x * cosine - y * sine, self.line_starts_mm(0.0)
            return across, x * sine + y * cosine + before
        from_apex = y + self.apex_radius_mm
        return np.arctan2(x, from_apex), np.hypot(x, from_apex) - self.apex_radius_mm

    def line_distance_mm(self, along_mm) -> np.ndarray:
        """Distance between neighbouring scan lines, `along_mm` from the face."""
        along = np.asarray(along_mm, float)
        return self.line_spacing * (np.ones_like(along) if self.is_linear else along + self.apex_radius_mm)

    def smallest_cell_mm3(self) -> float:
        """Volume of the smallest resolution cell within the image depth: (2 pi)^1.5 times the product of the sigmas."""
        lateral, elevational = self.beam_sigma_mm(np.linspace(0.0, self.depth_mm, 257))
        return float((2.0 * np.pi) ** 1.5 * self.axial_sigma_mm * (lateral * elevational).min())

    def image_bounds_mm(self) -> tuple[float, float, float, float]:
        """(left, right, top, bottom) of the imaged field in the probe frame; top is negative for a curved face."""
        return _bounds_of(self)

    def outline_mm(self, points_per_arc: int = 65) -> np.ndarray:
        """(points, 3) closed outline of the imaged field in the probe frame."""
        ends = np.linspace(self.first_line, -self.first_line, points_per_arc)
        origin, direction = self.line_at(ends)
        near, far = origin + self.line_starts_mm(ends)[:, None] * direction, self.line_ends_mm(ends)
        return np.concatenate([near, far[::-1], near[:1]])

    def line_ends_mm(self, position) -> np.ndarray:
        """(..., 3) deepest points of lines at these positions in the probe frame."""
        origin, direction = self.line_at(position)
        length = self.depth_mm + (self.line_starts_mm(position) if self.is_linear else 0.0)
        return origin + np.asarray(length)[..., None] * direction

    def holds(self, lateral_mm: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
        """Whether points of the image plane (probe frame, any shape) lie in the imaged field."""
        position, along = self.line_through(lateral_mm, depth_mm)
        deep = self.depth_mm
        if self.is_linear:
            along = np.asarray(depth_mm, float) / np.cos(self.steering_rad)
        elif self.has_flat_face:
            deep = np.where(np.asarray(depth_mm, float) >= 0.0, deep, -1.0)
        return (np.abs(position) <= -self.first_line) & (along >= 0.0) & (along <= deep)

    # ---- JSON --------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict:
        """Plain values, with the kind of probe under "kind"; probe_from_dict reads it back."""
        return {"kind": self.kind, **asdict(self)}


@lru_cache(maxsize=16)
def _bounds_of(probe: Probe) -> tuple[float, float, float, float]:
    """Probe.image_bounds_mm, which every frame asks for twice."""
    positions = probe.line_positions()
    starts = probe.origins_mm() + probe.line_starts_mm(positions)[:, None] * probe.directions()
    points = np.concatenate([starts, probe.line_ends_mm(positions)])
    if not probe.is_linear:
        points = np.concatenate([points, [[0.0, probe.depth_mm, 0.0]]])  # the middle of the arc, if there is no line
    x, y = points[:, 0], points[:, 1]
    return float(x.min()), float(x.max()), float(min(y.min(), 0.0)), float(y.max())


@lru_cache(maxsize=16)
def _levels_of(probe: Probe) -> np.ndarray | None:
    """Probe.line_levels, which every frame asks for."""
    sines = probe.directions()[:, 0] if probe.has_flat_face else np.zeros(1)
    if probe.directivity == "none" or not sines.any():
        return None
    return probe.steered_level(np.arcsin(sines)).astype(np.float32)


def _own(label: str, tip: str, unit: str, bounds: tuple[float, float], shown: Shown) -> Any:
    """A required parameter of one kind of probe."""
    return parameter(label=label, tip=tip, unit=unit, bounds=bounds, shown=shown)


def _depth_mm() -> Any:
    return _own("Depth", "Depth of the image", "mm", (1, 400), Shown(10, 300, is_slider=True))


def _field_of_view_deg() -> Any:
    return _own("Field of view", "Angle between the outermost scan lines", "°", (1, 170), Shown(5, 170))


@dataclass(frozen=True)
class LinearProbe(Probe):
    """A flat array with parallel scan lines over `width_mm`.

    They can be steered, or fan out from the face as from a convex array behind it (trapezoid, "virtual convex").
    """

    kind = "linear"
    geometry = "parallel scan lines"
    width_mm: float = _own("Width", "Distance between the outermost scan lines", "mm", (1, 400), Shown(5, 200))
    depth_mm: float = _depth_mm()
    steering_deg: float = parameter(
        0.0, "Steering", "Angle of all scan lines to the normal of the face, positive to the right", unit="°",
        bounds=(-45, 45), kw_only=True,
    )  # fmt: skip
    trapezoid_deg: float = parameter(
        0.0, "Trapezoid", "Angle by which the field opens to each side; 0: parallel lines", unit="°", bounds=(0, 45),
        kw_only=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            not (self.steering_deg and self.trapezoid_deg),
            f"LinearProbe: steering_deg is {self.steering_deg:g}, trapezoid_deg {self.trapezoid_deg:g}, "
            "expected one of them to be 0",
        )
        require(
            self.trapezoid_deg == 0.0 or self.trapezoid_deg >= _LEAST_TRAPEZOID_DEG,
            f"LinearProbe: trapezoid_deg is {self.trapezoid_deg}, expected 0 or at least {_LEAST_TRAPEZOID_DEG:g}",
        )

    @property
    def apex_radius_mm(self) -> float:
        if self.trapezoid_deg == 0.0:
            return float("inf")
        return 0.5 * self.width_mm / float(np.tan(np.deg2rad(self.trapezoid_deg)))

    @property
    def has_flat_face(self) -> bool:
        return True

    @property
    def face_mm(self) -> float:
        return self.width_mm

    @property
    def steering_rad(self) -> float:
        return float(np.deg2rad(self.steering_deg))

    @property
    def line_spacing(self) -> float:
        if self.trapezoid_deg:
            return 2.0 * float(np.deg2rad(self.trapezoid_deg)) / (self.scan_lines - 1)
        return self.width_mm * float(np.cos(self.steering_rad)) / (self.scan_lines - 1)

    def line_starts_mm(self, position) -> np.ndarray:
        position = np.asarray(position, float)
        if self.trapezoid_deg:
            return self.apex_radius_mm * (1.0 / np.cos(position) - 1.0)
        return position * np.tan(self.steering_rad) + 0.5 * self.width_mm * abs(np.sin(self.steering_rad))

    @property
    def displayed_mm(self) -> float:
        return self.depth_mm + self.width_mm * abs(float(np.sin(self.steering_rad)))


@dataclass(frozen=True)
class ConvexProbe(Probe):
    """A curved array of radius `radius_mm` with perpendicular scan lines over `field_of_view_deg`.

    >>> from SlicerUSSim.Logic import ConvexProbe
    >>> probe = ConvexProbe(radius_mm=40, field_of_view_deg=60, depth_mm=100)
    >>> probe.focus_mm
    60.0
    >>> probe.origins_mm().shape  # (scan_lines, 3)
    (192, 3)
    """

    kind = "convex"
    geometry = "curved array"
    radius_mm: float = _own("Radius", "Radius of curvature of the array", "mm", (1, 400), Shown(2, 200))
    field_of_view_deg: float = _field_of_view_deg()
    depth_mm: float = _depth_mm()

    @property
    def apex_radius_mm(self) -> float:
        return self.radius_mm

    @property
    def line_spacing(self) -> float:
        return np.deg2rad(self.field_of_view_deg) / (self.scan_lines - 1)


@dataclass(frozen=True)
class PhasedProbe(Probe):
    """A small array with steered scan lines from the centre of the face, over `field_of_view_deg`."""

    kind = "phased"
    geometry = "small array with beam steering"
    field_of_view_deg: float = _field_of_view_deg()
    depth_mm: float = _depth_mm()

    @property
    def apex_radius_mm(self) -> float:
        return 0.0

    @property
    def line_spacing(self) -> float:
        return np.deg2rad(self.field_of_view_deg) / (self.scan_lines - 1)


def probe_kind() -> Parameter:
    """The declaration of "kind" in a preset, which chooses among PROBE_KINDS."""
    return Parameter(
        name="kind", type=str, default="phased", label="Kind", choices=tuple(PROBE_KINDS), shown=True,
        tip="; ".join(f"{name}: {kind.geometry}" for name, kind in PROBE_KINDS.items()),
    )  # fmt: skip


def probe_from_dict(values: dict, source: str = "probe") -> Probe:
    """The probe described by plain values (see Probe.to_dict).

    Raises SimulationError that names `source` for an unknown kind or name and for a missing or invalid value.

    >>> from SlicerUSSim.Logic.probe import probe_from_dict
    >>> probe = probe_from_dict({"kind": "linear", "width_mm": 38, "depth_mm": 40, "frequency_mhz": 9})
    >>> round(probe.wavelength_mm, 3)
    0.171
    """
    require(isinstance(values, dict), f'{source}: is {kind_of(values)}, expected an object with a "kind"')
    require("kind" in values, f"{source}: lacks kind, expected {probe_kind().expected}")
    kind: Any = values["kind"]
    probe_kind().checked(source, kind)
    arguments = {name: value for name, value in values.items() if name != "kind"}
    known = sorted(entry.name for entry in parameters_of(PROBE_KINDS[kind]))
    for name in arguments:
        require(
            name in known,
            f"{source}: {short(name)[1:-1]} is not a parameter of a {kind} probe, expected one of {', '.join(known)}",
        )
    return built(PROBE_KINDS[kind], arguments, source)


#: Preset probes by name, such as PROBES["phased"]. docs/probes.md has their sources.
PROBES: dict[str, Probe] = {
    "phased": PhasedProbe(
        field_of_view_deg=80.0, depth_mm=90.0, scan_lines=196, frequency_mhz=5.0, band_mhz=(3.75, 6.25),
    ),
    "convex": ConvexProbe(
        radius_mm=40.0, field_of_view_deg=60.0, depth_mm=100.0, scan_lines=192, frequency_mhz=5.0,
        band_mhz=(3.75, 6.25),
    ),
    "linear": LinearProbe(
        width_mm=38.0, depth_mm=40.0, scan_lines=192, frequency_mhz=9.0, element_mm=0.2, elevation_aperture_mm=5.0,
        band_mhz=(6.75, 11.25),
    ),
    "microconvex": ConvexProbe(
        radius_mm=14.0, field_of_view_deg=90.0, depth_mm=80.0, frequency_mhz=6.5, aperture_mm=8.0,
        band_mhz=(4.9, 8.1),
    ),
    "abdominal": ConvexProbe(
        radius_mm=60.0, field_of_view_deg=70.0, depth_mm=160.0, frequency_mhz=3.5, aperture_mm=20.0,
        band_mhz=(2.6, 4.4),
        elevation_aperture_mm=12.0, ring_down_mm=3.0,
    ),
    "cardiac": PhasedProbe(  # 64 elements of 0.3 mm
        field_of_view_deg=90.0, depth_mm=160.0, frequency_mhz=2.7, fractional_bandwidth=0.74,
        band_mhz=(1.7, 3.7), aperture_mm=19.2,
        element_mm=0.3, elevation_aperture_mm=14.0, elevation_focus_mm=60.0, ring_down_mm=3.0,
    ),
    "transcranial": PhasedProbe(  # for the temporal bone
        field_of_view_deg=90.0, depth_mm=140.0, frequency_mhz=2.0, fractional_bandwidth=0.6,
        band_mhz=(1.4, 2.6), aperture_mm=19.2, receive_f_number=1.5, focus_mm=70.0,
        elevation_aperture_mm=14.0, elevation_focus_mm=70.0, ring_down_mm=3.0,
    ),
    "neonatal": ConvexProbe(  # for the anterior fontanelle
        radius_mm=11.0, field_of_view_deg=110.0, depth_mm=80.0, frequency_mhz=7.5, fractional_bandwidth=0.6,
        band_mhz=(5.25, 9.75),
        aperture_mm=8.0, focus_mm=40.0, elevation_aperture_mm=5.0, elevation_focus_mm=40.0,
    ),
    "linear_15": LinearProbe(
        width_mm=25.6, depth_mm=30.0, scan_lines=256, frequency_mhz=15.0,
        band_mhz=(11.25, 18.75), aperture_mm=6.4, focus_mm=15.0,
        element_mm=0.1, elevation_aperture_mm=2.5, elevation_focus_mm=12.0,
    ),
    "burr_hole": PhasedProbe(  # its face fits into a hole of 14 mm
        field_of_view_deg=90.0, depth_mm=80.0, frequency_mhz=5.2, fractional_bandwidth=0.58,
        band_mhz=(3.7, 6.7), aperture_mm=10.9,
        focus_mm=40.0, element_mm=0.171, elevation_aperture_mm=7.0, elevation_focus_mm=40.0,
    ),
    "hockey_stick": LinearProbe(
        width_mm=22.8, depth_mm=35.0, frequency_mhz=11.0, fractional_bandwidth=0.7,
        band_mhz=(7.15, 14.85), aperture_mm=8.5, focus_mm=20.0,
        element_mm=0.178, elevation_aperture_mm=4.0, elevation_focus_mm=15.0,
    ),
    "matrix": PhasedProbe(  # 3000 elements half a wavelength apart; its elevational focus is electronic
        field_of_view_deg=90.0, depth_mm=140.0, frequency_mhz=3.0, fractional_bandwidth=0.8,
        band_mhz=(1.8, 4.2), aperture_mm=14.0,
        elevation_aperture_mm=14.0, ring_down_mm=3.0,
    ),
}  # fmt: skip
