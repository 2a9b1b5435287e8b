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
        note="Refractions are not counted, so rays can cross many weak borders",
    )  # fmt: skip
    intensity_threshold: float = parameter(
        1e-6, "Ray threshold", "A ray ends when its two-way amplitude, including attenuation, falls below this value",
        bounds=(1e-12, 1),
    )  # fmt: skip
    reflection_threshold: float = parameter(
        2e-2, "Reflection threshold", "Smallest weight of a reflected ray that is followed; higher is faster",
        bounds=(1e-9, 1), note="The weight excludes attenuation",
    )  # fmt: skip
    reflection_spreading: bool = parameter(
        True, "Reflections spread", "Convex surfaces spread the reflected beam",
        note="Without it, mirror images fill the shadow of a bone or a wire", source="Off in the paper",
    )  # fmt: skip
    reference_speed_m_s: float = parameter(
        1540.0, "Scanner's speed of sound", "Speed of sound that the scanner assumes", unit="m/s", bounds=(300, 6000),
    )  # fmt: skip
    beam: str = parameter(
        "aperture", "Beam",
        "Effect of soft tissue. aperture: averaged over the aperture; ray: refraction of the beam's axis",
        choices=("aperture", "ray"),
        note="Bone, air and metal reflect and refract rays in both cases. Borders that hardly affect a beam as wide as "
        "its aperture deflect a single ray: black radial streaks",
        source="ray in the paper",
    )  # fmt: skip
    frequency_downshift: bool = parameter(
        True, "Frequency downshift",
        "Attenuation takes more of the high frequencies of a pulse: its centre falls with depth, and the beam widens",
        source="Off in the paper",
    )  # fmt: skip
    wavefront_curvature: bool = parameter(
        True, "Wavefront curvature",
        "The phase of the beam is curved across it: away from the transmit focus speckle has finer grains",
        note="It does not change the width of a point's echo", source="Off in the paper",
    )  # fmt: skip
    reflections: bool = parameter(
        True, "Reflected rays", "Simulate mirror images and reverberation by following reflected rays", shown=True
    )
    scattering: bool = parameter(True, "Speckle", "Echoes of scatterers within tissues", shown=True)
    interfaces: bool = parameter(True, "Interfaces", "Echoes of interfaces between tissues", shown=True)
    side_lobes: bool = parameter(
        True, "Side lobes", "Echoes from beside the beam, which fill cysts and shadows", shown=True,
        note="Their level and width follow from the probe's apertures and apodisation",
    )  # fmt: skip
    ring_down: bool = parameter(
        True, "Ring-down", "Reverberation between face and skin, with the ring-down values of the probe"
    )
    contact_gap_mm: float | None = parameter(
        None, "Contact gap",
        "Widest gap between probe and patient that gel fills; elements over a wider one have no contact, and their "
        "lines are dark; none: the patient lies in the coupling medium, as in a water bath or under saline",
        unit="mm", bounds=(0.0, 50.0), shown=Shown(-0.5, 20.0, 0.5, none_at=-0.5), can_be_none=True,
        option="contact-gap",
        source="Not in the paper",
    )  # fmt: skip
    scatterers_per_mm3: float | None = parameter(
        None, "Scatterers",
        "Sites of the scatterer lattice per cubic millimetre; none: eight in the probe's smallest resolution cell",
        unit="1/mm³", bounds=(0.1, 200_000), can_be_none=True,
        note="Eight are enough for developed speckle, and there are at least 4 per mm³; the lattice is fixed in the "
        "patient for a given probe. More than about 5 s per image on two cores trigger a warning",
        source="The paper's Rayleigh test uses cells of 20 µm (125000/mm³), of which mu1 keeps 1 %",
    )  # fmt: skip
    partial_volume: bool | None = parameter(
        None, "Partial volume",
        "Mix the scatterers of tissues by the probabilities of the segmentation, which requires segmenting the MRI "
        "first; none: if they are available",
        option="partial-volume/hard-labels",
        note="A scene of 3D Slicer or the page keeps them with labels by Segment until a user edits the labels",
        source="Off in the paper; more realistic, see optimization.md",
    )  # fmt: skip
    mri_modulation_db: float = parameter(
        0.0, "MRI modulation",
        "Scatterer level per standard deviation of MRI intensity within a tissue; requires segmenting the MRI first",
        unit="dB", bounds=(-6, 6), option="mri-modulation",
        note="Negative if bright tissue is hypoechoic", source="0 in the paper",
    )  # fmt: skip
    beam_cutoff: float = parameter(
        2.25, "Beam cut-off", "Half-width of the cut-off beam profile, in standard deviations", bounds=(0.5, 6),
        note="0.15 % of the beam's power lies beyond 2.25",
    )  # fmt: skip
    elevational_rays: int = parameter(
        7, "Elevational rays", "Rays per scan line that sample interfaces across the slice thickness",
        bounds=(1, 32), shown=Shown(1, 15),
    )  # fmt: skip
    lateral_rays: int = parameter(
        0,
        "Lateral rays",
        "Traced lines per scan line; 0: automatic, from the line spacing and the beam width",
        bounds=(0, 128),
    )
    interface_gain_db: float = parameter(
        44.0, "Interface gain",
        "Level of a flat perpendicular perfect reflector, relative to tissue of unit scatterer variance", unit="dB",
        bounds=(-100, 100),
        note="The default matches the contrast of walls to speckle in images of brains",
    )  # fmt: skip
    interface_reflection: str = parameter(
        "pressure", "Interface reflection", "Echo amplitude: r with pressure, r² with energy",
        choices=("pressure", "energy"), source="energy is equation 2 of the paper",
    )  # fmt: skip
    specular_exponent: float = parameter(
        3.0,
        "Specular exponent",
        "Exponent n of the echo's factor cosⁿ of the angle of incidence; higher is more specular",
        bounds=(0, 100),
    )
    samples_per_cycle: int = parameter(4, "Samples per cycle", "RF samples per cycle of the carrier", bounds=(2, 16))
    quality: str = parameter(
        "full", "Quality",
        "full: as probe and settings define. draft: fewer scatterers, samples and rays, and fewer scan lines in "
        "images of fewer columns; a quarter of the time for 160 columns",
        choices=("full", "draft"),
        note="See performance.md. Fits use full quality",
    )  # fmt: skip

    @property
    def needs_texture(self) -> bool:
        """Whether scatterers depend on the MRI's intensities or class probabilities, so that labels are not enough."""
        return self.partial_volume is True or self.mri_modulation_db != 0.0


