"""Identifiability of parameters from images (docs/optimization.md#identifiability).

Developed speckle determines a tissue's Var = p (1 - p) mu0^2 + p sigma0^2, but not mu0, sigma0 and mu1 separately. Its
level determines the product of Var and gain, its decrease with depth the difference of attenuation and time-gain
compensation (net attenuation), and grey levels all of these relative to the dynamic range. Identifiable combinations
are therefore analysed in addition to the parameters themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import TypeAlias

import numpy as np

from SlicerUSSim.Logic.base.settings import FULL_SCALE_DB, DisplaySettings
from SlicerUSSim.Logic.fitting.parameters import SCATTERING, FreeParameters, value_of, variance_db
from SlicerUSSim.Logic.tissue.table import TissueTable

State: TypeAlias = tuple[TissueTable, DisplaySettings]
#: (parameters,) between 0 and 1 within the bounds
Units: TypeAlias = "Sequence[float] | np.ndarray"


@dataclass(frozen=True)
class Quantity:
    """A parameter or a combination of parameters, as a function of tissues and display."""

    name: str
    unit: str
    #: It counts as determined if the values spread by at most twice this
    tolerance: float
    of: Callable[[TissueTable, DisplaySettings], float]
    #: False: its tissue parameter was not free, only what that is combined with
    is_fitted: bool = True


@dataclass(frozen=True)
class Spread:
    """The values of one quantity over all solutions that fit equally well."""

    name: str
    unit: str
    #: Of the best solution
    value: float
    #: Smallest and largest of the equally good solutions
    low: float
    high: float
    #: Over the best solution and the restarts that fit equally well; NaN if there are none
    mean: float
    standard_deviation: float
    tolerance: float
    #: Whether a search from another starting point reached the same cost; otherwise agreement has no meaning
    was_tested: bool
    #: Whether its tissue parameter was free; otherwise it is as good as the tissue table
    is_fitted: bool = True

    @property
    def is_determined(self) -> bool | None:
        """Whether the equally good solutions agree within the tolerance; None if that is unknown.

        It cannot without another solution, nor of what was not fitted.
        """
        if not self.is_fitted:
            return None
        if self.high - self.low > 2.0 * self.tolerance:
            return False
        return True if self.was_tested else None


@dataclass(frozen=True)
class Identifiability:
    """The spread of every free parameter and of every combination."""

    spreads: tuple[Spread, ...]
    #: Number of equally good solutions, of restarts among them, and of all restarts
    solutions: int
    restarts_as_good: int
    restarts: int
    #: Costs that differ by less are considered equal: other speckle changes the cost by as much
    cost_tolerance: float

    @classmethod
    def of(
        cls,
        quantities: Sequence[Quantity],
        state_of: Callable[[Units], State],
        best: Units,
        as_good: Sequence[Units],
        again: Sequence[Units],
        restarts: int,
        cost_tolerance: float,
    ) -> Identifiability:
        """From the best solution, equally good ones evaluated or sampled, and the results of restarts."""
        at_best = state_of(best)
        met, found = [state_of(units) for units in as_good], [state_of(units) for units in again]
        spreads = []
        for quantity in quantities:
            value = quantity.of(*at_best)
            restarted = np.array([value, *(quantity.of(*state) for state in found)])
            everything = np.array([*restarted, *(quantity.of(*state) for state in met)])
            has_restarts = restarted.size > 1
            spreads.append(
                Spread(
                    quantity.name,
                    quantity.unit,
                    value,
                    float(everything.min()),
                    float(everything.max()),
                    float(restarted.mean()) if has_restarts else float("nan"),
                    float(restarted.std(ddof=1)) if has_restarts else float("nan"),
                    quantity.tolerance,
                    has_restarts,
                    quantity.is_fitted,
                )
            )
        return cls(tuple(spreads), len(met) + len(found), len(found), restarts, cost_tolerance)

    def __getitem__(self, name: str) -> Spread:
        return next(spread for spread in self.spreads if spread.name == name)

    def to_dict(self) -> dict:
        """Plain values for JSON; None where there was no restart."""
        rows = [{**asdict(spread), "is_determined": spread.is_determined} for spread in self.spreads]
        for row in rows:
            row.update({key: None for key, value in row.items() if value != value})
        return {
            "spreads": rows,
            "solutions": self.solutions,
            "restarts_as_good": self.restarts_as_good,
            "restarts": self.restarts,
            "cost_tolerance": self.cost_tolerance,
        }


def equal_variance_draws(
    parameters: FreeParameters, best: np.ndarray, tissues: TissueTable, display: DisplaySettings, random, count: int
) -> list[np.ndarray]:
    """Random mu0, sigma0 and mu1 within the bounds for every tissue, as positions, with Var as at `best`."""
    groups: dict[str, dict[str, int]] = {}
    for place, parameter in enumerate(parameters):
        if parameter.tissue is not None and parameter.attribute in SCATTERING:
            groups.setdefault(parameter.tissue, {})[parameter.attribute] = place
    draws = []
    for name, places in groups.items():
        if len(places) < 2:
            continue
        wanted = variance_db(parameters.apply(best, tissues, display)[0].tissue(name))
        for _ in range(20 * count):
            units = np.array(best)
            units[list(places.values())] = random.random(len(places))
            amplitudes = [place for attribute, place in places.items() if attribute != "mu1"]
            for _ in range(3):  # amplitudes are logarithmic: a common shift is a factor
                tissue = parameters.apply(units, tissues, display)[0].tissue(name)
                factor = 10.0 ** ((wanted - variance_db(tissue)) / 20.0)
                for place in amplitudes:
                    parameter = parameters[place]
                    units[place] = parameter.unit(parameter.value(units[place]) * factor)
            tissue = parameters.apply(units, tissues, display)[0].tissue(name)
            if abs(variance_db(tissue) - wanted) < 0.05:
                draws.append(units)
            if len(draws) >= count:
                break
    return draws[:count]


def quantities_of(parameters: FreeParameters, frequency_mhz: float, tissues: TissueTable) -> list[Quantity]:
    """The free parameters and their identifiable combinations (docs/optimization.md#identifiability)."""
    quantities = [
        Quantity(p.name, p.declaration.unit, p.fit.tolerance, _reader(p.tissue, p.attribute)) for p in parameters
    ]
    varied = parameters.varied()
    brightened = [name for name, names in varied.items() if names & SCATTERING]
    display = {p.attribute for p in parameters if p.tissue is None}
    dampened = [name for name, names in varied.items() if "attenuation_db_cm_mhz" in names]
    own = set(dampened)
    if "tgc_db_cm_mhz" in display:
        dampened += [name for name in _scattering(tissues) if name not in dampened and name in varied]
    for name in dampened:
        quantities.append(
            Quantity(
                f"net attenuation in {name}", "dB/cm", 0.2 * frequency_mhz, _fall(name, frequency_mhz), name in own
            )
        )
    for name in brightened:
        quantities.append(Quantity(f"Var of {name}", "dB", 1.5, _echogenicity(name)))
    for place, name in enumerate(brightened):
        for other in _scattering(tissues):
            if other not in brightened[: place + 1]:
                quantities.append(Quantity(f"Var of {name} re {other}", "dB", 1.5, _relative(name, other)))
    if "gain_db" in display:
        for name in brightened:
            quantities.append(Quantity(f"Var of {name} with gain", "dB", 1.5, _with_gain(name)))
    if display & {"gain_db", "dynamic_range_db"} or brightened:
        for name in brightened or _scattering(tissues)[:2]:
            quantities.append(Quantity(f"grey level of {name} at the face", "of 255", 8.0, _grey_level(name)))
    return quantities


def _scattering(tissues: TissueTable) -> list[str]:
    """Tissues of the labels with scatterers."""
    return list(dict.fromkeys(tissue.name for tissue in tissues.values() if tissue.scatterer_variance > 1e-8))


def _reader(tissue: str | None, attribute: str):
    if tissue is None:
        return lambda tissues, display: value_of(attribute, display)
    return lambda tissues, display: value_of(attribute, tissues.tissue(tissue))


def _fall(name: str, frequency_mhz: float):
    def fall(tissues: TissueTable, display: DisplaySettings) -> float:
        return 2.0 * frequency_mhz * (tissues.tissue(name).attenuation_db_cm_mhz - display.tgc_db_cm_mhz)

    return fall


def _echogenicity(name: str):
    return lambda tissues, display: variance_db(tissues.tissue(name))


def _relative(name: str, other: str):
    return lambda tissues, display: variance_db(tissues.tissue(name)) - variance_db(tissues.tissue(other))


def _with_gain(name: str):
    return lambda tissues, display: variance_db(tissues.tissue(name)) + display.gain_db


def _grey_level(name: str):
    def grey(tissues: TissueTable, display: DisplaySettings) -> float:
        level = variance_db(tissues.tissue(name)) + display.gain_db - FULL_SCALE_DB
        return 255.0 * (1.0 + level / display.dynamic_range_db)

    return grey
