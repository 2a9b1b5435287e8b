"""The measurements as text."""

from __future__ import annotations

from collections.abc import Iterator


def table_of(result: dict) -> str:
    """The whole result of run_benchmark, a table per device."""
    return "\n".join(_lines(result))


def _lines(result: dict) -> Iterator[str]:
    yield f"SlicerUSSim {result.get('version', '')} on {result['machine']['processor']}, {result['mri']}"
    for name, numbers in result["devices"].items():
        yield ""
        yield (
            f"{name}: {numbers['bytes_per_s'] / 1e9:.1f} GB/s, {numbers['operations_per_s'] / 1e9:.0f} Gflop/s measured"
        )
        yield f"  {'':36s}{'best':>10s}{'median':>11s}{'floor':>11s}{'times floor':>13s}"
        for label, row in rows_of(numbers):
            floor = row.get("floor_ms")
            tail = f"{floor:8.2f} ms{row['best_ms'] / max(floor, 1e-9):13.1f}" if floor else ""
            yield f"  {label:36s}{row['best_ms']:7.2f} ms{row['median_ms']:8.2f} ms{tail}"
        for frame, measured in numbers["frames"].items():
            if "same_as_first_device" in measured:
                yield f"  frame {frame}: {measured['same_as_first_device']:.2%} of pixels as on the first device"
    for name, numbers in result.get("numpy", {}).items():
        yield ""
        yield f"{name} in numpy: {numbers['whole_ms']:.0f} ms, {numbers['same']:.2%} of pixels the same"
    for text in result["wrong"]:
        yield f"WRONG: {text}"


def rows_of(numbers: dict) -> Iterator[tuple[str, dict]]:
    """(label, times) of everything measured on one device; stages are indented."""
    for frame, measured in numbers["frames"].items():
        yield f"frame {frame}", measured["whole"]
        for stage, row in measured["stages"].items():
            yield f"  {stage}", row
        yield f"frame {frame}, only the display changed", measured["display changed"]
    for label, row in numbers.items():
        if isinstance(row, dict) and "best_ms" in row:
            yield label, row


def comparison(before: dict, after: dict) -> str:
    """Two results side by side: best times and their ratio. Common devices and rows only."""
    lines = [f"{'':40s}{'before':>12s}{'after':>12s}{'faster':>9s}"]
    for name in before["devices"].keys() & after["devices"].keys():
        lines.append(name)
        new = dict(_named(after["devices"][name]))
        for label, row in _named(before["devices"][name]):
            if label in new:
                ratio = row["best_ms"] / new[label]["best_ms"]
                lines.append(f"  {label:38s}{row['best_ms']:9.2f} ms{new[label]['best_ms']:9.2f} ms{ratio:8.2f}x")
    return "\n".join(lines)


def _named(numbers: dict) -> Iterator[tuple[str, dict]]:
    """rows_of with the frame in front of its stages, so that labels are unique."""
    frame = ""
    for label, row in rows_of(numbers):
        if label.startswith("  "):
            yield f"{frame}: {label.strip()}", row
        else:
            frame = label
            yield label, row
