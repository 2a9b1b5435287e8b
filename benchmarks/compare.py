"""Comparison of two files of `python -m benchmarks.frames --json`: best times, and the speed-up of the second.

    python -m benchmarks.compare before.json after.json

Times of two runs are comparable only if the machine was equally idle; compare the stages' fractions of a frame too.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from benchmarks.frames import rows_of
from benchmarks.measuring import result_file


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


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("before", type=result_file)
    parser.add_argument("after", type=result_file)
    arguments = parser.parse_args()
    if not arguments.before["devices"].keys() & arguments.after["devices"].keys():
        parser.error(
            f"no device in common: {', '.join(arguments.before['devices'])}; {', '.join(arguments.after['devices'])}"
        )
    print(comparison(arguments.before, arguments.after))


if __name__ == "__main__":
    main()
