"""Questions: what the workstation must not decide by itself is asked on the page, and waits for the answer."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Workstation.state import Choice, QuestionState, SharedState
from SlicerUSSim.Workstation.tasks import Tasks


class Questions:
    """Asks one question after the other on all pages; the first answer counts."""

    def __init__(self, shared: SharedState, tasks: Tasks) -> None:
        self._shared, self._tasks = shared, tasks
        #: (question, function that takes the key of a choice, or None if nothing is to be done)
        self._waiting: deque[tuple[QuestionState, Callable[[str | None], None]]] = deque()
        self._number = 0

    def ask(self, title: str, text: str, choices: Sequence[Choice]) -> str:
        """The key of the choice that the user makes; called in a task. Raises Cancelled for none of them."""
        self._number += 1
        question = QuestionState(self._number, title, text, list(choices))

        def asked(answered: Callable[[str | None], None]) -> None:
            self._waiting.append((question, answered))
            self._show()

        key = self._tasks.ask(asked)
        if key is None:
            raise Cancelled
        return key

    def answer(self, number: int, key: str | None) -> None:
        """Called when the user answers question `number`; answers to others, and others than its choices, are late."""
        if self._waiting:
            question, answered = self._waiting[0]
            if number == question.number and key in (None, *(choice.key for choice in question.choices)):
                self._waiting.popleft()
                self._show()
                answered(key)

    def _show(self) -> None:
        """Show the first question that waits, or none."""
        with self._shared.changing() as now:
            now.question = self._waiting[0][0] if self._waiting else QuestionState()
