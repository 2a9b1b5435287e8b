"""Comparison of two files of `ussim bench --json`: best times, and the speed-up of the second.

    python benchmarks/compare.py before.json after.json

Times of two runs are comparable only if the machine was equally idle; compare the stages' fractions of a frame too.
"""

from __future__ import annotations

import argparse

from SlicerUSSim.Logic.verification.benchmark.files import result_file
from SlicerUSSim.Logic.verification.benchmark.tables import comparison


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
