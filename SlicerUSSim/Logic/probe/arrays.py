"""Probes: origins and directions of the scan lines, and widths of the beam.

Probe frame (millimetres): origin at the centre of the probe face, +x lateral (left to right in the image), +y depth,
+z elevational. A scan line is a polar line around the apex of a curved array, or a parallel line of a linear one.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np

from SlicerUSSim.Logic.base.declaration import (
    Declared,
    Parameter,
    Shown,
    built,
    kind_of,
    parameter,
    parameters_of,
    short,
)
from SlicerUSSim.Logic.base.errors import require

NOMINAL_SPEED_M_S = 1540.0
#: -6 dB width of the main lobe of a uniform aperture, in wavelengths x f-number
MAIN_LOBE = 1.21
#: Smallest f-number of a focus on transmission and of the lens
LEAST_F_NUMBER = 0.5
FWHM_PER_SIGMA = 2.0 * np.sqrt(2.0 * np.log(2.0))
#: None until the probe's depth is set. Typed Any, since constructed probes never have None
_BY_DEPTH: Any = None
#: {name in a preset: class} of all kinds of probe
PROBE_KINDS: dict[str, type[Probe]] = {}


@dataclass(frozen=True, kw_only=True)
class Probe(Declared):
    """What all probes share. Use LinearProbe, ConvexProbe or PhasedProbe.

    The two-way beam (amplitude, docs/physics.md#4-beam-and-pulse) is Gaussian across its axis. Laterally it is the
    product of a transmit beam focused once at `focus_mm` and a receive beam that is focused at every depth, with an
    aperture that grows at constant f-number until it is fully open; elevationally the lens focuses both ways at one
    depth.
    Each one-way beam has the width of a uniform aperture at its focus: FWHM = 1.21 x wavelength x f-number. With
    `receive_apodization` the receive beam is wider, as much as the main lobe of its aperture (`widening`).

    >>> from dataclasses import replace
    >>> from SlicerUSSim.Logic.probe import PROBES
    >>> ", ".join(PROBES)
    'phased, convex, linear, microconvex, abdominal, cardiac, neonatal, linear_15, burr_hole, hockey_stick, matrix'
    >>> replace(PROBES["convex"], frequency_mhz=3.5).depth_mm
    100.0
    """

    scan_lines: int = parameter(
        192, "Scan lines", "Number of scan lines in an image", bounds=(2, 4096), shown=Shown(16, 512)
    )
    frequency_mhz: float = parameter(
        5.0, "Frequency", "Centre frequency of the pulse; higher: finer resolution, less penetration",
        unit="MHz", bounds=(0.5, 40), shown=Shown(1, 20, 0.1, is_slider=True),
    )  # fmt: skip
    fractional_bandwidth: float = parameter(
        0.5, "Bandwidth", "-6 dB bandwidth of the two-way pulse, as a fraction of the frequency", bounds=(0.05, 1.5)
    )
    focus_mm: float = parameter(
        _BY_DEPTH, "Focus", "Depth of the transmit focus; none (panels: 0): 60 % of the image depth", unit="mm",
        bounds=(0.1, 1000), shown=Shown(0, 300, is_slider=True, none_at=0.0), can_be_none=True,
        note="It then moves with the depth",
    )  # fmt: skip
    aperture_mm: float = parameter(
        12.0, "Aperture", "Lateral size of the fully open aperture", unit="mm", bounds=(0.5, 200)
    )
    receive_f_number: float = parameter(
        2.5, "Receive f-number", "Smallest f-number of the receive aperture", bounds=(0.5, 20),
        note="The receive aperture grows with depth up to the full aperture",
    )  # fmt: skip
    receive_apodization: float = parameter(
        0.0, "Apodisation", "Weights of the receive aperture: 0 uniform, 1 Hann; lower side lobes, a wider beam",
        bounds=(0, 1),
    )  # fmt: skip
    clutter_db: float = parameter(
        -38.0, "Clutter", "Diffuse echoes from beside the beam, by multiple scattering and aberration, re its own",
        unit="dB", bounds=(-100, 0),
        note="They and the side lobes fill cysts; spread evenly over 24 wavelengths x f-number to either side",
    )  # fmt: skip
    elevation_aperture_mm: float = parameter(
        7.0, "Elevational aperture", "Height of the elements, in the elevation direction", unit="mm", bounds=(0.5, 100)
    )
    elevation_focus_mm: float = parameter(
        _BY_DEPTH, "Elevational focus", "Depth of the focus of the lens; none: 60 % of the image depth", unit="mm",
        bounds=(0.1, 1000), can_be_none=True, note="It then moves with the depth",
    )  # fmt: skip

    ring_down_mm: float = parameter(
        1.5, "Ring-down", "Depth in which reverberation between face and skin falls by 40 dB; 0: none", unit="mm",
        bounds=(0, 10),
    )  # fmt: skip
    ring_down_db: float = parameter(
        0.0, "Ring-down level", "Of the reverberation at the face, re tissue of unit scatterer variance", unit="dB",
        bounds=(-100, 100),
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

    def line_positions(self) -> np.ndarray:
        """(scan_lines,) position of every line: radians around the apex, or millimetres along a linear face."""
        return self.first_line + self.line_spacing * np.arange(self.scan_lines)

    def line_at(self, position) -> tuple[np.ndarray, np.ndarray]:
        """((..., 3) origin in mm, (..., 3) unit direction) in the probe frame of the lines at these positions."""
        position = np.asarray(position, float)
        zero = np.zeros_like(position)
        if self.is_linear:
            return np.stack([position, zero, zero], axis=-1), np.stack([zero, zero + 1.0, zero], axis=-1)
        sine, cosine, radius = np.sin(position), np.cos(position), self.apex_radius_mm
        return (
            np.stack([radius * sine, radius * (cosine - 1.0), zero], axis=-1),
            np.stack([sine, cosine, zero], axis=-1),
        )

    def origins_mm(self) -> np.ndarray:
        """(scan_lines, 3) starting points on the probe face in the probe frame."""
        return self.line_at(self.line_positions())[0]

    def directions(self) -> np.ndarray:
        """(scan_lines, 3) unit vectors along the scan lines in the probe frame."""
        return self.line_at(self.line_positions())[1]

    def line_through(self, lateral_mm, depth_mm) -> tuple[np.ndarray, np.ndarray]:
        """(position of the line, millimetres along it) of points of the image plane; the inverse of line_at."""
        x, y = np.asarray(lateral_mm, float), np.asarray(depth_mm, float)
        if self.is_linear:
            return x, y
        from_apex = y + self.apex_radius_mm
        return np.arctan2(x, from_apex), np.hypot(x, from_apex) - self.apex_radius_mm

    def line_distance_mm(self, along_mm) -> np.ndarray:
        """Distance between neighbouring scan lines, `along_mm` from the face."""
        along = np.asarray(along_mm, float)
        return self.line_spacing * (np.ones_like(along) if self.is_linear else along + self.apex_radius_mm)

    def image_bounds_mm(self) -> tuple[float, float, float, float]:
        """(left, right, top, bottom) of the imaged field in the probe frame; top is negative for a curved face."""
        starts = self.origins_mm()
        points = np.concatenate([starts, starts + self.depth_mm * self.directions()])
        if not self.is_linear:
            points = np.concatenate([points, [[0.0, self.depth_mm, 0.0]]])  # the middle of the arc, if there is no line
        x, y = points[:, 0], points[:, 1]
        return float(x.min()), float(x.max()), float(min(y.min(), 0.0)), float(y.max())

    def outline_mm(self, points_per_arc: int = 65) -> np.ndarray:
        """(points, 3) closed outline of the imaged field in the probe frame."""
        ends = np.linspace(self.first_line, -self.first_line, points_per_arc)
        if self.is_linear:
            near = np.stack([ends, 0 * ends, 0 * ends], axis=1)
            far = near + [0.0, self.depth_mm, 0.0]
        else:
            ray = np.stack([np.sin(ends), np.cos(ends), 0 * ends], axis=1)
            apex = np.array([0.0, -self.apex_radius_mm, 0.0])
            near, far = apex + self.apex_radius_mm * ray, apex + (self.apex_radius_mm + self.depth_mm) * ray
        return np.concatenate([near, far[::-1], near[:1]])

    def holds(self, lateral_mm: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
        """Whether points of the image plane (probe frame, any shape) lie in the imaged field."""
        position, along = self.line_through(lateral_mm, depth_mm)
        return (np.abs(position) <= -self.first_line) & (along >= 0.0) & (along <= self.depth_mm)

    # ---- wave and beam -----------------------------------------------------------------------------------------

    @property
    def wavelength_mm(self) -> float:
        """Wavelength at the nominal speed of sound of 1540 m/s, for which arrays are designed."""
        return NOMINAL_SPEED_M_S / self.frequency_mhz * 1e-3

    @property
    def cycles_per_mm(self) -> float:
        """Cycles of the centre frequency per millimetre of *depth* (two-way travel)."""
        return 2.0 / self.wavelength_mm

    @property
    def axial_sigma_mm(self) -> float:
        """Standard deviation of the pulse envelope in depth.

        A Gaussian spectrum whose amplitude is halved (-6 dB) at f0 (1 +- b/2) has sigma_f = b f0 / FWHM_PER_SIGMA, and
        sigma_t = 1 / (2 pi sigma_f); depth is c t / 2.
        """
        sigma_mhz = self.fractional_bandwidth * self.frequency_mhz / FWHM_PER_SIGMA
        return NOMINAL_SPEED_M_S * 1e-3 / (4.0 * np.pi * sigma_mhz)

    def beam_sigma_mm(self, depth_mm) -> tuple[np.ndarray, np.ndarray]:
        """(lateral, elevational) standard deviation of the two-way beam amplitude at `depth_mm` along a scan line."""
        depth = np.asarray(depth_mm, dtype=float)
        transmit = self._gaussian_beam(depth, *self.transmit_waist())
        least, slope = self.receive_beam()
        receive = np.maximum(least, slope * depth)
        lateral = transmit * receive / np.hypot(transmit, receive)
        elevational = self._gaussian_beam(depth, *self.elevation_waist()) / np.sqrt(2.0)
        return lateral, elevational

    def smallest_cell_mm3(self) -> float:
        """Volume of the smallest resolution cell within the image depth: (2 pi)^1.5 times the product of the sigmas."""
        lateral, elevational = self.beam_sigma_mm(np.linspace(0.0, self.depth_mm, 257))
        return float((2.0 * np.pi) ** 1.5 * self.axial_sigma_mm * (lateral * elevational).min())

    def receive_beam(self) -> tuple[float, float]:
        """(least sigma in mm, sigma per mm of depth) of the one-way lateral receive beam, focused at every depth."""
        per_f_number = MAIN_LOBE * widening(self.receive_apodization) * self.wavelength_mm / FWHM_PER_SIGMA
        return per_f_number * self.receive_f_number, per_f_number / self.aperture_mm

    def transmit_waist(self) -> tuple[float, float, float]:
        """(sigma at the focus, focus, Rayleigh length) of the one-way lateral transmit beam, millimetres."""
        return self._waist(self.focus_mm, self.aperture_mm)

    def elevation_waist(self) -> tuple[float, float, float]:
        """(sigma at the focus, focus, Rayleigh length) of the one-way elevational beam, millimetres."""
        return self._waist(self.elevation_focus_mm, self.elevation_aperture_mm)

    def _waist(self, focus_mm: float, aperture_mm: float) -> tuple[float, float, float]:
        # Elements farther aside than the focus is deep hardly contribute (and scanners close them).
        f_number = max(focus_mm / aperture_mm, LEAST_F_NUMBER)
        sigma = MAIN_LOBE * self.wavelength_mm * f_number / FWHM_PER_SIGMA
        # A Gaussian beam of amplitude exp(-y^2 / w^2), w^2 = 2 sigma^2, has the Rayleigh length pi w^2 / wavelength.
        return sigma, focus_mm, 2.0 * np.pi * sigma**2 / self.wavelength_mm

    @staticmethod
    def _gaussian_beam(depth, sigma, focus, rayleigh):
        return sigma * np.sqrt(1.0 + ((depth - focus) / rayleigh) ** 2)

    # ---- JSON --------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict:
        """Plain values, with the kind of probe under "kind"; probe_from_dict reads it back."""
        return {"kind": self.kind, **asdict(self)}


def apodized_pattern(u: np.ndarray, apodization: float) -> np.ndarray:
    """The amplitude, 1 at u = 0, at u wavelengths x f-number from the axis of an aperture with weights, at its focus.

    The weights are 1 - a + a cos(pi x)^2 for x from -1/2 to 1/2: the transform of a constant and of a cosine.
    """
    half = 0.5 * apodization
    return np.sinc(u) + 0.5 * half / (1.0 - half) * (np.sinc(u - 1.0) + np.sinc(u + 1.0))


@cache
def widening(apodization: float) -> float:
    """The -6 dB width of the main lobe of an aperture with weights (apodized_pattern) re that of a uniform one."""
    u = np.linspace(0.5, 1.1, 1201)  # half widths: 0.603 with 0, 1 with 1
    uniform, weighted = (float(np.interp(-0.5, -apodized_pattern(u, a), u)) for a in (0.0, apodization))
    return weighted / uniform


def _own(label: str, tip: str, unit: str, bounds: tuple[float, float], shown: Shown) -> Any:
    """A required parameter of one kind of probe."""
    return parameter(label=label, tip=tip, unit=unit, bounds=bounds, shown=shown)


def _depth_mm() -> Any:
    return _own("Depth", "Depth of the image", "mm", (1, 400), Shown(10, 300, is_slider=True))


def _field_of_view_deg() -> Any:
    return _own("Field of view", "Angle between the outermost scan lines", "°", (1, 170), Shown(5, 170))


@dataclass(frozen=True)
class LinearProbe(Probe):
    """A flat array with parallel scan lines over `width_mm`."""

    kind = "linear"
    geometry = "parallel scan lines"
    width_mm: float = _own("Width", "Distance between the outermost scan lines", "mm", (1, 400), Shown(5, 200))
    depth_mm: float = _depth_mm()

    @property
    def apex_radius_mm(self) -> float:
        return float("inf")

    @property
    def line_spacing(self) -> float:
        return self.width_mm / (self.scan_lines - 1)


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
    "phased": PhasedProbe(field_of_view_deg=80.0, depth_mm=90.0, scan_lines=196, frequency_mhz=5.0),
    "convex": ConvexProbe(radius_mm=40.0, field_of_view_deg=60.0, depth_mm=100.0, scan_lines=192, frequency_mhz=5.0),
    "linear": LinearProbe(width_mm=38.0, depth_mm=40.0, scan_lines=192, frequency_mhz=9.0, elevation_aperture_mm=5.0),
    "microconvex": ConvexProbe(
        radius_mm=14.0, field_of_view_deg=90.0, depth_mm=80.0, frequency_mhz=6.5, aperture_mm=8.0,
    ),
    "abdominal": ConvexProbe(
        radius_mm=60.0, field_of_view_deg=70.0, depth_mm=160.0, frequency_mhz=3.5, aperture_mm=20.0,
        elevation_aperture_mm=12.0,
    ),
    "cardiac": PhasedProbe(  # 64 elements of 0.3 mm
        field_of_view_deg=90.0, depth_mm=160.0, frequency_mhz=2.7, fractional_bandwidth=0.74, aperture_mm=19.2,
        elevation_aperture_mm=14.0, elevation_focus_mm=60.0,
    ),
    "neonatal": ConvexProbe(  # for the anterior fontanelle
        radius_mm=11.0, field_of_view_deg=110.0, depth_mm=80.0, frequency_mhz=7.5, fractional_bandwidth=0.6,
        aperture_mm=8.0, focus_mm=40.0, elevation_aperture_mm=5.0, elevation_focus_mm=40.0,
    ),
    "linear_15": LinearProbe(
        width_mm=25.6, depth_mm=30.0, scan_lines=256, frequency_mhz=15.0, aperture_mm=6.4, focus_mm=15.0,
        elevation_aperture_mm=2.5, elevation_focus_mm=12.0,
    ),
    "burr_hole": PhasedProbe(  # its face fits into a hole of 14 mm
        field_of_view_deg=90.0, depth_mm=80.0, frequency_mhz=5.2, fractional_bandwidth=0.58, aperture_mm=10.9,
        focus_mm=40.0, elevation_aperture_mm=7.0, elevation_focus_mm=40.0,
    ),
    "hockey_stick": LinearProbe(
        width_mm=22.8, depth_mm=35.0, frequency_mhz=11.0, fractional_bandwidth=0.7, aperture_mm=8.5, focus_mm=20.0,
        elevation_aperture_mm=4.0, elevation_focus_mm=15.0,
    ),
    "matrix": PhasedProbe(  # 3000 elements half a wavelength apart; its elevational focus is electronic
        field_of_view_deg=90.0, depth_mm=140.0, frequency_mhz=3.0, fractional_bandwidth=0.8, aperture_mm=14.0,
        elevation_aperture_mm=14.0,
    ),
}  # fmt: skip
