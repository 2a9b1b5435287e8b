"""Timing of a function: best and median of several calls."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from time import perf_counter


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
