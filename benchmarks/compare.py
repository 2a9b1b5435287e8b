"""Two files of `ussim bench --json` side by side: best times, and how many times faster the second is.

    python benchmarks/compare.py before.json after.json

Times of two runs are as comparable as the machine was idle; compare stages by their share of a frame, too.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from SlicerUSSim.Logic.benchmark.tables import comparison


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    arguments = parser.parse_args()
    print(comparison(*(json.loads(path.read_text()) for path in (arguments.before, arguments.after))))


if __name__ == "__main__":
    main()
