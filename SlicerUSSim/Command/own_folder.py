"""The folder of a command's results, in which only what the command wrote itself is replaced."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import hash_of_file, make_folder, move_into, partial_folder, read_json, write_json

#: Entry of the summary: {file name: hash, as it was written}
_FILES = "files_sha256"


def require_own_results(folder: Path, names: Iterable[str], summary: str) -> None:
    """Raise SimulationError if one of these files is in the folder and is not as its `summary` says it was written."""
    written = _written(folder, summary)
    for name in (*names, summary):
        path = folder / name
        is_ours = bool(written) if name == summary else path.exists() and written.get(name) == hash_of_file(path)
        require(
            not path.exists() or is_ours,
            f"{path}: exists and is not as this command wrote it, so it is not replaced; choose another folder (--out)",
        )


def _written(folder: Path, summary: str) -> dict[str, str]:
    """{file name: hash} of the files that were written to the folder before."""
    try:
        if (folder / summary).exists():
            return dict(read_json(folder / summary).get(_FILES, {}))
    except (SimulationError, AttributeError, TypeError, ValueError):  # somebody else's file of that name
        pass
    return {}


@contextmanager
def results_of(folder: Path, summary: str) -> Iterator[tuple[Path, dict]]:
    """(a temporary folder for files, the summary to be filled): both are moved to `folder` if the block succeeds.

    So a run that fails or is interrupted changes nothing. The summary also has the hashes of what earlier runs wrote,
    which may be more files. Raises SimulationError if the folder cannot be created or a file cannot be written, naming
    it by its later place.
    """
    is_new = not folder.exists()
    make_folder(folder)
    content: dict = {}
    try:
        with partial_folder(folder, "cannot be written to") as partial:
            try:
                yield partial, content
                files = sorted(file for file in partial.iterdir() if file.name != summary)
                hashes = _written(folder, summary) | {file.name: hash_of_file(file) for file in files}
                write_json(partial / summary, {**content, _FILES: hashes})
            except SimulationError as error:  # the user knows no temporary folder
                raise SimulationError(str(error).replace(str(partial), str(folder))) from None
            move_into(folder, [*files, partial / summary])
    except BaseException:
        if is_new:
            with suppress(OSError):  # not empty
                folder.rmdir()
        raise
