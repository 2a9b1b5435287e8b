"""Draw: a value of a recipe, fixed or a distribution, within the bounds of the parameter's declaration."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.declaration import Parameter, short
from SlicerUSSim.Logic.base.errors import require

#: {name: what it is given by}
KINDS = {
    "uniform": "[low, high]", "log_uniform": "[low, high] above 0", "normal": "[mean, deviation]",
    "choice": "[value, ...]",
}  # fmt: skip
#: Of the preset's value, for relative numbers
_FACTORS = (0.0, 100.0)


def generator(seed: int, number: int, key: str = "") -> np.random.Generator:
    """That of one parameter of image `number`: no other parameter changes its draws."""
    return np.random.default_rng([seed, number, zlib.crc32(key.encode())])


@dataclass(frozen=True)
class Draw:
    """A fixed value, or a distribution of values of one parameter."""

    entry: Parameter
    #: "fixed" or one of KINDS
    kind: str
    values: tuple
    #: Whether it is a factor of the preset's value
    relative: bool = False

    @classmethod
    def of(cls, value: Any, entry: Parameter, where: str, *, may_be_relative: bool = False) -> Draw:
        """From a recipe's value. Raises SimulationError that begins with `where` for what the parameter refuses."""
        if not isinstance(value, Mapping):
            return cls(entry, "fixed", (entry.checked(where, tuple(value) if isinstance(value, list) else value),))
        given = [name for name in value if name not in ("unit", "relative")]
        wanted = ", ".join(f"{{{name} = {of}}}" for name, of in KINDS.items())
        what = f"{where}: {entry.name} is {short(dict(value))}, expected {entry.expected}, or one of {wanted}"
        require(len(given) == 1 and given[0] in KINDS, what)
        kind, values, unit = given[0], value[given[0]], value.get("unit", entry.unit)
        require(unit == entry.unit, f"{where}: {entry.name} is in {short(unit)}, expected its unit, {entry.unit!r}")
        relative = value.get("relative", False)
        require(
            relative is False or (relative is True and may_be_relative and entry.type is float),
            f"{where}: relative is {short(relative)}, expected true, for numbers of tissues alone",
        )
        numbers = kind != "choice"
        require(
            isinstance(values, list) and values and (len(values) == 2 or not numbers),
            f"{where}: {kind} is {short(values)}, expected {KINDS[kind]}",
        )
        require(
            not numbers or entry.type in (int, float),
            f"{where}: {entry.name} has no {kind} distribution, expected {{choice = [...]}}",
        )
        checking = replace(entry, bounds=_FACTORS) if relative else entry
        if kind == "normal":
            checking.checked(where, values[0])
            deviation = isinstance(values[1], int | float) and not isinstance(values[1], bool) and values[1] >= 0
            require(deviation, f"{where}: the deviation is {short(values[1])}, expected a number from 0 on")
        else:
            values = [checking.checked(where, tuple(one) if isinstance(one, list) else one) for one in values]
        if kind in ("uniform", "log_uniform"):
            require(values[0] <= values[1], f"{where}: {kind} is {short(values)}, expected the lower number first")
            require(kind == "uniform" or values[0] > 0, f"{where}: {kind} is {short(values)}, expected more than 0")
        return cls(entry, kind, tuple(values), relative)

    @property
    def is_fixed(self) -> bool:
        """Whether it is the same for all images."""
        return self.kind == "fixed"

    def __call__(self, random: np.random.Generator) -> Any:
        """A value, or a factor of the preset's."""
        first, last = self.values[0], self.values[-1]
        if self.kind == "fixed":
            return first
        if self.kind == "choice":
            return self.values[int(random.integers(len(self.values)))]
        if self.kind == "uniform":
            found = (
                random.integers(first, last, endpoint=True) if self.entry.type is int else random.uniform(first, last)
            )
        elif self.kind == "log_uniform":
            found = np.exp(random.uniform(np.log(first), np.log(last)))
        else:
            found = random.normal(first, last)
        return self.entry.type(self.cut(found, _FACTORS if self.relative else self.entry.bounds))

    def cut(self, value: float, bounds: tuple[float, float] | None = None) -> float:
        """A number within bounds, by default the declared ones, and whole for whole numbers."""
        bounds = bounds or self.entry.bounds
        found = float(value) if bounds is None else float(np.clip(value, *bounds))
        return round(found) if self.entry.type is int else found
