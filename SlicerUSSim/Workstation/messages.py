"""Messages: what went wrong, one line each, on every page until the user closes it."""

from __future__ import annotations

import logging

from SlicerUSSim.Logic.base.errors import user_message
from SlicerUSSim.Workstation.state import SharedState

_log = logging.getLogger(__name__)

#: More would cover the page.
_MOST = 5


class Messages:
    """Shows errors."""

    def __init__(self, shared: SharedState) -> None:
        self._shared = shared

    def show(self, message: str) -> None:
        """One line more."""
        _log.warning("%s", message)
        with self._shared.changing() as now:
            now.messages.errors = [*now.messages.errors, message][-_MOST:]

    def dismiss(self, number: int) -> None:
        """The user closed a line."""
        with self._shared.changing() as now:
            now.messages.errors = [message for n, message in enumerate(now.messages.errors) if n != number]

    def failed(self, error: Exception) -> None:
        """Show what nobody caught; a bug of ours is logged with its traceback."""
        message = user_message(error)
        if message is None:
            _log.error("a mistake of the program", exc_info=error)
            message = f"something went wrong ({type(error).__name__}: {error})"
        self.show(message)
