"""Progress bars and messages of commands on stderr; stdout has only the result."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from typing_extensions import Self

    from SlicerUSSim.Logic.fitting import Progress
    from SlicerUSSim.Logic.mri.brain import BrainMask


def note(text: str) -> None:
    """Write a line to stderr, above a progress bar."""
    if "tqdm" in sys.modules:
        from tqdm import tqdm

        tqdm.write(text, file=sys.stderr)
    else:
        click.echo(text, err=True)


def note_brain(brain: BrainMask) -> None:
    """Write to stderr how the brain was found in an MRI, and what to check."""
    note(brain.message)
    for warning in brain.warnings:
        note(f"check: {warning}")


class _Bar:
    """A progress bar that is shown during its `with` block if stderr is a terminal."""

    def __init__(self, total: int, name: str = "") -> None:
        from tqdm import tqdm

        self.bar = tqdm(total=total, bar_format="|{bar:24}| {desc}", file=sys.stderr, leave=False, disable=None)
        self.bar.set_description_str(name)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.bar.close()

    def _reach(self, share: float) -> None:
        """Show the fraction done, 0 to 1."""
        self.bar.update(int((self.bar.total or 0) * share) - self.bar.n)


class Steps(_Bar):
    """A progress bar that is called with the name of each step at its start."""

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self.begun = 0

    def __call__(self, name: str) -> None:
        self.bar.set_description_str(name, refresh=False)
        self.bar.update(1 if self.begun else 0)
        self.bar.refresh()
        self.begun += 1


class Share(_Bar):
    """A progress bar that is called with the fraction done, 0 to 1."""

    def __init__(self, name: str) -> None:
        super().__init__(100, name)

    def __call__(self, share: float) -> None:
        self._reach(share)


class Curve(_Bar):
    """A progress bar of an optimisation, with its stage and the best cost so far."""

    def __init__(self, name: str) -> None:
        super().__init__(100, name)

    def __call__(self, progress: Progress) -> None:
        self.bar.set_description_str(f"{progress.stage}: cost {progress.best_cost:.4f}", refresh=False)
        self._reach(progress.share)
