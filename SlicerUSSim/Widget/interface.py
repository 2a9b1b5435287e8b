"""PanelView: what the presenters require of a user interface, in Slicer or in the browser."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol


class PanelView(Protocol):
    """What the presenters require of a user interface."""

    def showError(self, message: str) -> None:
        """Show one line in a message box."""
        ...

    def showStatus(self, message: str) -> None:
        """Show one line as the panel's status."""
        ...

    def refresh(self) -> None:
        """Update everything: values, tissues, which controls are enabled."""
        ...

    def progress(self, title: str) -> AbstractContextManager[Callable[[float], None]]:
        """Show a progress bar; the function takes the share done, 0 to 1, and raises Cancelled after Cancel."""
        ...

    def schedule(self, function: Callable[[], None]) -> None:
        """Call `function` once, soon, from the event loop."""
        ...

    def sliceNode(self) -> Any:
        """The vtkMRMLSliceNode of the selected slice view, or None."""
        ...

    def pickPoint(self, points_node: Any, picked: Callable[[], None]) -> None:
        """Let the user show a point in a view; it becomes the last of a markups node, then `picked` is called."""
        ...

    def showChart(self, chart_node) -> None:
        """Show a vtkMRMLPlotChartNode in the plot view."""
        ...
