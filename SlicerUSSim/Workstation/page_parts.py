"""Parts of the page: questions, what is offered, keys, pose of the probe, registration of tracked ultrasound."""

from __future__ import annotations

from trame.widgets import html, vuetify3 as v3

from SlicerUSSim.Workstation.pose_entry import POSE_SUFFIXES
from SlicerUSSim.Workstation.state import NAMES

#: Names of transforms that calibrations usually are
_CALIBRATIONS = ("ImageToProbe", "ImageToTransducer", "TransducerToProbe")
_NUMBERS_TIP = (
    "R, A, S of the middle of the probe's face in mm, and its angles about these axes in degrees (turned about R, then "
    "A, then S; all 0: its depth towards A, its columns towards R)"
)
_MATRIX_TIP = "4x4 matrix from the probe to RAS by rows; columns: lateral, depth, elevational, position in mm"
#: What the formats are for
_FORMATS = {".json": "for ussim --pose", ".tfm": "ITK, 3D Slicer", ".h5": "ITK, 3D Slicer", ".mat": "ITK",
            ".txt": "16 numbers"}  # fmt: skip
_KEYS = (
    ("Space, F", "freeze, live"), ("wheel, ← →, when frozen", "image by image through the last seconds"),
    ("arrows", "slide the probe; with Shift five times as far"), ("A D, W S, Q E", "rock, tilt, rotate the probe"),
    ("+ -, Home", "lift or press, align with the surface"), ("double click", "aim at this point of image or slice"),
    ("drag the probe", "slide it; Shift rocks and tilts, Ctrl rotates"), ("M, T", "measure a distance, write a text"),
    ("Delete, Escape", "remove the last measurement, leave a tool"), ("C", "compare with real ultrasound"),
    ("Ctrl + wheel, drag with the middle button, 0", "zoom and move the image, whole image"),
    ("F1, F2", "this help, settings"),
)  # fmt: skip
#: The dialog of keys and gestures
HELP = (
    '<dialog id="help" class="ussim-help" aria-label="Keys and gestures"><h2>Keys and gestures</h2><dl>'
    + "".join(f"<dt>{keys}</dt><dd>{does}</dd>" for keys, does in _KEYS)
    + '</dl><form method="dialog"><button class="ussim-button">Close</button></form></dialog>'
)


def question_dialog() -> None:
    """The question that waits for an answer, with a button for each; Escape and Cancel choose none."""
    question = NAMES.question
    none = f"trigger('answer', [{question.number}, null])"
    with v3.VDialog(model_value=(f"{question.number} > 0",), persistent=True, max_width=640, no_click_animation=True):
        html.Div(
            f"""<div class="v-card v-theme--dark pa-4" style="background: #1e2326; color: #e6e9eb; border-radius: 6px"
            id="question"
            :data-number="{question.number}" role="group" aria-labelledby="question-title"
            aria-describedby="question-text">
            <h2 class="text-h6" id="question-title">{{{{ {question.title} }}}}</h2>
            <p class="text-body-2 my-2" id="question-text" style="overflow-wrap: anywhere">
            {{{{ {question.text} }}}}</p>
            <div class="ussim-choices"><button v-for="choice in {question.choices}" :key="choice.key"
            class="ussim-choice" :title="choice.tip"
            @click="trigger('answer', [{question.number}, choice.key])">
            {{{{ choice.title }}}}<small v-if="choice.tip">{{{{ choice.tip }}}}</small></button>
            <button class="ussim-choice" id="question-cancel" @click="{none}">Cancel
            <small>Nothing is opened</small></button></div></div>"""
        )


def offer() -> None:
    """A bar with the question whether pose and settings of before are to be restored."""
    is_busy = f"{NAMES.messages.progress_title} !== ''"
    with html.Div(
        v_if=NAMES.offer, classes="ussim-bar ussim-offer", id="offer", raw_attrs=['role="status"']
    ):  # fmt: skip
        html.Span(f"{{{{ {NAMES.offer} }}}}", id="offer-text")
        v3.VBtn(
            "Restore", size="small", color="primary", click="trigger('restore')", id="restore",
            disabled=(is_busy,), title="Pose and settings; the patient's files are opened if another patient is",
        )  # fmt: skip
        v3.VBtn(
            "Discard", size="small", variant="outlined", click="trigger('discard')", id="discard",
            disabled=(is_busy,), title="Go on with what is open",
        )  # fmt: skip


