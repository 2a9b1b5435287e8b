"""Tissue and Membrane: acoustic parameters.

A tissue has the paper's six parameters (docs/physics.md#5-scatterers): speed of sound, impedance, attenuation, and the
scatterers' mu0, mu1 and sigma0. A scatterer exists where T1 >= mu1 and has amplitude mu0 + sigma0 T0, with T0, T1 ~
N(0, 1). Four more say how its echogenicity varies within it (docs/physics.md#uneven-tissue).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

from SlicerUSSim.Logic.base.declaration import Declared, Fit, parameter, parameters_of, short
from SlicerUSSim.Logic.base.errors import require

_LONGEST_NAME = 200
_ECHOGENICITY = "Fit bounds: some 40 dB of echogenicity"


def _is_line(name: object) -> bool:
    """Whether a name can be shown in messages and files: one line of printable characters, not too long."""
    return isinstance(name, str) and bool(name.strip()) and name.isprintable() and len(name) <= _LONGEST_NAME


@dataclass(frozen=True)
class Tissue(Declared):
    """One tissue. Raises SimulationError, naming the tissue and the value, for anything out of physical range.

    >>> from SlicerUSSim.Logic import Tissue
    >>> tumour = Tissue("tumour", 1550.0, 1.62, 0.6, mu0=0.4, sigma0=0.2)
    >>> round(tumour.scatterer_variance, 3)
    0.06
    """

    name: str = parameter(label="Tissue", tip="Name of the tissue, one line")
    speed_of_sound_m_s: float = parameter(
        label="Speed of sound", tip="Speed of sound", unit="m/s", symbol="c", bounds=(100, 10_000)
    )
    impedance_mrayl: float = parameter(
        label="Impedance", tip="Acoustic impedance", unit="MRayl", symbol="Z", bounds=(1e-5, 100)
    )
    attenuation_db_cm_mhz: float = parameter(
        label="Attenuation", tip="Attenuation, one way", unit="dB/(cm MHz)", symbol="α", bounds=(0, 100),
        fit=Fit(0.1, 1.2, tolerance=0.1), source="Fit bounds: from blood to tendon (Duck 1990)",
    )  # fmt: skip
    mu0: float = parameter(
        0.0, "Mean amplitude", "Mean amplitude of the scatterers", symbol="μ₀", bounds=(-100, 100),
        fit=Fit(0.02, 1.5, tolerance=0.05, is_logarithmic=True), source=_ECHOGENICITY,
    )  # fmt: skip
    mu1: float = parameter(
        0.0, "Threshold", "A fraction 1 - Φ(μ₁) of the sites has a scatterer", symbol="μ₁",
        bounds=(-10, 10), fit=Fit(-1.0, 1.5, tolerance=0.1), source=_ECHOGENICITY,
    )  # fmt: skip
    sigma0: float = parameter(
        0.0, "Deviation", "Standard deviation of the scatterers' amplitude", symbol="σ₀", bounds=(0, 100),
        fit=Fit(0.02, 1.0, tolerance=0.05, is_logarithmic=True), source=_ECHOGENICITY,
    )  # fmt: skip
    texture_db: float = parameter(
        0.0, "Texture", "Standard deviation of the echogenicity within the tissue, of which images show about half",
        unit="dB", symbol="σₜ", bounds=(0, 8), source="0 in the paper",
    )  # fmt: skip
    texture_mm: float = parameter(
        0.5, "Texture length", "Distance at which the echogenicity's correlation is one half, and diameter of specks",
        unit="mm", symbol="ℓₜ", bounds=(0.1, 20),
    )  # fmt: skip
    specks_per_mm3: float = parameter(
        0.0, "Specks", "Bright specks per cubic millimetre, such as small vessels and calcifications", unit="1/mm³",
        symbol="nₛ", bounds=(0, 10),
    )  # fmt: skip
    speck_db: float = parameter(
        0.0, "Speck level", "Level of a speck's centre above its tissue", unit="dB", symbol="Δₛ", bounds=(0, 30)
    )
    sources: Mapping[str, str] = parameter(
        default_factory=dict, label="Sources", tip="Source of each value, by parameter", compare=False
    )

    def __post_init__(self) -> None:
        require(
            _is_line(self.name),
            f"tissue name is {short(self.name)}, expected one line of printable text of at most "
            f"{_LONGEST_NAME} characters",
        )
        super().__post_init__()

    def _owner(self) -> str:
        return f"tissue {self.name!r}"

    @property
    def scatterer_share(self) -> float:
        """p = 1 - Phi(mu1): the fraction of lattice sites with a scatterer."""
        return 1.0 - NormalDist().cdf(self.mu1)

    @property
    def scatterer_variance(self) -> float:
        """Var = p (1 - p) mu0^2 + p sigma0^2, which alone sets the echogenicity of developed speckle."""
        p = self.scatterer_share
        return p * (1.0 - p) * self.mu0**2 + p * self.sigma0**2


@dataclass(frozen=True)
class Membrane(Declared):
    """A thin rough sheet along the border between fluid and brain: leptomeninges outside, ependyma inside.

    It is too thin for the voxels of an MRI and therefore not part of the label map. The simulator derives it from the
    labels, at sub-voxel thickness. A rough sheet takes the coherent part from the echo of the border, and returns the
    rest diffusely, by its scatterers (Ogilvy, Theory of wave scattering from random rough surfaces, 1991, chapter 4).
    """

    tissue: Tissue
    thickness_mm: float = parameter(
        0.4, "Thickness", "Thickness of the layer, centred on the border", unit="mm", bounds=(0, 10)
    )
    fluids: tuple[str, ...] = parameter(
        ("csf", "coupling", "leptomeninges"), "Fluids", "Names of the tissues on the fluid side",
    )  # fmt: skip
    roughness_mm: float = parameter(
        0.03, "Roughness", "RMS height of the sheet: 0 is a mirror; at 5 MHz 0.03 mm lowers the border's echo by 6 dB",
        unit="mm", bounds=(0, 1),
    )  # fmt: skip
    diffuse_db: float = parameter(
        12.0, "Diffuse echo", "Level of its scatterers at normal incidence, relative to those of its tissue",
        unit="dB", bounds=(-100, 40),
    )  # fmt: skip
    sheet_exponent: float | None = parameter(
        None, "Diffuse exponent of sheets", "Exponent for sulci and other sheets; none: as walls",
        bounds=(0, 20), can_be_none=True,
    )  # fmt: skip
    roughness_octaves: float = parameter(
        0.0, "Variation of roughness", "Standard deviation between patches, which breaks lines",
        unit="octaves", bounds=(0, 4),
    )  # fmt: skip
    patch_db: float = parameter(
        0.0, "Variation of the diffuse echo", "Standard deviation between patches, at constant mean",
        unit="dB", bounds=(0, 20),
    )  # fmt: skip
    patch_mm: float = parameter(5.0, "Patches", "Size of the patches along a sheet", unit="mm", bounds=(0.5, 50))
    diffuse_exponent: float = parameter(
        1.5, "Diffuse exponent", "Exponent n of cosⁿ of the angle of incidence: 1 is Lambert's law, 0 equally bright",
        bounds=(0, 20),
    )  # fmt: skip

    def __post_init__(self) -> None:
        require(isinstance(self.tissue, Tissue), f"membrane: tissue is {self.tissue!r:.80}, expected a Tissue")
        super().__post_init__()

    def _owner(self) -> str:
        return "membrane"


#: The numeric parameters, in the order of a tissue table.
TISSUE_PARAMETERS = tuple(entry for entry in parameters_of(Tissue) if entry.type is float)
