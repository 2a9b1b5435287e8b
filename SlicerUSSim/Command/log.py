"""show_log: the package's log on stderr for as long as a command runs, one line `ussim: LEVEL: MESSAGE` each."""

from __future__ import annotations

import logging

import click

from SlicerUSSim.Command.progress import note

#: By how often --verbose was given
_LEVELS = (logging.WARNING, logging.INFO, logging.DEBUG)


class _Handler(logging.Handler):
    """Writes to what stderr is at that moment, above a progress bar."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            note(f"ussim: {record.levelname.lower()}: {self.format(record)}")
        except Exception:
            self.handleError(record)


def show_log(ctx: click.Context, verbosity: int) -> None:
    """Show the package's warnings, with `verbosity` 1 what is chosen too, with 2 times and caches, until `ctx` ends.

    Loggers of other packages are not shown, but for errors that nobody else handles.
    """
    ours, last = logging.getLogger("SlicerUSSim"), logging.lastResort
    handler = _Handler()
    before = ours.level, ours.propagate, None if last is None else last.level
    ours.addHandler(handler)
    ours.setLevel(_LEVELS[min(verbosity, len(_LEVELS) - 1)])
    ours.propagate = False  # a library that gives the root logger a handler would show each line twice
    if last is not None:
        last.setLevel(logging.ERROR)

    def restore() -> None:
        ours.removeHandler(handler)
        ours.setLevel(before[0])
        ours.propagate = before[1]
        if last is not None and before[2] is not None:
            last.setLevel(before[2])

    ctx.find_root().call_on_close(restore)
