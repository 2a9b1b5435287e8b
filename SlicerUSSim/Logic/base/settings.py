"""Settings of the simulation and of the display: frozen, checked on construction, plain values in and out."""

from __future__ import annotations

from dataclasses import dataclass

from SlicerUSSim.Logic.base.declaration import Declared, Fit, Shown, parameter

#: Level of full white at 0 dB gain, in dB re the mean square echo of tissue with unit scatterer variance.
FULL_SCALE_DB = 23.0


@dataclass(frozen=True)
class SimulationSettings(Declared):
    """What the physics needs beside tissues, probe and pose.

    >>> from SlicerUSSim.Logic import SimulationSettings
    >>> SimulationSettings(seed=7, reflections=False).max_ray_depth
    6
    """

    seed: int = parameter(
        0, "Seed", "Which speckle and noise: another number is another patient", bounds=(0, 2**32 - 1),
        shown=Shown(0, 999_999), option="seed",
    )  # fmt: skip
    max_ray_depth: int = parameter(
        6, "Reflections", "Reflections along one path at most", bounds=(0, 16), shown=Shown(0, 16),
        note="Refracted rays continue at their parent's depth, so that crossing many weak borders does not end a ray",
    )  # fmt: skip
    intensity_threshold: float = parameter(
        1e-6, "Ray threshold", "A ray ends when its two-way amplitude, attenuation included, falls below this",
        bounds=(1e-12, 1), shown=Shown(-200, -20, is_slider=True, as_db=True),
    )  # fmt: skip
    reflection_threshold: float = parameter(
        2e-2, "Reflection threshold", "A reflected ray is followed from this weight on; higher is faster",
        bounds=(1e-9, 1), shown=Shown(-120, -6, is_slider=True, as_db=True), note="Attenuation does not count",
    )  # fmt: skip
    reflection_spreading: bool = parameter(
        True, "Reflections spread", "Convex surfaces spread what they reflect",
        note="Without it the shadow of a bone or a wire is filled by what it mirrors", source="False is the paper",
    )  # fmt: skip
    reference_speed_m_s: float = parameter(
        1540.0, "Scanner's speed of sound", "Speed of sound that the scanner assumes", unit="m/s", bounds=(300, 6000),
        shown=Shown(1000, 2000),
    )  # fmt: skip
    reflections: bool = parameter(
        True, "Reflected rays", "Follow reflected rays: mirror images and reverberation", shown=True
    )
    scattering: bool = parameter(True, "Speckle", "Echoes of scatterers inside tissues", shown=True)
    interfaces: bool = parameter(True, "Interfaces", "Echoes of borders between tissues", shown=True)
    scatterers_per_mm3: float = parameter(
        42.0, "Scatterers", "Sites of the scatterer lattice per cubic millimetre", unit="1/mm³", bounds=(0.1, 200_000),
        note="42 is a cell of 0.29 mm. At the tightest focus of a 5 MHz probe ten of them fill the resolution cell and "
        "the envelope's mean / deviation is 1.87 instead of 1.91; 100 give 1.90 and take twice the time",
        source="The paper's Rayleigh test has a lattice of 20 µm: 125000, of which mu1 keeps 1 %",
    )  # fmt: skip
    partial_volume: bool = parameter(
        False, "Mixed tissues at borders",
        "Scatterers take their tissue by the probabilities of the segmentation; needs the MRI to be segmented now",
        shown=True, option="partial-volume/hard-labels", source="False is the paper",
    )  # fmt: skip
    mri_modulation_db: float = parameter(
        0.0, "MRI in tissues",
        "How far scatterers follow the MRI in a tissue, per standard deviation; needs the MRI to be segmented now",
        unit="dB", bounds=(-6, 6), shown=Shown(-6, 6, 0.1, is_slider=True), option="mri-modulation",
        note="Negative where bright means echo-poor", source="0 is the paper",
    )  # fmt: skip
    beam_cutoff: float = parameter(
        2.25, "Beam cut-off", "Where the beam profile ends, in standard deviations", bounds=(0.5, 6),
        note="What lies beyond 2.25 has 0.15 % of the beam's power",
    )  # fmt: skip
    elevational_rays: int = parameter(
        7, "Elevational rays", "Rays per scan line that sample interfaces across the thickness of the slice",
        bounds=(1, 32), shown=Shown(1, 15),
    )  # fmt: skip
    lateral_rays: int = parameter(
        0, "Lateral rays", "Traced lines per scan line; 0 chooses enough for the probe's spacing", bounds=(0, 128)
    )
    interface_gain_db: float = parameter(
        44.0, "Interface gain",
        "Level of a flat perpendicular perfect reflector, relative to tissue of unit scatterer variance", unit="dB",
        bounds=(-100, 100),
        note="A border taken from voxels wavers by a fraction of a wavelength and sums to some 20 dB less; the default "
        "makes that look right",
    )  # fmt: skip
    interface_reflection: str = parameter(
        "pressure", "Interface reflection", "pressure: echo ~ |r|, what a wave does; energy: echo ~ r²",
        choices=("pressure", "energy"), source="energy is equation 2 of the paper as printed",
    )  # fmt: skip
    specular_exponent: float = parameter(
        3.0, "Specular exponent", "n in cosⁿ of the angle of incidence: how specular interfaces are", bounds=(0, 100)
    )
    samples_per_cycle: int = parameter(4, "Samples per cycle", "RF samples per cycle of the carrier", bounds=(3, 16))

    @property
    def needs_texture(self) -> bool:
        """Whether scatterers shall know more of the MRI than its labels."""
        return self.partial_volume or self.mri_modulation_db != 0.0


@dataclass(frozen=True)
class DisplaySettings(Declared):
    """What a scanner's console does to the echoes.

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
        0.5, "TGC", "Time-gain compensation: attenuation that is made up for, one way; 0: none", unit="dB/(cm MHz)",
        bounds=(0, 20), shown=Shown(0, 2, 0.01, is_slider=True), option="tgc", fit=Fit(0.0, 1.2, tolerance=0.1),
    )  # fmt: skip
    noise_db: float | None = parameter(
        -80.0, "Noise",
        "Noise of the amplifier before TGC, relative to tissue of unit scatterer variance; -150 in a panel: none",
        unit="dB", bounds=(-300, 100), shown=Shown(-150, 0, is_slider=True, none_at=-150.0), option="noise",
        fit=Fit(-120, -30, tolerance=3.0),
    )  # fmt: skip
    image_size: tuple[int, int] | None = parameter(
        None, "Image size", "Rows and columns of the scan-converted image; none: 512 rows and square pixels",
        unit="pixels", bounds=(8, 8192),
    )  # fmt: skip
