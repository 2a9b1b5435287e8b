"""Draw: a value of a recipe, fixed or a distribution, within the bounds of the parameter's declaration."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.declaration import Parameter, short
from SlicerUSSim.Logic.base.errors import require

#: {name: what it is given by}; all but the last are of numbers
KINDS = {
    "uniform": "[low, high]", "log_uniform": "[low, high] above 0", "normal": "[mean, deviation]",
    "choice": "[value, ...]",
}  # fmt: skip


def generator(seed: int, number: int, key: str) -> np.random.Generator:
    """That of one parameter of image `number`: no other parameter changes its draws."""
    return np.random.default_rng([seed, number, zlib.crc32(key.encode())])


@dataclass(frozen=True)
class Draw:
    """A distribution of the values of one parameter; a fixed value is a choice of one."""

    entry: Parameter
    values: tuple
    #: One of KINDS
    kind: str = "choice"
    #: Whether the values are factors of the preset's
    relative: bool = False

    @classmethod
    def of(cls, value: Any, entry: Parameter, where: str, *, may_be_relative: bool = False) -> Draw:
        """From a recipe's value. Raises SimulationError that begins with `where` for what the parameter refuses."""
        if not isinstance(value, Mapping):
            return cls(entry, (entry.checked(where, value),))
        kinds = KINDS if entry.type in (int, float) else {"choice": KINDS["choice"]}
        kind = next((name for name in value if name in kinds), "")
        values: Any = value.get(kind)
        unit, relative = value.get("unit", entry.unit), bool(value.get("relative", False))
        known = {kind, "unit", "relative"} if may_be_relative else {kind, "unit"}
        is_known = set(value) <= known and isinstance(values, list) and bool(values)
        wanted = " or ".join(f"{{{name} = {of}}}" for name, of in kinds.items())
        require(
            is_known and (kind == "choice" or len(values) == 2),
            f"{where}: {entry.name} is {short(dict(value))}, expected {entry.expected}, or {wanted}",
        )
        require(unit == entry.unit, f"{where}: {entry.name} is in {short(unit)}, expected its unit, {entry.unit!r}")
        each = [replace(entry, bounds=(0.0, 100.0)) if relative else entry] * len(values)
        if kind == "normal":
            each[1] = replace(entry, name="the deviation", type=float, bounds=(0.0, 1e9))
        values = tuple(one.checked(where, number) for one, number in zip(each, values, strict=True))
        is_ordered = "uniform" not in kind or (values[0] <= values[1] and (kind == "uniform" or values[0] > 0))
        require(is_ordered, f"{where}: {kind} is {short(list(values))}, expected {KINDS[kind]}")
        return cls(entry, values, kind, relative)

    @property
    def is_fixed(self) -> bool:
        """Whether it is the same for all images."""
        return self.kind == "choice" and len(self.values) == 1 and not self.relative

    def __call__(self, random: np.random.Generator, preset: float = 1.0) -> Any:
        """A value; of a relative one, so many times the preset's. Numbers are cut off at the declared bounds."""
        first, last = self.values[0], self.values[-1]
        if self.kind == "choice":
            found = self.values[int(random.integers(len(self.values)))]
        elif self.kind == "uniform":
            is_whole = self.entry.type is int
            found = random.integers(first, last, endpoint=True) if is_whole else random.uniform(first, last)
        elif self.kind == "log_uniform":
            found = np.exp(random.uniform(np.log(first), np.log(last)))
        else:
            found = random.normal(first, last)
        if self.entry.type not in (int, float):
            return found
        found = np.clip(found * preset if self.relative else found, *(self.entry.bounds or (-np.inf, np.inf)))
        return round(float(found)) if self.entry.type is int else float(found)
