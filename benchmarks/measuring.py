"""What the benchmarks share: files as argparse types and times."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from time import perf_counter

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.files import require_place


def output_file(text: str) -> Path:
    """A file name to which the results can be written."""
    path = Path(text)
    try:
        require_place(path)
    except SimulationError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return path


def result_file(text: str) -> dict:
    """The content of a file of `python -m benchmarks.frames --json`."""
    try:
        result = json.loads(Path(text).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"{text}: cannot be read ({error})") from None
    if not isinstance(result, dict) or "devices" not in result:
        raise argparse.ArgumentTypeError(
            f"{text}: has no devices, expected a file of python -m benchmarks.frames --json"
        )
    return result


def summary(milliseconds: Iterable[float]) -> dict[str, float]:
    """{"best_ms", "median_ms"} of some times."""
    times = sorted(milliseconds)
    return {"best_ms": round(times[0], 4), "median_ms": round(times[len(times) // 2], 4)}


def timed(function: Callable[[], object]) -> float:
    """Milliseconds of one call."""
    start = perf_counter()
    function()
    return (perf_counter() - start) * 1e3


def measured(function: Callable[[], object], repeat: int) -> dict[str, float]:
    """Best and median milliseconds of `repeat` calls, after a warm-up call."""
    function()
    return summary(timed(function) for _ in range(repeat))


def resident_mb(process: int | str = "self") -> float:
    """Memory of a process, by its number (Linux)."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
