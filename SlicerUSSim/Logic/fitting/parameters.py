"""Free parameters of an optimisation: names, physical bounds, conversion from numbers to tissues and display.

A name is one of DISPLAY_BOUNDS ("gain_db"), or a tissue with one of TISSUE_BOUNDS ("white matter.mu0") or with
"echogenicity_db". "display" means all of DISPLAY_BOUNDS but those on request (Fit.on_request), of which GROUPS have
names; a tissue's name all of its parameters in TISSUE_BOUNDS, and "tissues" the echogenicity and attenuation of every
tissue with scatterers.

Speckle shows a tissue's Var = p (1 - p) mu0^2 + p sigma0^2 and not mu0, mu1 and sigma0 one by one. Echogenicity,
10 log10 Var, varies with a common factor of mu0 and sigma0, so it replaces three parameters by the one that is seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from math import exp, log, log10
from typing import cast

import numpy as np

from SlicerUSSim.Logic.base.declaration import Fit, Parameter as Declaration, parameters_of
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.reading import PlainValue
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.tissue.names import same_name
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import Tissue

Bounds = tuple[float, float]

#: Declarations of parameters that can be fitted, by name: of the display and of a tissue.
DISPLAY_PARAMETERS = {entry.name: entry for entry in parameters_of(DisplaySettings) if entry.fit is not None}
TISSUE_PARAMETERS = {entry.name: entry for entry in parameters_of(Tissue) if entry.fit is not None}
#: Their default bounds.
DISPLAY_BOUNDS: dict[str, Bounds] = {name: (e.fit.low, e.fit.high) for name, e in DISPLAY_PARAMETERS.items() if e.fit}
TISSUE_BOUNDS: dict[str, Bounds] = {name: (e.fit.low, e.fit.high) for name, e in TISSUE_PARAMETERS.items() if e.fit}
#: The parameters of a tissue's scatterers.
SCATTERING = frozenset(("mu0", "mu1", "sigma0"))
#: All tissues, each by what an image shows of it
TISSUES = "tissues"
#: Groups of parameters of the display that are free on request, and how their names begin
GROUPS = {"smoothing": "smoothing_", "map": "map_", "sliders": "depth_gain_", "line gains": "line_gain_"}
#: Var of a tissue, by a common factor of mu0 and sigma0. The bounds are relative to the table's value: gain changes an
#: image as all levels together do, except at interfaces, and with wide bounds sulci, the brightest, can end up black.
ECHOGENICITY = Declaration(
    name="echogenicity_db", type=float, label="Echogenicity", symbol="Var", unit="dB",
    tip="Level of a tissue's speckle, 10 log10 Var, by a common factor of its mu0 and sigma0",
    fit=Fit(-12.0, 12.0, tolerance=1.5), source="Fit bounds: 12 dB about the tissue table's value",
)  # fmt: skip
ATTENUATION = "attenuation_db_cm_mhz"


def declaration_of(name: str) -> Declaration:
    """The declaration of the parameter of a display or tissue with this full name."""
    tissue, _, attribute = name.rpartition(".")
    if attribute == ECHOGENICITY.name:
        return ECHOGENICITY
    return (TISSUE_PARAMETERS if tissue else DISPLAY_PARAMETERS)[attribute]


@dataclass(frozen=True)
class Parameter:
    """One free parameter. Raises SimulationError for bounds that are not finite or in the wrong order."""

    name: str
    low: float
    high: float

    def __post_init__(self) -> None:
        finite = all(isinstance(value, int | float) and np.isfinite(value) for value in (self.low, self.high))
        require(
            finite and self.low < self.high,
            f"bounds of {self.name} are {self.low!r} to {self.high!r}, expected two numbers, the smaller one first",
        )

    @property
    def tissue(self) -> str | None:
        """Name of its tissue, or None for the display."""
        return self.name.rpartition(".")[0] or None

    @property
    def attribute(self) -> str:
        """Its name in Tissue or DisplaySettings."""
        return self.name.rpartition(".")[2]

    @property
    def declaration(self) -> Declaration:
        """Its declaration, with the default bounds."""
        return declaration_of(self.name)

    @property
    def fit(self) -> Fit:
        """Its declared search range and tolerance."""
        return cast(Fit, self.declaration.fit)

    @property
    def _is_logarithmic(self) -> bool:
        return self.fit.is_logarithmic and self.low > 0.0

    def value(self, unit: float) -> float:
        """The value at `unit` between 0 (low) and 1 (high)."""
        unit = min(max(float(unit), 0.0), 1.0)
        if self._is_logarithmic:
            return min(max(exp(log(self.low) + unit * log(self.high / self.low)), self.low), self.high)
        return self.low + unit * (self.high - self.low)

    def unit(self, value: float) -> float:
        """The inverse of `value`; values outside the bounds are clamped."""
        value = min(max(float(value), self.low), self.high)
        if self._is_logarithmic:
            return log(value / self.low) / log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


class FreeParameters(PlainValue, tuple):
    """The free parameters of one optimisation, in their order."""

    @classmethod
    def of(
        cls, free: Iterable[str] | Mapping[str, Bounds | None], tissues: TissueTable, display: DisplaySettings
    ) -> FreeParameters:
        """From names, or from names with (low, high); None means the default bounds.

        Raises SimulationError for an unknown name, for bounds in the wrong order or beyond the range of a Tissue or
        DisplaySettings, and if there is no parameter.
        """
        entries = dict(free) if isinstance(free, Mapping) else dict.fromkeys([free] if isinstance(free, str) else free)
        parameters: dict[str, Parameter] = {}
        for name, bounds in entries.items():
            for full_name, default in _meant_by(name, tissues):
                low, high = _pair(full_name, bounds) if bounds is not None else default
                parameters[full_name] = Parameter(full_name, low, high)
        for name in parameters:
            tissue, _, attribute = name.rpartition(".")
            same = [other for other in SCATTERING if f"{tissue}.{other}" in parameters]
            require(
                attribute != ECHOGENICITY.name or not same,
                f"{name} is free together with {tissue}.{', .'.join(sorted(same))}, expected one or the other: it "
                "changes them",
            )
        require(bool(parameters), "no free parameter, expected at least one, such as gain_db or white matter.mu0")
        result = cls(parameters.values())
        for corner in (np.zeros(len(result)), np.ones(len(result))):
            result.apply(corner, tissues, display)  # raises SimulationError for values out of range
        return result

    @property
    def names(self) -> list[str]:
        return [parameter.name for parameter in self]

    def varied(self) -> dict[str, set[str]]:
        """{tissue name: its parameters that vary}."""
        varied: dict[str, set[str]] = {}
        for parameter in self:
            if parameter.tissue is not None:
                is_level = parameter.attribute == ECHOGENICITY.name
                varied.setdefault(parameter.tissue, set()).update(
                    ("mu0", "sigma0") if is_level else [parameter.attribute]
                )
        return varied

    def values(self, units: np.ndarray) -> np.ndarray:
        """(parameters,) values at (parameters,) positions between 0 and 1."""
        return np.array([parameter.value(unit) for parameter, unit in zip(self, units, strict=True)])

    def units(self, tissues: TissueTable, display: DisplaySettings) -> np.ndarray:
        """(parameters,) positions of the values in tissues and display, clamped to the bounds."""
        return np.array([p.unit(v) for p, v in zip(self, self.current(tissues, display), strict=True)])

    def current(self, tissues: TissueTable, display: DisplaySettings) -> np.ndarray:
        """(parameters,) values in tissues and display."""
        known = {tissue.name: tissue for tissue in tissues.all_tissues()}
        values = [value_of(p.attribute, known[p.tissue] if p.tissue else display) for p in self]
        # None, as for no noise, is the lowest value.
        return np.array([p.fit.low if value is None else value for p, value in zip(self, values, strict=True)], float)

    def apply(
        self, units: np.ndarray, tissues: TissueTable, display: DisplaySettings
    ) -> tuple[TissueTable, DisplaySettings]:
        """Tissues and display with the free parameters at these positions."""
        changes: dict[str | None, dict[str, float]] = {}
        for parameter, value in zip(self, self.values(units).tolist(), strict=True):
            changes.setdefault(parameter.tissue, {})[parameter.attribute] = value
        display = replace(display, **changes.pop(None, {}))
        for tissue in tissues.all_tissues():
            if tissue.name in changes:
                tissues = tissues.with_tissue(_changed(tissue, changes.pop(tissue.name)))
        return tissues, display


def variance_db(tissue: Tissue) -> float:
    """Echogenicity of developed speckle, 10 log10 Var; -200 dB for a tissue without scatterers."""
    return 10.0 * log10(max(tissue.scatterer_variance, 1e-20))


def value_of(attribute: str, owner: Tissue | DisplaySettings):
    """The value of a parameter in its tissue or in the display."""
    if attribute == ECHOGENICITY.name:
        return variance_db(cast(Tissue, owner))
    return getattr(owner, attribute)


def _changed(tissue: Tissue, values: dict[str, float]) -> Tissue:
    """The tissue with these values of its parameters."""
    level = values.pop(ECHOGENICITY.name, None)
    if level is not None:
        factor = 10.0 ** ((level - variance_db(tissue)) / 20.0)
        values.update(mu0=factor * tissue.mu0, sigma0=factor * tissue.sigma0)
    return replace(tissue, **values)


def all_names(tissues: TissueTable) -> list[str]:
    """All possible free parameters: of the display, then of every tissue with scatterers."""
    attributes = (ECHOGENICITY.name, *TISSUE_BOUNDS)
    return [*DISPLAY_BOUNDS, *(f"{tissue}.{name}" for tissue in _scattering(tissues) for name in attributes)]


def _scattering(tissues: TissueTable) -> list[str]:
    """Names of the tissues with scatterers."""
    return list(dict.fromkeys(t.name for t in tissues.all_tissues() if t.scatterer_variance > 0.0))


def _meant_by(name: str, tissues: TissueTable) -> list[tuple[str, Bounds]]:
    """(full name, default bounds) of every parameter that `name` includes."""
    known = list(dict.fromkeys(tissue.name for tissue in tissues.all_tissues()))
    if name == "display":
        declared = {known: cast(Fit, entry.fit) for known, entry in DISPLAY_PARAMETERS.items() if entry.fit}
        return [(known, DISPLAY_BOUNDS[known]) for known, search in declared.items() if not search.on_request]
    if name in GROUPS:
        return [(known, bounds) for known, bounds in DISPLAY_BOUNDS.items() if known.startswith(GROUPS[name])]
    if name in DISPLAY_BOUNDS:
        return [(name, DISPLAY_BOUNDS[name])]
    if name == TISSUES:
        attributes = ECHOGENICITY.name, ATTENUATION
        return [pair for one in _scattering(tissues) for a in attributes for pair in _meant_by(f"{one}.{a}", tissues)]
    tissue, _, attribute = name.rpartition(".")
    if attribute not in TISSUE_BOUNDS and attribute != ECHOGENICITY.name:
        tissue, attribute = name, ""
    owner = next((entry for entry in known if same_name(entry, tissue)), None)
    if owner is None:
        raise SimulationError(
            f"no free parameter {name!r}, expected display, tissues, {', '.join((*DISPLAY_BOUNDS, *GROUPS))}, or "
            f"a tissue ({', '.join(known)}), alone or with .{', .'.join((ECHOGENICITY.name, *TISSUE_BOUNDS))}"
        )
    if attribute == ECHOGENICITY.name:
        require(
            owner in _scattering(tissues), f"{name} cannot be free: {owner} has no scatterers, expected mu0 or sigma0"
        )
        level, range_db = variance_db(tissues.tissue(owner)), cast(Fit, ECHOGENICITY.fit)
        return [(f"{owner}.{attribute}", (level + range_db.low, level + range_db.high))]
    return [(f"{owner}.{a}", bounds) for a, bounds in TISSUE_BOUNDS.items() if attribute in ("", a)]


def _pair(name: str, bounds) -> Bounds:
    try:
        low, high = bounds
        return float(low), float(high)
    except (TypeError, ValueError):
        raise SimulationError(f"bounds of {name} are {bounds!r}, expected two numbers (low, high)") from None