def _depth_gain(number: int) -> Any:
    """One of eight sliders."""
    return parameter(
        0.0, f"TGC {number} of 8", f"Slider {number} of 8 of the gain by depth, from the face to the image depth",
        unit="dB", bounds=(-60, 60), shown=Shown(-30, 30, 0.5, is_slider=True),
        fit=Fit(-15, 15, tolerance=2.0, on_request=True),
    )  # fmt: skip


def _line_gain(number: int) -> Any:
    """One of five knots across the field."""
    return parameter(
        0.0, f"Lateral gain {number} of 5",
        f"Knot {number} of 5 of the gain by scan line, from the left to the right: poor contact is dark", unit="dB",
        bounds=(-60, 60), shown=Shown(-30, 30, 0.5, is_slider=True), fit=Fit(-15, 15, tolerance=2.0, on_request=True),
    )  # fmt: skip


def _map_slope(where: str) -> Any:
    return parameter(
        1.0, f"Map at {where}", f"Slope of the grey map at {where}, relative to the slope at half of white",
        bounds=(0.02, 8), fit=Fit(0.1, 3, tolerance=0.15, is_logarithmic=True, on_request=True),
        note="Multiplies the slope of grey_map",
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
        "Time-gain compensation, as the one-way attenuation that it compensates over the pulse's band; 0: none",
        unit="dB/(cm MHz)", bounds=(0, 20), shown=Shown(0, 2, 0.01, is_slider=True), option="tgc",
        fit=Fit(0.0, 1.2, tolerance=0.1),
    )  # fmt: skip
    tgc_reach: float = parameter(
        1.0, "TGC reach",
        "Part of the image depth over which TGC rises; below it is constant, since an amplifier has a largest gain",
        bounds=(0, 1), option="tgc-reach",
        fit=Fit(0.1, 1.0, tolerance=0.1, on_request=True),
    )  # fmt: skip
    near_gain_db: float = parameter(
        0.0, "Near gain",
        "Gain at the face, which falls to 1 / e over 6 mm: near the face a scanner receives with fewer elements, and "
        "consoles have a control for it",
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
        "Sigma of a Gaussian along the lines that smooths the envelope before compression",
        unit="mm", bounds=(0, 3), fit=Fit(0.0, 0.3, tolerance=0.03, on_request=True),
        note="0.06 to 0.1 is as good as 3 to 5 compounded looks",
    )  # fmt: skip
    smoothing_lateral_deg: float = parameter(
        0.0, "Smoothing across lines",
        "Sigma of a Gaussian across the lines that smooths the envelope: an angle at the apex of a sector, and on a "
        "linear array seen from the focal depth",
        unit="°", bounds=(0, 5), fit=Fit(0.0, 0.8, tolerance=0.06, on_request=True),
    )  # fmt: skip
    edge_enhancement: float = parameter(
        0.0, "Edge enhancement", "Weight of the added difference between grey levels and their mean within 0.5 mm",
        bounds=(0, 4), fit=Fit(0.0, 1.5, tolerance=0.1, on_request=True),
    )  # fmt: skip
    persistence: float = parameter(
        0.0, "Persistence",
        "Weight of the last image in the next one of the same probe; 0: none",
        bounds=(0, 0.98), shown=Shown(0, 0.95, 0.05, is_slider=True),
        note="For consecutive images, live and in sweeps; fits and comparisons do not use it",
    )  # fmt: skip
    look: str = parameter(
        "scanner", "Look",
        "scanner: a scanner's preset, which leaves some attenuation, uneven contact and smoothing in the image. even: "
        "compensated, even and as sharp as the beam, for work on algorithms. Gains and smoothing add to it",
        choices=("scanner", "even"), shown=True, option="look",
    )  # fmt: skip
    grey_map: str = parameter(
        "linear", "Grey map",
        "From decibels to grey levels. linear: log compression alone. soft: flat near black, steep near white, as in a "
        "scanner of brains. contrast: very flat near black, then straight",
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
