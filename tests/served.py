"""`ussim serve` as a process for tests of the page: a fork of a process that has imported everything.

Imports are half of the time until a server answers. Tests of the start and the end of the command itself start it anew
(test_workstation_access.py).
"""

from __future__ import annotations

import atexit
import hashlib
import multiprocessing
import os
import pickle
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from click.testing import CliRunner

from SlicerUSSim.Command.cli import main

_METHOD = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
_CONTEXT: Any = multiprocessing.get_context(_METHOD)
_CONTEXT.set_forkserver_preload(["tests.served_imports"])
_segmented: list[tempfile.TemporaryDirectory] = []


class Served:
    """A server with the arguments of `ussim serve`.

    Parameters
    ----------
    state : folder in which it keeps pose and settings.

    Raises AssertionError with what it has said if it does not serve.
    """

    def __init__(self, *arguments: object, state: Path | str) -> None:
        if not _segmented:
            _segmented.append(tempfile.TemporaryDirectory(prefix="ussim-segmented-"))
        self._folder = tempfile.TemporaryDirectory(prefix="ussim-served-")
        self._errors = Path(self._folder.name) / "errors"
        self._errors.touch()
        self._said, out = _CONTEXT.Pipe(duplex=False)
        self.process = _CONTEXT.Process(
            target=_serve,
            args=([*map(str, arguments)], str(state), out, str(self._errors), _segmented[0].name),
            daemon=True,
        )
        self.process.start()
        out.close()
        with os.fdopen(os.dup(self._said.fileno())) as lines:  # the pipe stays: it may say more
            self.url = lines.readline().strip()
        if not self.url.startswith("http"):
            raise AssertionError(self.end())

    @property
    def errors(self) -> str:
        """What it has written to its standard error."""
        return self._errors.read_text()

    @property
    def is_running(self) -> bool:
        return self.process.exitcode is None

    def kill(self) -> None:
        """End it by a signal that it cannot handle."""
        self.process.kill()
        self.process.join()

    def end(self, patience_s: float = 20.0) -> str:
        """End it as at Ctrl-C, or at once if it does not end; returns what it has written to its standard error."""
        if not self._said.closed:
            self.process.terminate()
            self.process.join(patience_s)
            self.kill()
            self._said.close()
            self._text = self.errors
            self._folder.cleanup()
        return self._text


def refused(*arguments: object) -> str:
    """The one line with which `ussim serve` refuses arguments before there is a server; in this process."""
    done = CliRunner().invoke(main, ["serve", *map(str, arguments)])
    assert done.exit_code == 2 and done.stdout == "", done.output
    (line,) = done.stderr.splitlines()
    assert line.startswith("ussim: ")
    return line


def _write_errors_to(path: str) -> None:
    with open(path, "w") as file:
        os.dup2(file.fileno(), 2)
    sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115


def _serve(arguments: list[str], state: str, out: Any, errors: str, segmented: str) -> None:
    """As `python -m SlicerUSSim.Command.cli serve`, in a separate process."""
    os.environ["XDG_STATE_HOME"] = state
    _write_errors_to(errors)
    os.dup2(out.fileno(), 1)
    out.close()
    sys.stdout = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115
    from SlicerUSSim.Logic.mrml import segment_logic

    segment_logic.segment_image = _remembered(segment_logic.segment_image, Path(segmented))
    try:
        main(["serve", *arguments], prog_name="ussim")
    finally:
        atexit._run_exitfuncs()  # which multiprocessing leaves out


def _remembered(segment: Callable[..., Any], folder: Path) -> Callable[..., Any]:
    """`segment`, which reads what any server of this folder has made of the same images and options before."""

    def segment_or_read(mri: Any, *, progress: Callable[[float], None], keep_mask_at: Path | None, **options: Any):
        key = hashlib.sha256(pickle.dumps((mri, sorted(options.items())))).hexdigest()
        file = folder / key
        if file.exists():
            progress(1.0)
            return pickle.loads(file.read_bytes())
        result = segment(mri, progress=progress, keep_mask_at=keep_mask_at, **options)
        if keep_mask_at is None or not keep_mask_at.exists():  # it wrote no file
            written = file.with_name(f"{key}.{os.getpid()}")
            written.write_bytes(pickle.dumps(result))
            written.replace(file)
        return result

    return segment_or_read
