"""One declaration per parameter: parameter() describes it completely at the field of its dataclass.

The checks, JSON, the command's options, the fields of panel and page, the values saved in a scene, the optimiser's
bounds, the report and docs/parameters.md are derived from it. Types are checked strictly (msgspec): true and "5" are
not accepted as numbers, nor 3.0 as a whole number, nor NaN.

    @dataclass(frozen=True)
    class DisplaySettings(Declared):
        gain_db: float = parameter(0.0, "Gain", "Brightness of all echoes", unit="dB", bounds=(-200, 200))
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cache, cached_property
from math import log10
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from SlicerUSSim.Logic.base.errors import SimulationError, require

_T = TypeVar("_T")

#: Larger than any parameter, and longer than any
_HUGE, _LONGEST_ARRAY = 10**300, 64


@dataclass(frozen=True)
class Shown:
    """The range of a number in a panel, in the unit in which it is shown."""

    low: float
    high: float
    step: float = 1.0
    #: Whether there is a slider next to the number
    is_slider: bool = False
    #: Numbers up to this one mean None
    none_at: float | None = None

    @property
    def decimals(self) -> int:
        """Number of decimals for the step."""
        return max(0, -int(log10(self.step) // 1))

    def number(self, value: float | None) -> float | None:
        """The number shown for a value, in its unit."""
        return self.none_at if value is None else value

    def value(self, number: float) -> float | None:
        """The value of an entered number."""
        if self.none_at is not None and number <= self.none_at:
            return None
        return number


@dataclass(frozen=True)
class Fit:
    """Search range and tolerance of a parameter in fits."""

    #: Default bounds of the search
    low: float
    high: float
    #: The parameter counts as determined if equally good fits spread by at most twice this
    tolerance: float
    #: Whether the search uses its logarithm, as for amplitudes
    is_logarithmic: bool = False
    #: Whether it is free only by its own name, and not with the others of its owner
    on_request: bool = False


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """The declaration of a parameter."""

    #: Name of the field, and its type without None
    name: str = ""
    type: Any = None
    default: Any = None
    #: Whether a value is required
    is_required: bool = False
    #: Whether None is allowed, by its type or because the owner replaces it
    can_be_none: bool = False
    #: Name for users
    label: str
    #: One sentence without a full stop, for tool tips, --help and the documentation
    tip: str
    unit: str = ""
    #: Symbol in formulas
    symbol: str = ""
    #: Smallest and largest value; of each element of a tuple
    bounds: tuple[float, float] | None = None
    #: Allowed values of a text
    choices: tuple[str, ...] = ()
    #: Further explanation, and the source of the default or bounds
    note: str = ""
    source: str = ""
    #: None: not in panels. True: shown without a range, as tick boxes and choices are
    shown: Shown | bool | None = None
    #: None: not fitted
    fit: Fit | None = None
    #: Name of the command's option, such as "gain" or "thin-sulci/no-thin-sulci"; None: no option
    option: str | None = None

    @property
    def full_label(self) -> str:
        """The label with the unit."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    @property
    def expected(self) -> str:
        """Description of the accepted values."""
        kind = get_origin(self.type) or self.type
        if self.choices:
            words = f"one of {', '.join(self.choices)}"
        elif kind is bool:
            words = "true or false"
        elif kind in (int, float):
            words = "a whole number" if kind is int else "a number"
            words += "" if self.bounds is None else f" between {self.bounds[0]:.10g} and {self.bounds[1]:.10g}"
        elif kind is tuple and self.bounds is not None:
            elements = get_args(self.type)
            numbers = "numbers" if float in elements else "whole numbers"
            words = f"{len(elements)} {numbers} between {self.bounds[0]:g} and {self.bounds[1]:g}"
        elif kind is tuple:
            words = "a list of texts"
        else:
            words = "text" if kind is str else "an object of texts"
        return words + (" or none" if self.can_be_none else "")

    @cached_property
    def _accepted(self) -> Any:
        """The type as msgspec checks it."""
        if self.choices:
            return Literal[self.choices]
        if self.bounds is None:
            return self.type
        meta = msgspec.Meta(ge=self.bounds[0], le=self.bounds[1])
        if get_origin(self.type) is tuple:
            return tuple[tuple(Annotated[kind, meta] for kind in get_args(self.type))]
        return Annotated[self.type, meta]

    def checked(self, owner: str, value: Any) -> Any:
        """The value in its type; a float may be given as a whole number. Raises SimulationError for other values.

        Numpy scalars are accepted as Python numbers.
        """
        if value is None and self.can_be_none:
            return None
        plain = _plain(value)
        # msgspec before 0.22 fails for whole numbers beyond the range of a float.
        if not (isinstance(plain, int) and abs(plain) > _HUGE):
            with suppress(msgspec.ValidationError, UnicodeEncodeError):  # a text of a command line may be no Unicode
                return msgspec.convert(plain, self._accepted, strict=True)
        raise SimulationError(f"{owner}: {self.name} is {short(value)}, expected {self.expected}")

    def to_text(self, value: Any) -> str:
        """The text of a value; from_text is the inverse."""
        return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)

    def from_text(self, owner: str, text: str) -> Any:
        """The value of a text, in the format of the command and of scenes. Raises SimulationError for other texts."""
        kind = get_origin(self.type) or self.type
        value: Any = text
        if self.can_be_none and text.lower() == "none":
            value = None
        elif kind is bool:
            value = {"true": True, "false": False}.get(text.lower(), text)
        elif kind in (int, float):
            value = _number(kind, text)
        elif kind is tuple:
            value = tuple(_number(get_args(self.type)[0], part.strip()) for part in text.split(",") if part.strip())
        return self.checked(owner, value)


