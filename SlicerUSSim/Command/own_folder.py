"""The folder of a command's results, in which only what the command wrote itself is replaced."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import make_folder, read_json, write_json

#: Entry of the summary: {file name: hash, as it was written}
_FILES = "files_sha256"


def require_own_results(folder: Path, names: Iterable[str], summary: str) -> None:
    """Raise SimulationError if one of these files is in the folder and is not as its `summary` says it was written."""
    written: Any = {}
    try:
        if (folder / summary).exists():
            written = read_json(folder / summary).get(_FILES, {})
    except (SimulationError, AttributeError):  # somebody else's file of that name
        pass
    for name in (*names, summary):
        path = folder / name
        is_ours = bool(written) if name == summary else path.exists() and written.get(name) == _hash_of(path)
        require(
            not path.exists() or is_ours,
            f"{path}: exists and is not as this command wrote it, so it is not replaced; choose another folder (--out)",
        )


@contextmanager
def results_of(folder: Path, summary: str) -> Iterator[tuple[Path, dict]]:
    """(a temporary folder for files, the summary to be filled): both are moved to `folder` if the block succeeds.

    So a run that fails or is interrupted changes nothing. Raises SimulationError if the folder cannot be created.
    """
    make_folder(folder)
    content: dict = {}
    with tempfile.TemporaryDirectory(dir=folder, prefix=".results-") as name:
        partial = Path(name)
        yield partial, content
        files = sorted(partial.iterdir())
        write_json(partial / summary, {**content, _FILES: {file.name: _hash_of(file) for file in files}})
        for file in (*files, partial / summary):
            os.replace(file, folder / file.name)


def _hash_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
