"""SimulationError, the exception for users of this package, and messages for users."""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

_T = TypeVar("_T")


class SimulationError(Exception):
    """An error that the caller caused and can correct.

    The message is one line; it names the value, what was expected and, where that is not obvious, what to do.
    The command line prints it and exits with status 2; the Slicer panel shows it in one message box.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic import SimulationError, Volume
    >>> try:
    ...     Volume(np.zeros((20, 30)), np.eye(4))
    ... except SimulationError as error:
    ...     print(error)
    volume has 2 dimensions (20, 30), expected 3
    """


def either(names: Sequence[str]) -> str:
    """Names as a choice in a message: "a", "a or b", "a, b or c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"


class Cancelled(SimulationError):  # noqa: N818, not an error: the user wanted it
    """Raised by a progress function to cancel the computation; nothing is changed or written."""

    def __init__(self) -> None:
        super().__init__("cancelled")


def require(condition: object, message: str) -> None:
    """Raise SimulationError(message) unless `condition` is true."""
    if not condition:
        raise SimulationError(message)


def require_kind(name: str, value: object, kind: type, hint: str = "") -> None:
    """Raise SimulationError unless `value`, called `name` in the message, is a `kind`; `hint` is how one is made."""
    article = "an" if kind.__name__[0] in "AEIO" else "a"
    require(
        isinstance(value, kind),
        f"{name} is {_type_of(value)}, expected {article} {kind.__name__}" + (f" ({hint})" if hint else ""),
    )


def require_path(path: object) -> None:
    """Raise SimulationError unless `path` is text or a path."""
    require(
        isinstance(path, str | os.PathLike),
        f"the file is {_type_of(path)}, expected its name: text or a Path",
    )


def _type_of(value: object) -> str:
    return "None" if value is None else f"a {type(value).__name__}"


def require_package(module: str, distribution: str, purpose: str) -> None:
    """Raise SimulationError if `module` is missing; the message names the pip `distribution` to install."""
    if importlib.util.find_spec(module) is None:
        raise SimulationError(f'{purpose} needs {distribution}; install it with: pip install "{distribution}"')


def required(value: _T | None, message: str) -> _T:
    """`value`; raises SimulationError(message) if it is None."""
    if value is None:
        raise SimulationError(message)
    return value


def require_between(owner: str, name: str, value: float, low: float, high: float) -> None:
    """Raise SimulationError unless `value` is a finite number with low <= value <= high."""
    try:
        inside = low <= float(value) <= high  # False for NaN
    except (TypeError, ValueError):
        inside = False
    if not inside:
        raise SimulationError(f"{owner}: {name} is {value!r}, expected a number between {low:g} and {high:g}")


def user_message(error: Exception) -> str | None:
    """One line for the user about an error caused by the user or the computer; None for an internal error."""
    if isinstance(error, SimulationError):
        return str(error)
    if isinstance(error, MemoryError):
        needed = f" ({error})" if str(error) else ""  # numpy says for how many bytes, and of which array
        return f"not enough memory{needed}; use a smaller or coarser volume"
    if type(error).__module__.startswith("pyopencl"):
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        return f"the OpenCL device failed ({reason}); choose another device (`ussim devices` lists them)"
    return None


@contextmanager
def about_file(path: str) -> Iterator[None]:
    """Within the block the message of a SimulationError begins with the file that it is about."""
    try:
        yield
    except (Cancelled, OtherFileError):
        raise
    except SimulationError as error:
        raise SimulationError(f"{path}: {error}") from error


def shown_path(path: object) -> str:
    """A path as text for messages, with bytes escaped that are not text."""
    return str(path).encode("utf-8", "backslashreplace").decode()


class OtherFileError(SimulationError):
    """An error about another file than the one that about_file names; its message says which."""


@contextmanager
def about_other_file(name: str) -> Iterator[None]:
    """Within the block a SimulationError is about another image, whose name its message has, at least in front."""
    try:
        yield
    except Cancelled:
        raise
    except SimulationError as error:
        message = str(error)
        raise OtherFileError(message if name in message else f"{name}: {message}") from error


def is_our_warning(category: type[Warning]) -> bool:
    """Whether a warning is for the user, and not for developers of a library."""
    return category.__module__.startswith("SlicerUSSim")


@contextmanager
def collected_warnings() -> Iterator[list[Warning]]:
    """A list that contains, after the block, the warnings of this package in it; for code that displays them itself."""
    ours: list[Warning] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield ours
    ours += [w.message for w in caught if isinstance(w.message, Warning) and is_our_warning(w.category)]


def warn_again(warning: Warning) -> None:
    """Issue a collected warning."""
    warnings.warn(warning, stacklevel=3)