def parameter(
    default: Any = MISSING,
    label: str = "",
    tip: str = "",
    *,
    compare: bool = True,
    default_factory: Any = MISSING,
    kw_only: bool = False,
    **more: Any,
) -> Any:
    """A field of a dataclass, with its declaration as a Parameter."""
    metadata = {"parameter": Parameter(label=label, tip=tip, **more)}
    if default_factory is not MISSING:
        return field(default_factory=default_factory, compare=compare, metadata=metadata)
    return field(default=default, compare=compare, kw_only=kw_only or MISSING, metadata=metadata)


@cache
def parameters_of(kind: type) -> tuple[Parameter, ...]:
    """The declared parameters of a dataclass, in the order of its fields.

    Raises TypeError that names the field for a declaration that cannot be checked.
    """
    hints = get_type_hints(kind)
    found = []
    for entry in fields(kind):
        if "parameter" in entry.metadata:
            hint, can_be_none = _without_none(hints[entry.name])
            _check_declaration(f"{kind.__name__}.{entry.name}", hint, entry.metadata["parameter"])
            found.append(
                replace(
                    entry.metadata["parameter"],
                    name=entry.name,
                    type=hint,
                    default=None if entry.default is MISSING else entry.default,
                    is_required=entry.default is MISSING and entry.default_factory is MISSING,
                    can_be_none=can_be_none or entry.metadata["parameter"].can_be_none,
                )
            )
    return tuple(found)


def parameter_of(kind: type, name: str) -> Parameter:
    """A declared parameter by name. Raises SimulationError that lists the names for an unknown one."""
    known = {entry.name: entry for entry in parameters_of(kind)}
    require(name in known, f"{kind.__name__} has no {name!r}, expected one of {', '.join(known)}")
    return known[name]


class Declared:
    """Base of frozen dataclasses whose fields are declared with parameter() and checked on construction.

    Raises SimulationError that names the value and what is expected.
    """

    def __post_init__(self) -> None:
        owner = self._owner()
        for entry in parameters_of(type(self)):
            object.__setattr__(self, entry.name, entry.checked(owner, getattr(self, entry.name)))

    def _owner(self) -> str:
        """Name of the object in messages."""
        return type(self).__name__


def built(kind: type[_T], values: Any, source: str) -> _T:
    """A `kind` from plain values, such as those of a JSON file.

    Raises SimulationError that names `source` and the parameter if `values` is not an object, if a name is unknown or
    missing, or if a value is invalid.
    """
    require(isinstance(values, Mapping), f"{source}: is {kind_of(values)}, expected an object")
    known = [entry.name for entry in fields(kind)]  # type: ignore[arg-type], of dataclasses
    for name in values:
        require(name in known, f"{source}: {short(name)} is unknown, expected one of {', '.join(known)}")
    missing = [
        entry.name
        for entry in fields(kind)  # type: ignore[arg-type]
        if entry.default is MISSING and entry.default_factory is MISSING and entry.name not in values
    ]
    require(not missing, f"{source}: lacks {', '.join(missing)}")
    for entry in parameters_of(kind):
        if entry.name in values:
            entry.checked(source, values[entry.name])
    try:
        return kind(**values)
    except SimulationError as error:
        raise SimulationError(f"{source}: {error}") from None


def _check_declaration(where: str, hint: Any, declared: Parameter) -> None:
    elements = get_args(hint) if get_origin(hint) is tuple else (hint,)
    are_numbers = all(element in (int, float) for element in elements)
    is_mapping = get_origin(hint) in (dict, Mapping)
    plain = all(element in (bool, int, float, str) for element in elements if element is not Ellipsis)
    if not (plain or is_mapping):
        raise TypeError(f"{where}: the type is {hint}, expected bool, int, float, str, a tuple of one or a mapping")
    if declared.bounds is not None and not (are_numbers and declared.bounds[0] <= declared.bounds[1]):
        raise TypeError(f"{where}: bounds are {declared.bounds} for {hint}, expected (low, high) of numbers")
    if declared.choices and hint is not str:
        raise TypeError(f"{where}: has choices, expected the type str for them, not {hint}")
    if declared.fit is not None and hint is not float:
        raise TypeError(f"{where}: has a fit, expected the type float for it, not {hint}")


def _without_none(hint: Any) -> tuple[Any, bool]:
    if get_origin(hint) in (Union, UnionType) and NoneType in get_args(hint):
        (only,) = (kind for kind in get_args(hint) if kind is not NoneType)
        return only, True
    return hint, False


def _number(kind: type, text: str) -> Any:
    """The number in a text; other texts are returned unchanged, to be checked later."""
    # Python accepts underscores and the digits of all scripts in numbers, other programs do not.
    if kind in (int, float) and text.isascii() and "_" not in text:
        with suppress(ValueError):
            return kind(text)
    return text


def kind_of(value: Any) -> str:
    """The kind of a JSON value, in words."""
    kinds = {list: "a list", str: "a text", bool: "true or false", NoneType: "null"}
    return next((words for kind, words in kinds.items() if isinstance(value, kind)), "a number")


def _plain(value: Any) -> Any:
    """Numpy scalars and short arrays as Python values, also in lists and tuples."""
    if isinstance(value, list | tuple):
        return (tuple if isinstance(value, tuple) else list)(map(_plain, value))
    is_short_array = hasattr(value, "ndim") and hasattr(value, "tolist") and value.size <= _LONGEST_ARRAY
    return value.tolist() if is_short_array else value


def short(value: Any) -> str:
    """A value for messages: one short line."""
    try:
        text = " ".join(repr(_plain(value)).splitlines())
    except ValueError:  # 4300 digits or more
        text = "a huge number"
    return text if len(text) <= 80 else f"{text[:77]}..."
