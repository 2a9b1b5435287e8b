"""Progress bars and messages of commands on stderr; stdout has only the result."""

from __future__ import annotations

import sys
from time import perf_counter
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from typing_extensions import Self

    from SlicerUSSim.Logic.datasets import Made
    from SlicerUSSim.Logic.fitting import Progress

#: Seconds until the first line about something slow where there is no terminal
_FIRST_LINE_S = 2.0
_shown: list[Share] = []


def note(text: str) -> None:
    """Write a line to stderr, above a progress bar."""
    if _shown:
        _shown[-1].bar.write(text, file=sys.stderr)
    else:
        click.echo(text, err=True)


class Share:
    """A progress bar during its `with` block, if stderr is a terminal. It is called with the fraction done, 0 to 1.

    In a file or a pipe, long work writes a line after 2 s, 4 s, 8 s and so on: eight lines in ten minutes.
    """

    def __init__(self, name: str) -> None:
        from tqdm import tqdm

        self.bar = tqdm(total=100, bar_format="|{bar:24}| {desc}", file=sys.stderr, leave=False, disable=None)
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

    def __call__(self, share: float) -> None:
        if not self.bar.disable:
            self.bar.update(int(100 * share) - self.bar.n)
            return
        seconds = perf_counter() - self._start
        if seconds >= self._next_s and share < 1.0:
            self._next_s = 2.0 * seconds
            note(f"{self.name}: {share:.0%} done in {seconds:.0f} s")


class Curve(Share):
    """A progress bar of an optimisation or of a data set, with what it says of itself."""

    def __call__(self, progress: Progress | Made) -> None:  # type: ignore[override]
        self._show(progress.in_words())
        super().__call__(progress.share)
