"""show_log: the package's log on stderr while a command runs, in lines of the form `ussim: LEVEL: MESSAGE`."""

from __future__ import annotations

import logging

import click

from SlicerUSSim.Command.progress import note

#: Level by the number of --verbose options
_LEVELS = (logging.WARNING, logging.INFO, logging.DEBUG)


class _Handler(logging.Handler):
    """Writes to the current stderr, above a progress bar."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            note(f"ussim: {record.levelname.lower()}: {self.format(record)}")
        except Exception:
            self.handleError(record)


def show_log(ctx: click.Context, verbosity: int) -> None:
    """Show the package's warnings until `ctx` ends; with `verbosity` 1 also INFO, with 2 also DEBUG.

    Of other packages, only errors without another handler are shown.
    """
    ours, last = logging.getLogger("SlicerUSSim"), logging.lastResort
    handler = _Handler()
    before = ours.level, ours.propagate, None if last is None else last.level
    ours.addHandler(handler)
    ours.setLevel(_LEVELS[min(verbosity, len(_LEVELS) - 1)])
    ours.propagate = False  # a library that adds a handler to the root logger would duplicate each line
    if last is not None:
        last.setLevel(logging.ERROR)

    def restore() -> None:
        ours.removeHandler(handler)
        ours.setLevel(before[0])
        ours.propagate = before[1]
        if last is not None and before[2] is not None:
            last.setLevel(before[2])

    ctx.find_root().call_on_close(restore)
