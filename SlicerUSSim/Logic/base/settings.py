"""Settings of the simulation and of the display: frozen, checked on construction, plain values in and out."""

from __future__ import annotations

from dataclasses import dataclass

from SlicerUSSim.Logic.base.errors import require, require_between

#: Level of full white at 0 dB gain, in dB re the mean square echo of tissue with unit scatterer variance.
FULL_SCALE_DB = 23.0


@dataclass(frozen=True)
class SimulationSettings:
    """What the physics needs beside tissues, probe and pose.

    >>> from SlicerUSSim.Logic import SimulationSettings
    >>> SimulationSettings(seed=7, reflections=False).max_ray_depth
    6
    """

    #: Which patient's speckle, and which amplifier noise
    seed: int = 0
    #: Reflections along one path at most. Refracted children continue at their parent's depth, so that crossing many
    #: weak borders does not end a ray.
    max_ray_depth: int = 6
    #: A ray ends when its two-way amplitude, attenuation included, falls below this (-120 dB)
    intensity_threshold: float = 1e-6
    #: A reflected child is followed if its weight, attenuation aside, is at least this (-34 dB)
    reflection_threshold: float = 2e-2
    #: Convex surfaces spread what they reflect, so that a bone's or a wire's shadow is not filled by what it mirrors
    #: (False is the paper)
    reflection_spreading: bool = True
    #: What the scanner takes for the speed of sound
    reference_speed_m_s: float = 1540.0
    #: Follow reflected children at all
    reflections: bool = True
    #: Speckle
    scattering: bool = True
    #: Echoes of tissue interfaces
    interfaces: bool = True
    #: Sites of the scatterer lattice per cubic millimetre (a cell of 0.29 mm). At the tightest focus of a 5 MHz probe
    #: ten of them fill the resolution cell and the envelope's mean / deviation is 1.87 instead of 1.91; 100 give 1.90
    #: and take twice the time. The paper's Rayleigh test has a lattice of 20 um: 125000, of which mu1 keeps 1 %
    scatterers_per_mm3: float = 42.0
    #: Scatterers take their tissue by the probabilities of the segmentation instead of its labels (needs a Texture; off
    #: is the paper)
    partial_volume: bool = False
    #: How far scatterers' amplitudes follow the MRI inside a tissue, in dB per standard deviation of its intensity
    #: (needs a Texture; negative where bright means echo-poor; 0 is the paper)
    mri_modulation_db: float = 0.0
    #: Where the beam profile is cut off, in standard deviations; what lies beyond has 0.15 % of its power
    beam_cutoff: float = 2.25
    #: Rays per scan line that sample interfaces across the elevational beam
    elevational_rays: int = 7
    #: Traced lines per scan line, which sample the beam laterally; 0 chooses enough for the probe's spacing
    lateral_rays: int = 0
    #: Level of a flat perpendicular perfect reflector, in dB re tissue of unit scatterer variance. A border taken from
    #: voxels wavers by a fraction of a wavelength and sums to some 20 dB less; the default makes that look right
    interface_gain_db: float = 44.0
    #: "pressure": echo ~ |r|, what a wave does; "energy": echo ~ r^2, equation 2 of the paper as printed
    interface_reflection: str = "pressure"
    #: n in cos^n of the angle of incidence: how specular interfaces are
    specular_exponent: float = 3.0
    #: RF samples per cycle of the carrier
    samples_per_cycle: int = 4

    @property
    def needs_texture(self) -> bool:
        """Whether scatterers shall know more of the MRI than its labels."""
        return self.partial_volume or self.mri_modulation_db != 0.0

    def __post_init__(self) -> None:
        owner = "SimulationSettings"
        require_between(owner, "seed", self.seed, 0, 2**32 - 1)
        require_between(owner, "max_ray_depth", self.max_ray_depth, 0, 16)
        require_between(owner, "intensity_threshold", self.intensity_threshold, 1e-12, 1)
        require_between(owner, "reflection_threshold", self.reflection_threshold, 1e-9, 1)
        require_between(owner, "reference_speed_m_s", self.reference_speed_m_s, 300, 6000)
        require_between(owner, "scatterers_per_mm3", self.scatterers_per_mm3, 0.1, 200_000)
        require_between(owner, "mri_modulation_db", self.mri_modulation_db, -6, 6)
        require_between(owner, "beam_cutoff", self.beam_cutoff, 0.5, 6)
        require_between(owner, "elevational_rays", self.elevational_rays, 1, 32)
        require_between(owner, "lateral_rays", self.lateral_rays, 0, 128)
        require_between(owner, "interface_gain_db", self.interface_gain_db, -100, 100)
        require_between(owner, "specular_exponent", self.specular_exponent, 0, 100)
        require_between(owner, "samples_per_cycle", self.samples_per_cycle, 3, 16)
        for name in ("seed", "max_ray_depth", "elevational_rays", "lateral_rays", "samples_per_cycle"):
            value = getattr(self, name)
            require(int(value) == value, f"{owner}: {name} is {value!r}, expected a whole number")
        kinds = ("pressure", "energy")
        require(
            self.interface_reflection in kinds,
            f"{owner}: interface_reflection is {self.interface_reflection!r}, expected one of {', '.join(kinds)}",
        )


@dataclass(frozen=True)
class DisplaySettings:
    """What a scanner's console does to the echoes.

    >>> from dataclasses import replace
    >>> from SlicerUSSim.Logic import DisplaySettings
    >>> replace(DisplaySettings(gain_db=3.0), dynamic_range_db=60.0).gain_db
    3.0
    """

    gain_db: float = 0.0
    dynamic_range_db: float = 55.0
    #: Attenuation that time-gain compensation makes up for, one way; 0 switches it off
    tgc_db_cm_mhz: float = 0.5
    #: Amplifier noise before TGC, in dB re tissue of unit scatterer variance; None for none
    noise_db: float | None = -80.0
    #: (rows, columns) of the scan-converted image; None gives 512 rows and square pixels
    image_size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        owner = "DisplaySettings"
        require_between(owner, "gain_db", self.gain_db, -200, 200)
        require_between(owner, "dynamic_range_db", self.dynamic_range_db, 1, 200)
        require_between(owner, "tgc_db_cm_mhz", self.tgc_db_cm_mhz, 0, 20)
        if self.noise_db is not None:
            require_between(owner, "noise_db", self.noise_db, -300, 100)
        if self.image_size is not None:
            require(
                len(tuple(self.image_size)) == 2 and all(int(n) == n for n in self.image_size),
                f"{owner}: image_size is {self.image_size!r}, expected (rows, columns)",
            )
            for name, value in zip(("rows", "columns"), self.image_size, strict=True):
                require_between(owner, f"image_size {name}", value, 8, 8192)
            object.__setattr__(self, "image_size", (int(self.image_size[0]), int(self.image_size[1])))
