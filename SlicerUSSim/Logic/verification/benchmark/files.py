"""Files of benchmark scripts as argparse types, checked before the measurements."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

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
    """The content of a file of `ussim bench --json`."""
    try:
        result = json.loads(Path(text).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"{text}: cannot be read ({error})") from None
    if not isinstance(result, dict) or "devices" not in result:
        raise argparse.ArgumentTypeError(f"{text}: has no devices, expected a file of ussim bench --json")
    return result