def pose_numbers() -> None:
    """Fields for the pose, and a button to save it."""
    is_none = f"{NAMES.pose_numbers} === ''"
    html.Div(
        """<button class="ussim-button" id="stand-upright" @click="trigger('key', ['Home', false])">
        Align with normal</button>"""
    )
    html.Div(
        f"""<label for="pose-numbers">Pose</label>
        <input type="text" id="pose-numbers" :value="{NAMES.pose_numbers}" :disabled="{is_none}"
        @change="trigger('type_pose', [$event.target.value])">""",
        classes="ussim-line", title=_NUMBERS_TIP,
    )  # fmt: skip
    html.Div(
        f"""<label for="pose-matrix">Matrix</label>
        <textarea id="pose-matrix" rows="4" :value="{NAMES.pose_matrix}" :disabled="{is_none}" spellcheck="false"
        @change="trigger('type_pose', [$event.target.value])"></textarea>""",
        classes="ussim-line", title=_MATRIX_TIP,
    )  # fmt: skip
    options = "".join(f'<option value="{suffix}">{suffix} ({_FORMATS[suffix]})</option>' for suffix in POSE_SUFFIXES)
    html.Div(
        f"""<label for="pose-format">Save pose as</label><select id="pose-format">{options}</select>""",
        classes="ussim-line", title="Format of the file",
    )  # fmt: skip
    saved = "window.ussim.save('pose' + window.document.getElementById('pose-format').value)"
    html.Div(
        f"""<button class="ussim-button" id="save-pose" :disabled="{is_none}" @click="{saved}"
        title="The present pose of the probe as a file">Save pose</button>"""
    )


def registration() -> None:
    """Calibration and registration of the tracked ultrasound."""
    state = NAMES.registration
    html.Div(
        f"{{{{ {state.recording} || 'none: open a file with tracked ultrasound' }}}}", id="recording",
        classes="ussim-opened",
    )  # fmt: skip
    with html.Div(v_show=f"{state.recording} !== ''"):
        _frame()
        _calibration()
        _registration()


def _frame() -> None:
    state = NAMES.registration
    html.Div(
        f"""<label for="frame">Patient's frame</label>
        <select id="frame" :value="{state.frame}" @change="trigger('choose_frame', [$event.target.value])">
        <option v-for="frame in {state.frames}">{{{{ frame }}}}</option></select>""",
        classes="ussim-line", title="The frame of the tracker that is fixed to the patient",
    )  # fmt: skip


def _calibration() -> None:
    state = NAMES.registration
    options = "".join(f"<option>{name}</option>" for name in _CALIBRATIONS)
    _heading("Calibration", state.calibration, "calibration")
    _file("calibration", "Calibration file", "A Plus configuration (.xml), or 16 numbers by rows (text, .json)")
    html.Div(
        f"""<label for="calibration-name">Its name</label><input type="text" id="calibration-name"
        list="calibration-names" v-model="{state.name}"><datalist id="calibration-names">{options}</datalist>""",
        classes="ussim-line", title="From pixels to the tracked probe; more than one may lead there",
    )  # fmt: skip


def _registration() -> None:
    state = NAMES.registration
    _heading("Registration", state.registration, "registration")
    _file(
        "registration", "Registration file", "From the frame above to the patient: .tfm, .xfm, .json, 16 numbers, or "
        ".tag with landmarks in both",
    )  # fmt: skip


def _heading(title: str, value: str, name: str) -> None:
    html.Div(
        f"<b>{title}</b> <span>{{{{ {value} || 'none' }}}}</span>", id=f"{name}-from", classes="ussim-opened mt-2",
        raw_attrs=['aria-live="polite"'],
    )  # fmt: skip


def _file(name: str, label: str, tip: str) -> None:
    html.Div(
        f"""<label for="{name}-file">{label}</label><input type="file" id="{name}-file"
        @change="window.ussim.send($event.target, {{for: 'open', as: '{name}'}})">""",
        classes="ussim-line", title=tip,
    )  # fmt: skip
