"""Progress bars on stderr for commands."""

from __future__ import annotations

import sys


class Steps:
    """A progress bar that is told the name of each step."""

    def __init__(self, count: int) -> None:
        from tqdm import tqdm

        self.bar = tqdm(total=count, bar_format="|{bar:24}| {desc}", file=sys.stderr, leave=False, disable=None)
        self.begun = 0

    def __enter__(self):
        return self

    def __call__(self, name: str) -> None:
        self.bar.set_description_str(name, refresh=False)
        self.bar.update(1 if self.begun else 0)
        self.bar.refresh()
        self.begun += 1

    def __exit__(self, *_) -> None:
        self.bar.close()


class Curve(Steps):
    """The same for an optimisation: its stage and the best cost so far."""

    def __init__(self, name: str) -> None:
        super().__init__(100)
        self.bar.set_description_str(name)

    def __call__(self, progress) -> None:
        self.bar.set_description_str(f"{progress.stage}: cost {progress.best_cost:.4f}", refresh=False)
        self.bar.update(int(100 * progress.share) - self.bar.n)


class Share(Steps):
    """The same for a share done between 0 and 1."""

    def __init__(self, name: str) -> None:
        super().__init__(100)
        self.bar.set_description_str(name)

    def __call__(self, share: float) -> None:
        self.bar.update(int(100 * share) - self.bar.n)
