"""Questions: what the workstation must not decide by itself is asked on the page, and waits for the answer."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Workstation.state import Choice, QuestionState, SharedState
from SlicerUSSim.Workstation.tasks import Tasks


@dataclass
class _Question:
    title: str
    text: str
    choices: Sequence[Choice]
    #: Takes the key of a choice, or None if nothing is to be done
    answered: Callable[[str | None], None] = field(repr=False)


class Questions:
    """Asks one question after the other on all pages; the first answer counts."""

    def __init__(self, shared: SharedState, tasks: Tasks) -> None:
        self._shared, self._tasks = shared, tasks
        self._waiting: deque[_Question] = deque()
        self._number = 0

    def ask(self, title: str, text: str, choices: Sequence[Choice]) -> str:
        """The key of the choice that the user makes; called in a task. Raises Cancelled for none of them."""

        def asked(answered: Callable[[str | None], None]) -> None:
            self._waiting.append(_Question(title, text, choices, answered))
            if len(self._waiting) == 1:
                self._show()

        key = self._tasks.ask(asked)
        if key is None:
            raise Cancelled
        return key

    def answer(self, number: int, key: str | None) -> None:
        """Called when the user answers question `number`; answers to others, and others than its choices, are late."""
        if number != self._number or not self._waiting:
            return
        question = self._waiting[0]
        if key is not None and key not in [choice.key for choice in question.choices]:
            return
        self._waiting.popleft()
        self._show()
        question.answered(key)

    def _show(self) -> None:
        """Show the first question that waits, or none."""
        self._number += 1
        first = self._waiting[0] if self._waiting else None
        with self._shared.changing() as now:
            now.question = (
                QuestionState()
                if first is None
                else QuestionState(self._number, first.title, first.text, list(first.choices))
            )
