"""Settings of the simulation and of the display: frozen, checked on construction, plain values in and out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from SlicerUSSim.Logic.base.declaration import Declared, Fit, Shown, parameter

#: Level of full white at 0 dB gain, in dB relative to the mean square echo of tissue with unit scatterer variance.
FULL_SCALE_DB = 23.0


@dataclass(frozen=True)
class SimulationSettings(Declared):
    """Settings of the acoustic model, other than tissues, probe and pose.

    >>> from SlicerUSSim.Logic import SimulationSettings
    >>> SimulationSettings(seed=7, reflections=False).max_ray_depth
    6
    """

    seed: int = parameter(
        0, "Seed", "Seed of the random scatterers and noise", bounds=(0, 2**32 - 1),
        shown=Shown(0, 999_999), option="seed",
    )  # fmt: skip
    max_ray_depth: int = parameter(
        6, "Reflections", "Largest number of reflections along one path", bounds=(0, 16),
    )  # fmt: skip
    intensity_threshold: float = parameter(
        1e-6, "Ray threshold", "A ray ends below this two-way amplitude", bounds=(1e-12, 1),
    )  # fmt: skip
    reflection_threshold: float = parameter(
        2e-2, "Reflection threshold", "Smallest weight of a reflected ray that is followed; higher is faster",
        bounds=(1e-9, 1),
    )  # fmt: skip
    reflection_spreading: bool = parameter(
        True, "Reflections spread", "Convex surfaces spread the reflected beam; otherwise mirror images fill shadows",
        source="Off in the paper",
    )  # fmt: skip
    reference_speed_m_s: float = parameter(
        1540.0, "Scanner's speed of sound", "Speed of sound that the scanner assumes", unit="m/s", bounds=(300, 6000),
    )  # fmt: skip
    beam: str = parameter(
        "aperture", "Beam",
        "Effect of soft tissue. aperture: averaged over the aperture; ray: refraction of one ray, with black streaks",
        choices=("aperture", "ray"), source="ray in the paper",
    )  # fmt: skip
    frequency_downshift: bool = parameter(
        True, "Frequency downshift",
        "The frequency of the pulse falls with depth, and the beam widens, by attenuation",
        source="Off in the paper",
    )  # fmt: skip
    wavefront_curvature: bool = parameter(
        True, "Wavefront curvature",
        "Away from the transmit focus speckle has finer grains", source="Off in the paper",
    )  # fmt: skip
    reflections: bool = parameter(True, "Reflected rays", "Mirror images and reverberation", shown=True)
    scattering: bool = parameter(True, "Speckle", "Echoes of scatterers within tissues", shown=True)
    interfaces: bool = parameter(True, "Interfaces", "Echoes of interfaces between tissues", shown=True)
    side_lobes: bool = parameter(
        True, "Side lobes", "Echoes from beside the beam, which fill cysts and shadows", shown=True,
    )  # fmt: skip
    ring_down: bool = parameter(True, "Ring-down", "Reverberation between face and skin")
    contact_gap_mm: float | None = parameter(
        None, "Contact gap",
        "Widest gap between probe and patient that gel fills; lines over a wider one are dark; none: the coupling "
        "medium is everywhere, as in a water bath or under saline",
        unit="mm", bounds=(0.0, 50.0), shown=Shown(-0.5, 20.0, 0.5, none_at=-0.5), can_be_none=True,
        option="contact-gap",
        source="Not in the paper",
    )  # fmt: skip
    scatterers_per_mm3: float | None = parameter(
        None, "Scatterers",
        "Sites of the scatterer lattice per cubic millimetre; none: as many as developed speckle needs, at least 4",
        unit="1/mm³", bounds=(0.1, 200_000), can_be_none=True, source="125000 in the paper's Rayleigh test",
    )  # fmt: skip
    partial_volume: bool | None = parameter(
        None, "Partial volume",
        "Mix the scatterers of tissues by the probabilities of the MRI's segmentation; none: if it is available",
        option="partial-volume/hard-labels", source="Off in the paper",
    )  # fmt: skip
    mri_modulation_db: float = parameter(
        0.0, "MRI modulation",
        "Scatterer level per standard deviation of MRI intensity within a tissue; requires segmenting the MRI first",
        unit="dB", bounds=(-6, 6), option="mri-modulation", source="0 in the paper",
    )  # fmt: skip
    beam_cutoff: float = parameter(
        2.25, "Beam cut-off", "Half-width of the beam profile, in standard deviations", bounds=(0.5, 6),
    )  # fmt: skip
    elevational_rays: int = parameter(
        7, "Elevational rays", "Rays per scan line across the slice thickness, for interfaces",
        bounds=(1, 32), shown=Shown(1, 15),
    )  # fmt: skip
    lateral_rays: int = parameter(
        0,
        "Lateral rays",
        "Traced lines per scan line; 0: automatic",
        bounds=(0, 128),
    )
    interface_gain_db: float = parameter(
        44.0, "Interface gain",
        "Level of a flat perpendicular perfect reflector, relative to tissue of unit scatterer variance", unit="dB",
        bounds=(-100, 100),
    )  # fmt: skip
    interface_reflection: str = parameter(
        "pressure", "Interface reflection", "Echo amplitude: r with pressure, r² with energy",
        choices=("pressure", "energy"), source="energy in the paper",
    )  # fmt: skip
    specular_exponent: float = parameter(
        3.0,
        "Specular exponent",
        "Exponent n of cosⁿ of the angle of incidence, for interfaces; higher is more specular",
        bounds=(0, 100),
    )
    samples_per_cycle: int = parameter(4, "Samples per cycle", "RF samples per cycle of the carrier", bounds=(2, 16))
    quality: str = parameter(
        "full", "Quality",
        "draft: fewer scatterers, samples, rays and scan lines, faster with a small image size; fits use full",
        choices=("full", "draft"),
    )  # fmt: skip

    @property
    def needs_texture(self) -> bool:
        """Whether scatterers depend on the MRI's intensities or class probabilities, so that labels are not enough."""
        return self.partial_volume is True or self.mri_modulation_db != 0.0


