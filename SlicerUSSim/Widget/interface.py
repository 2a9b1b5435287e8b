"""PanelView: what the presenters want of a user interface, in Slicer or in the browser."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol


class PanelView(Protocol):
    """What the presenter wants of a user interface."""

    def showError(self, message: str) -> None:
        """Show one line in a message box."""
        ...

    def showStatus(self, message: str) -> None:
        """Show one line in the panel, beside Live."""
        ...

    def refresh(self) -> None:
        """Show everything anew: fields, tissues, what can be done."""
        ...

    def progress(self, title: str) -> AbstractContextManager[Callable[[float], None]]:
        """Show a progress bar; the function is told the share done and raises Cancelled if the user wants."""
        ...

    def schedule(self, function: Callable[[], None]) -> None:
        """Call `function` once, soon, from the event loop."""
        ...

    def sliceNode(self) -> Any:
        """The vtkMRMLSliceNode of the chosen slice view, or None."""
        ...

    def showChart(self, chart_node) -> None:
        """Show a vtkMRMLPlotChartNode where plots are shown."""
        ...
