"""Tissue and Membrane: what a tissue is to ultrasound.

Six parameters make a tissue (docs/physics.md#5-scatterers): speed of sound, impedance, attenuation, and the
scatterers' mu0, mu1 and sigma0. A scatterer exists where T1 >= mu1 and has amplitude mu0 + sigma0 T0, with T0, T1 ~
N(0, 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import NormalDist

from SlicerUSSim.Logic.base.errors import require, require_between


@dataclass(frozen=True)
class Tissue:
    """One tissue. Raises SimulationError, naming the tissue and the value, for anything out of physical range.

    >>> from SlicerUSSim.Logic import Tissue
    >>> tumour = Tissue("tumour", 1550.0, 1.62, 0.6, mu0=0.4, sigma0=0.2)
    >>> round(tumour.scatterer_variance, 3)
    0.06
    """

    name: str
    #: c [m/s]
    speed_of_sound_m_s: float
    #: Z [MRayl]
    impedance_mrayl: float
    #: alpha [dB/(cm MHz)], one way
    attenuation_db_cm_mhz: float
    #: Mean scatterer amplitude
    mu0: float = 0.0
    #: Existence threshold; the share of lattice sites that hold a scatterer is 1 - Phi(mu1)
    mu1: float = 0.0
    #: Standard deviation of the scatterer amplitude
    sigma0: float = 0.0
    #: Where the numbers come from, per parameter
    sources: Mapping[str, str] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        owner = f"tissue {self.name!r}"
        require(isinstance(self.name, str) and bool(self.name.strip()), f"tissue name is {self.name!r}, expected text")
        require_between(owner, "speed_of_sound_m_s", self.speed_of_sound_m_s, 100, 10000)
        require_between(owner, "impedance_mrayl", self.impedance_mrayl, 1e-5, 100)
        require_between(owner, "attenuation_db_cm_mhz", self.attenuation_db_cm_mhz, 0, 100)
        require_between(owner, "mu0", self.mu0, -100, 100)
        require_between(owner, "mu1", self.mu1, -10, 10)
        require_between(owner, "sigma0", self.sigma0, 0, 100)

    @property
    def scatterer_share(self) -> float:
        """p = 1 - Phi(mu1): the share of lattice sites that hold a scatterer."""
        return 1.0 - NormalDist().cdf(self.mu1)

    @property
    def scatterer_variance(self) -> float:
        """Var = p (1 - p) mu0^2 + p sigma0^2, which alone sets the echogenicity of developed speckle."""
        p = self.scatterer_share
        return p * (1.0 - p) * self.mu0**2 + p * self.sigma0**2


@dataclass(frozen=True)
class Membrane:
    """A thin scattering layer along the border between fluid and brain: leptomeninges outside, ependyma inside.

    An MRI shows it as partial volume at best, so the label map cannot hold it; the simulator finds it from the labels,
    at sub-voxel thickness.
    """

    tissue: Tissue
    #: Thickness of the layer, centred on the border
    thickness_mm: float = 1.0
    #: Names of the tissues on its fluid side; thin sulci, whose two sides meet, count as one sheet
    fluids: tuple[str, ...] = ("csf", "coupling", "leptomeninges")

    def __post_init__(self) -> None:
        require_between("membrane", "thickness_mm", self.thickness_mm, 0, 10)
        object.__setattr__(self, "fluids", tuple(self.fluids))
