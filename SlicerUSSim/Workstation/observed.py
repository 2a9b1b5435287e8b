"""Observed: observes one MRML node at a time, the one that currently has a given role."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class Observed:
    """Observes the node that currently has a role.

    Parameters
    ----------
    event : name of an event of that node, such as "TransformModifiedEvent".
    method : called on this event.
    """

    def __init__(self, event: str, method: Callable[[], None]) -> None:
        self._event, self._method = event, method
        self._node: Any = None
        self._tag = 0

    def watch(self, node: Any) -> bool:
        """Observe this node from now on, or none; whether it is another one than before."""
        if node is self._node:
            return False
        if self._node is not None:
            self._node.RemoveObserver(self._tag)
        self._node = node
        if node is not None:
            event = getattr(node, self._event, self._event)  # VTK takes its own events by name, MRML's by number
            self._tag = node.AddObserver(event, lambda *_: self._method())
        return True
