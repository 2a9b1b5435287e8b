"""PageState: all data that page and server share. SharedState: a PageState in trame's state.

The page builds its bindings from NAMES, and the server reads and writes `SharedState.now`. Both use the declaration
below, so that a wrong name is an error of Python and not only of the browser.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from typing import cast

from trame_server.state import State
from trame_server.utils.typed_state import TypedState

from SlicerUSSim.Logic.probe.surface import SurfacePose

#: Name of the 3D view, and of the ultrasound image among the views that ViewState.cross marks
THREED, IMAGE = "ThreeD", "image"
#: Planes in which a slice view follows the probe: image plane, plane across it, and anatomical planes.
IN_PLANE, ACROSS = "In plane", "Across"
PLANES = (IN_PLANE, ACROSS, "Axial", "Coronal", "Sagittal")
#: Initial planes of the slice views, by Slicer's names of the views.
SLICE_VIEWS = {"Red": IN_PLANE, "Green": "Axial"}


class ComparisonMode(Enum):
    """How simulated and real image are shown together."""

    SIMULATED = "Simulated"
    BESIDE = "Beside"
    BLINK = "Blink"
    DIFFERENCE = "Difference"


# ---- immutable values ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NodeItem:
    """A node that can be selected."""

    title: str
    #: Its ID in the scene; None: no node
    value: str | None


@dataclass(frozen=True)
class TissueLine:
    """A line of the tissue table, in the order of tissue_presenter.TISSUE_COLUMNS."""

    name: str
    values: list[str]
    #: Sources of the values
    sources: list[str]


@dataclass(frozen=True)
class FreeParameter:
    """A parameter that a fit can vary, and what users call it."""

    name: str
    label: str
    on: bool


@dataclass(frozen=True)
class Choice:
    """One answer to a question."""

    key: str
    #: On its button, and what it does
    title: str
    tip: str = ""


# ---- shared state, by topic ------------------------------------------------------------------------------------------


@dataclass
class PanelState:
    """The controls of Widget/sections.py. The keys of all mappings are Control.widget. Values: see value_of()."""

    #: Options of the choices
    choices: dict[str, list[str]] = field(default_factory=dict)
    #: Nodes that can be selected
    nodes: dict[str, list[NodeItem]] = field(default_factory=dict)
    #: Whether a control can be used; those without an entry can
    can: dict[str, bool] = field(default_factory=dict)
    #: Tool tips; the reason if a control cannot be used
    tips: dict[str, str] = field(default_factory=dict)
    #: The tissue table, and the name in its selected line
    tissues: list[TissueLine] = field(default_factory=list)
    chosen_tissue: str = ""


@dataclass
class MessageState:
    """Messages to the user."""

    #: Errors, one line each, until the user closes them
    errors: list[str] = field(default_factory=list)
    #: One line in the bar below the image
    status: str = ""
    #: Title of the work under way ("": none), its progress in percent, and how long it has taken, s
    progress_title: str = ""
    progress_percent: int = 0
    progress_s: int = 0
    #: State of the tracker's connection; "" without a tracker
    tracker: str = ""


@dataclass
class ViewState:
    """Display of the slice views."""

    #: Plane of PLANES by slice view
    planes: dict[str, str] = field(default_factory=lambda: dict(SLICE_VIEWS))
    #: Opacity of the image over the MRI, 0 to 1
    blend: float = 0.6
    #: Whether they follow the probe
    follow: bool = True
    #: Whether the tissues are coloured
    show_tissues: bool = False
    #: Tissue, place, MRI and depth of the point under the mouse, one line; "": none
    under_mouse: str = ""
    #: That point in every view, by name (IMAGE, THREED, SLICE_VIEWS): shares of its width and height from the upper
    #: left corner, and mm from the point to the plane of the view
    cross: dict[str, list[float]] = field(default_factory=dict)
    #: Sides of the patient at the left, right, upper and lower edge of a slice view: "R", or "RA" if it is oblique
    letters: dict[str, list[str]] = field(default_factory=dict)


@dataclass
class SequenceState:
    """The sequence of real ultrasound images."""

    #: Number of images; 0 without a sequence
    length: int = 0
    #: Index of the displayed image among these, from 0; its name, which has its number in the file, and those of all
    number: int = 0
    name: str = ""
    numbers: str = ""
    #: Whether their place in the patient is known; else they can only be viewed
    is_placed: bool = True
    #: Outline of what is compared: viewBox and path (mm of the probe frame) of an SVG over an image; "" without
    box: str = ""
    mask: str = ""
    playing: bool = False
    comparison: ComparisonMode = ComparisonMode.BESIDE
    #: Cost between simulated and real image, as text, and whether their poses differ
    similarity: str = ""
    is_elsewhere: bool = False


@dataclass
class ImageState:
    """The shown image, from its record (TakenImage) alone, and whether the record is up to date."""

    #: "LIVE", "OUTDATED" or "FROZEN"; "" without an image
    status: str = ""
    #: What of the record differs from the scene, such as "pose, tissues"; "" if nothing
    differs: str = ""
    #: Texts for a banner, with units
    patient: str = ""
    time: str = ""
    probe: str = ""
    frequency: str = ""
    #: Depth, Focus, Gain and DR in the image's corner
    values: dict[str, str] = field(default_factory=dict)


@dataclass
class CineState:
    """The cine: the last seconds of live images, or the images of Simulate sequence."""

    #: "live" or "sequence", and how many images Simulate sequence has made
    source: str = "live"
    sequence_length: int = 0
    #: Number of images
    length: int = 0
    #: Index of the shown image, from 0, and its time after the first image, s
    index: int = 0
    seconds: float = 0.0
    #: Indices of the first and the last image that are played and exported
    first: int = 0
    last: int = 0
    playing: bool = False


@dataclass
class FitState:
    """The fit to real ultrasound."""

    free: list[FreeParameter] = field(default_factory=list)
    #: Best cost during the fit
    curve: list[float] = field(default_factory=list)
    #: Caption of the best image so far (stream "best") of a fit, which is shown while it runs
    best: str = ""


@dataclass
class RegistrationState:
    """Calibration and registration of the tracked ultrasound."""

    #: What it is, one line; "" without
    recording: str = ""
    #: Frame that is fixed to the patient, and those that there are
    frame: str = ""
    frames: list[str] = field(default_factory=list)
    #: Name of the transform that is given as calibration
    name: str = "ImageToProbe"
    #: Where calibration and registration are from
    calibration: str = ""
    registration: str = ""


@dataclass
class QuestionState:
    """A question to the user, until it is answered on one of the pages."""

    #: Number of the question; 0 while there is none
    number: int = 0
    title: str = ""
    #: What was recognised, and what is asked
    text: str = ""
    choices: list[Choice] = field(default_factory=list)


@dataclass
class PageState:
    """The complete state, with the values before any file is loaded."""

    #: Name of the patient: the file with the labels, or with the MRI from which they are
    title: str = ""
    #: The question whether to restore the last pose and settings; "": there is none
    offer: str = ""
    #: Pose of the probe on the patient; None without a probe or a patient
    pose: SurfacePose | None = None
    #: The same as texts: position and angles, and matrix, as pose_files.pose_of_text reads them; "" without a probe
    pose_numbers: str = ""
    pose_matrix: str = ""
    #: Whether the probe is aligned with the surface normal while it slides
    upright: bool = True
    #: What a user should know or do first, and what its button does ("": no button)
    advice: str = ""
    remedy: str = ""
    #: Whether the latency from mouse to image is measured
    show_latency: bool = False
    panel: PanelState = field(default_factory=PanelState)
    messages: MessageState = field(default_factory=MessageState)
    views: ViewState = field(default_factory=ViewState)
    sequence: SequenceState = field(default_factory=SequenceState)
    image: ImageState = field(default_factory=ImageState)
    cine: CineState = field(default_factory=CineState)
    fit: FitState = field(default_factory=FitState)
    registration: RegistrationState = field(default_factory=RegistrationState)
    question: QuestionState = field(default_factory=QuestionState)
    #: What was opened last: what each file is, and what was done with it, one line each
    opened: list[str] = field(default_factory=list)


#: A PageState whose fields are the names of the values in trame's state, for the page's expressions.
NAMES = cast(PageState, TypedState(State(), PageState).name)


def value_of(widget: str) -> str:
    """Name of the displayed value of a control in trame's state: pages are sent those that have changed, one by one.

    The value is None if the preset has no such one.
    """
    return f"value_{widget}"


class SharedState:
    """A PageState in the state of a trame server, which sends its changes to the pages.

    Parameters
    ----------
    state : of the server.
    """

    def __init__(self, state: State) -> None:
        self._state = state
        self._typed = TypedState(state, PageState)

    @property
    def now(self) -> PageState:
        """For reading; a value that is written here is sent to the pages with the next change."""
        return cast(PageState, self._typed.data)

    @contextmanager
    def changing(self) -> Iterator[PageState]:
        """For writing; the changes are sent to the pages at the end of the context."""
        with self._state:
            yield self.now

    def put(self, part: str, values: Mapping[str, object]) -> None:
        """Send pages what of these values of a part, such as "cine", has changed."""
        changed = {name: value for name, value in values.items() if getattr(getattr(self.now, part), name) != value}
        if changed:
            with self.changing() as now:
                for name, value in changed.items():
                    setattr(getattr(now, part), name, value)

    def show_values(self, values: Mapping[str, object]) -> None:
        """Show these values of controls, by Control.widget."""
        with self._state:
            self._state.update({value_of(widget): value for widget, value in values.items()})

    def value(self, widget: str) -> object:
        """The displayed value of a control."""
        return self._state[value_of(widget)]

    def on_change(self, field_of_now: object, method: Callable[..., object]) -> None:
        """Call `method` with the new value when a page or the server changes a field of NAMES."""
        self._typed.bind_changes({field_of_now: method})