def _depth_gain(number: int) -> Any:
    """One of eight sliders."""
    return parameter(
        0.0, f"TGC {number} of 8", "Gain by depth; slider 1 is at the face, 8 at the image depth",
        unit="dB", bounds=(-60, 60), shown=Shown(-30, 30, 0.5, is_slider=True),
        fit=Fit(-15, 15, tolerance=2.0, on_request=True),
    )  # fmt: skip


def _line_gain(number: int) -> Any:
    """One of five knots across the field."""
    return parameter(
        0.0, f"Lateral gain {number} of 5",
        "Gain by scan line, from the left (1) to the right (5); poor contact is dark", unit="dB",
        bounds=(-60, 60), shown=Shown(-30, 30, 0.5, is_slider=True), fit=Fit(-15, 15, tolerance=2.0, on_request=True),
    )  # fmt: skip


def _map_slope(where: str) -> Any:
    return parameter(
        1.0, f"Map at {where}", f"Slope at {where} relative to half of white, times that of grey_map",
        bounds=(0.02, 8), fit=Fit(0.1, 3, tolerance=0.15, is_logarithmic=True, on_request=True),
    )  # fmt: skip


@dataclass(frozen=True)
class DisplaySettings(Declared):
    """Settings of a scanner's console.

    >>> from dataclasses import replace
    >>> from SlicerUSSim.Logic import DisplaySettings
    >>> replace(DisplaySettings(gain_db=3.0), dynamic_range_db=60.0).gain_db
    3.0
    """

    gain_db: float = parameter(
        0.0, "Gain", "Brightness of all echoes", unit="dB", bounds=(-200, 200),
        shown=Shown(-40, 40, 0.5, is_slider=True), option="gain", fit=Fit(-30, 30, tolerance=1.5),
    )  # fmt: skip
    dynamic_range_db: float = parameter(
        55.0, "Dynamic range", "Range of echo levels between black and white", unit="dB", bounds=(1, 200),
        shown=Shown(20, 120, is_slider=True), option="dynamic-range", fit=Fit(30, 90, tolerance=3.0),
    )  # fmt: skip
    tgc_db_cm_mhz: float = parameter(
        0.5, "TGC",
        "Time-gain compensation of this one-way attenuation; 0: none",
        unit="dB/(cm MHz)", bounds=(0, 20), shown=Shown(0, 2, 0.01, is_slider=True), option="tgc",
        fit=Fit(0.0, 1.2, tolerance=0.1),
    )  # fmt: skip
    tgc_reach: float = parameter(
        1.0, "TGC reach",
        "Part of the image depth over which TGC rises; below, it is constant",
        bounds=(0, 1), option="tgc-reach",
        fit=Fit(0.1, 1.0, tolerance=0.1, on_request=True),
    )  # fmt: skip
    near_gain_db: float = parameter(
        0.0, "Near gain",
        "Gain at the face, which falls to 1 / e over 6 mm",
        unit="dB", bounds=(-60, 60), shown=Shown(-40, 20, 0.5, is_slider=True), option="near-gain",
        fit=Fit(-40, 10, tolerance=3.0),
    )  # fmt: skip
    noise_db: float | None = parameter(
        -80.0, "Noise",
        "Amplifier noise before TGC, relative to tissue of unit scatterer variance; panels: -150 for none",
        unit="dB", bounds=(-300, 100), shown=Shown(-150, 0, is_slider=True, none_at=-150.0), option="noise",
        fit=Fit(-120, -30, tolerance=3.0),
    )  # fmt: skip
    smoothing_axial_mm: float = parameter(
        0.0, "Smoothing along lines",
        "Sigma of a Gaussian that smooths the envelope along lines; 0.06 to 0.1 is as good as 3 to 5 compounded looks",
        unit="mm", bounds=(0, 3), fit=Fit(0.0, 0.3, tolerance=0.03, on_request=True),
    )  # fmt: skip
    smoothing_lateral_deg: float = parameter(
        0.0, "Smoothing across lines",
        "Sigma of a Gaussian that smooths the envelope across lines: an angle at the apex of a sector, or seen from "
        "the focal depth of a linear array",
        unit="°", bounds=(0, 5), fit=Fit(0.0, 0.8, tolerance=0.06, on_request=True),
    )  # fmt: skip
    edge_enhancement: float = parameter(
        0.0, "Edge enhancement", "Weight of the added difference between grey levels and their mean within 0.5 mm",
        bounds=(0, 4), fit=Fit(0.0, 1.5, tolerance=0.1, on_request=True),
    )  # fmt: skip
    persistence: float = parameter(
        0.0, "Persistence",
        "Weight of the last image in the next one, live and in sweeps; 0: none",
        bounds=(0, 0.98), shown=Shown(0, 0.95, 0.05, is_slider=True),
    )  # fmt: skip
    look: str = parameter(
        "scanner", "Look",
        "scanner: some attenuation, uneven contact and smoothing, as in images of scanners. even: compensated and as "
        "sharp as the beam. Gains and smoothing add to it",
        choices=("scanner", "even"), shown=True, option="look",
    )  # fmt: skip
    grey_map: str = parameter(
        "linear", "Grey map",
        "From decibels to grey levels. linear: log compression alone. soft: flat near black, steep near white. "
        "contrast: very flat near black, then straight",
        choices=("linear", "soft", "contrast"), shown=True, option="grey-map",
    )  # fmt: skip
    map_black: float = _map_slope("black")
    map_dark: float = _map_slope("a quarter of white")
    map_white: float = _map_slope("white")
    depth_gain_1_db: float = _depth_gain(1)
    depth_gain_2_db: float = _depth_gain(2)
    depth_gain_3_db: float = _depth_gain(3)
    depth_gain_4_db: float = _depth_gain(4)
    depth_gain_5_db: float = _depth_gain(5)
    depth_gain_6_db: float = _depth_gain(6)
    depth_gain_7_db: float = _depth_gain(7)
    depth_gain_8_db: float = _depth_gain(8)
    line_gain_1_db: float = _line_gain(1)
    line_gain_2_db: float = _line_gain(2)
    line_gain_3_db: float = _line_gain(3)
    line_gain_4_db: float = _line_gain(4)
    line_gain_5_db: float = _line_gain(5)
    image_size: tuple[int, int] | None = parameter(
        None, "Image size", "Rows and columns of the image; none: 512 rows and square pixels",
        unit="pixels", bounds=(8, 8192),
    )  # fmt: skip
