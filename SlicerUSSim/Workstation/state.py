"""PageState: everything that the page and the code behind it share, and SharedState, which keeps it in trame's state.

The page builds its bindings from NAMES, the code behind it reads and writes `SharedState.now`: both from the one
declaration here, so that nothing is called by a string that only a user's browser would find wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from typing import cast

from trame_server.state import State
from trame_server.utils.typed_state import TypedState

from SlicerUSSim.Logic.probe.surface import SurfacePose

#: Planes that a slice view follows the probe in: of the image, across it, and the patient's own.
IN_PLANE, ACROSS = "In plane", "Across"
PLANES = (IN_PLANE, ACROSS, "Axial", "Coronal", "Sagittal")
#: The slice views with the plane that each begins with, by the names that Slicer gives them.
SLICE_VIEWS = {"Red": IN_PLANE, "Yellow": ACROSS, "Green": "Axial"}


class ComparisonMode(Enum):
    """How simulated and real image are shown together."""

    SIMULATED = "Simulated"
    BESIDE = "Beside"
    BLINK = "Blink"
    DIFFERENCE = "Difference"


# ---- values, which change as a whole ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class NodeItem:
    """A node that can be chosen."""

    title: str
    #: Its ID in the scene; None is no node
    value: str | None


@dataclass(frozen=True)
class TissueLine:
    """A line of the tissue table, in the order of presenter.TISSUE_COLUMNS."""

    name: str
    values: list[str]
    #: Where the numbers come from
    sources: list[str]


@dataclass(frozen=True)
class FreeParameter:
    """A parameter that a fit can vary."""

    name: str
    on: bool


@dataclass(frozen=True)
class DepthTick:
    """A mark of the depth ruler."""

    #: Depth, mm
    y: float
    #: Beside it; "" for the marks in between
    text: str


@dataclass(frozen=True)
class ImageGeometry:
    """Where the image lies in the probe frame, mm, and what is drawn around it (static/overlay.html)."""

    x: float = 0.0
    y: float = 0.0
    w: float = 0.0
    h: float = 1.0
    ticks: list[DepthTick] = field(default_factory=list)
    #: Of letters and marks, mm
    size: float = 1.0
    #: Depth of the transmit focus, mm
    focus: float = 0.0
    #: Dynamic range, dB, as it is written
    range: str = ""


# ---- what page and control share, by concern -------------------------------------------------------------------------


@dataclass
class PanelState:
    """The controls of Widget/sections.py: the mappings are by Control.widget."""

    #: What each shows; None where the preset has no such value
    values: dict[str, object] = field(default_factory=dict)
    #: What choices offer
    choices: dict[str, list[str]] = field(default_factory=dict)
    #: The nodes that can be chosen
    nodes: dict[str, list[NodeItem]] = field(default_factory=dict)
    #: Whether it can be used; those that are missing can
    can: dict[str, bool] = field(default_factory=dict)
    #: Their tool tips, which say why not
    tips: dict[str, str] = field(default_factory=dict)
    #: The tissue table, and the name in its chosen line
    tissues: list[TissueLine] = field(default_factory=list)
    chosen_tissue: str = ""


@dataclass
class MessageState:
    """What the user is told."""

    #: One line each, until the user closes them
    errors: list[str] = field(default_factory=list)
    #: One line in the bar below the image
    status: str = ""
    #: The work under way, "" for none, and how much of it is done, in percent
    progress_title: str = ""
    progress_percent: int = 0
    #: State of the tracker's connection; "" without a tracker
    tracker: str = ""


@dataclass
class ViewState:
    """How the slice views show things."""

    #: Plane of PLANES by slice view
    planes: dict[str, str] = field(default_factory=lambda: dict(SLICE_VIEWS))
    #: How much of the image, against the MRI: 0 to 1
    blend: float = 0.6
    #: Whether they follow the probe
    follow: bool = True
    #: Whether the tissues are coloured
    show_tissues: bool = False


@dataclass
class SequenceState:
    """Real ultrasound beside the simulated."""

    #: Number of its images; 0 without a sequence
    length: int = 0
    #: The place of the image that is shown, from 0, and what it is called
    number: int = 0
    name: str = ""
    playing: bool = False
    comparison: ComparisonMode = ComparisonMode.BESIDE
    #: How alike simulated and real image are, in words
    similarity: str = ""


@dataclass
class FitState:
    """The fit to real ultrasound."""

    free: list[FreeParameter] = field(default_factory=list)
    #: The best costs so far, and the same in words
    curve: list[float] = field(default_factory=list)
    costs: str = ""


@dataclass
class ScriptState:
    """The dialog with the image as a Python script."""

    text: str = ""
    is_open: bool = False


@dataclass
class PageState:
    """All of it, with what the page needs before anything is loaded."""

    #: Name of the MRI
    title: str = ""
    #: Titles of the panel's sections that are open
    open_sections: list[str] = field(default_factory=list)
    #: The file that the user just gave to the page, as its input has it (name, content); None once it is taken
    opened_file: object = None
    #: None before the first image
    image: ImageGeometry | None = None
    #: Where the probe is on the patient; None without a probe or a patient
    pose: SurfacePose | None = None
    #: Whether a probe that slides stands along the normal of the surface
    upright: bool = True
    #: Whether the time from mouse to image is measured
    show_latency: bool = False
    panel: PanelState = field(default_factory=PanelState)
    messages: MessageState = field(default_factory=MessageState)
    views: ViewState = field(default_factory=ViewState)
    sequence: SequenceState = field(default_factory=SequenceState)
    fit: FitState = field(default_factory=FitState)
    script: ScriptState = field(default_factory=ScriptState)


#: A PageState that has, instead of every value, the name of that value in trame's state, for the page's expressions.
NAMES = cast(PageState, TypedState(State(), PageState).name)


class SharedState:
    """A PageState in the state of a trame server, which keeps the pages up to date.

    Parameters
    ----------
    state : of the server.
    """

    def __init__(self, state: State) -> None:
        self._state = state
        self._typed = TypedState(state, PageState)

    @property
    def now(self) -> PageState:
        """To read; what is written here reaches the pages when the server next tells them something."""
        return cast(PageState, self._typed.data)

    @contextmanager
    def changing(self) -> Iterator[PageState]:
        """To write; the pages are told at the end."""
        with self._state:
            yield self.now

    def on_change(self, field_of_now: object, method: Callable[..., object]) -> None:
        """Call `method` with the new value whenever a page or the code behind it changes a field of NAMES."""
        self._typed.bind_changes({field_of_now: method})
