"""Progress bars and messages of commands on stderr; stdout has only the result."""

from __future__ import annotations

import sys
from time import perf_counter
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from typing_extensions import Self

    from SlicerUSSim.Logic.fitting import Progress

#: Seconds until the first line about something slow where there is no terminal
_FIRST_LINE_S = 2.0
_shown: list[_Bar] = []


def note(text: str) -> None:
    """Write a line to stderr, above a progress bar."""
    if _shown:
        _shown[-1].bar.write(text, file=sys.stderr)
    else:
        click.echo(text, err=True)


class _Bar:
    """A progress bar during its `with` block, if stderr is a terminal.

    In a file or a pipe, what takes long is told in a line after 2 s, 4 s, 8 s and so on: eight lines in ten minutes.
    """

    def __init__(self, total: int, name: str = "") -> None:
        from tqdm import tqdm

        self.bar = tqdm(total=total, bar_format="|{bar:24}| {desc}", file=sys.stderr, leave=False, disable=None)
        self.name = name
        self._start, self._next_s = perf_counter(), _FIRST_LINE_S
        self._show(name)

    def _show(self, name: str) -> None:
        """Change the text beside the bar."""
        self.name = name
        self.bar.set_description_str(name, refresh=False)

    def __enter__(self) -> Self:
        if not self.bar.disable:
            _shown.append(self)
        return self

    def __exit__(self, *_: object) -> None:
        if self in _shown:
            _shown.remove(self)
        self.bar.close()

    def _reach(self, share: float) -> None:
        """Show the fraction done, 0 to 1."""
        if not self.bar.disable:
            self.bar.update(int((self.bar.total or 0) * share) - self.bar.n)
            return
        seconds = perf_counter() - self._start
        if seconds >= self._next_s and share < 1.0:
            self._next_s = 2.0 * seconds
            note(f"{self.name}: {share:.0%} done in {seconds:.0f} s")


class Steps(_Bar):
    """A progress bar that is called with the name of each step at its start."""

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self.begun = 0

    def __call__(self, name: str) -> None:
        self._show(name)
        if self.bar.disable:
            note(f"{name} ...")
        else:
            self.bar.update(1 if self.begun else 0)
            self.bar.refresh()
        self.begun += 1


class Share(_Bar):
    """A progress bar that is called with the fraction done, 0 to 1."""

    def __init__(self, name: str) -> None:
        super().__init__(100, name)

    def __call__(self, share: float) -> None:
        self._reach(share)


class Curve(Share):
    """A progress bar of an optimisation, with its stage and the best cost so far."""

    def __call__(self, progress: Progress) -> None:  # type: ignore[override]
        self._show(progress.in_words())
        self._reach(progress.share)
