"""Messages: errors, one line each, shown on every page until the user closes them."""

from __future__ import annotations

import logging

from SlicerUSSim.Logic.base.errors import user_message
from SlicerUSSim.Workstation.state import SharedState

_log = logging.getLogger(__name__)

#: Number of messages; more would cover the page.
_MOST = 5


class Messages:
    """Shows errors on the pages."""

    def __init__(self, shared: SharedState) -> None:
        self._shared = shared

    def show(self, message: str) -> None:
        """Add a line."""
        _log.warning("%s", message)
        with self._shared.changing() as now:
            now.messages.errors = [*now.messages.errors, message][-_MOST:]

    def clear(self) -> None:
        """Remove all lines, which are about another patient than the one that is opened now."""
        with self._shared.changing() as now:
            now.messages.errors = []

    def dismiss(self, number: int) -> None:
        """Remove a line that the user has closed."""
        with self._shared.changing() as now:
            now.messages.errors = [message for n, message in enumerate(now.messages.errors) if n != number]

    def failed(self, error: Exception) -> None:
        """Show an uncaught exception; an internal error is also logged with its traceback."""
        message = user_message(error)
        if message is None:
            _log.error("a mistake of the program", exc_info=error)
            message = f"something went wrong ({type(error).__name__}: {error})"
        self.show(message)
