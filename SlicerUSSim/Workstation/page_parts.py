"""Parts of the page: questions, what is offered, keys, pose of the probe, registration of tracked ultrasound."""

from __future__ import annotations

from trame.widgets import html, vuetify3 as v3

from SlicerUSSim.Workstation.controls import kept
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
    """A bar with the question whether to restore the last pose and settings."""
    is_busy = f"{NAMES.messages.progress_title} !== ''"
    html.Div(
        f"""<span id="offer-text">{{{{ {NAMES.offer} }}}}</span>
        <button class="ussim-button" id="restore" :disabled="{is_busy}" @click="trigger('restore')"
        title="Restore pose and settings; opens the patient's files if needed">Restore</button>
        <button class="ussim-button" id="discard" :disabled="{is_busy}" @click="trigger('discard')"
        title="Continue with what is open">Discard</button>""",
        v_if=NAMES.offer, classes="ussim-bar ussim-offer", id="offer", raw_attrs=['role="status"'],
    )  # fmt: skip


def pose_numbers() -> None:
    """Fields for the pose, and a button to save it."""
    is_none = f"{NAMES.pose_numbers} === ''"
    options = "".join(f'<option value="{suffix}">{suffix} ({_FORMATS[suffix]})</option>' for suffix in POSE_SUFFIXES)
    saved = "window.ussim.save('pose' + window.document.getElementById('pose-format').value)"
    html.Div(
        f"""<button class="ussim-button" id="stand-upright" @click="trigger('key', ['Home', false])">
        Align with normal</button>
        <div class="ussim-line" title="{_NUMBERS_TIP}"><label for="pose-numbers">Pose</label>
        <input type="text" id="pose-numbers" :value="{NAMES.pose_numbers}" :disabled="{is_none}"
        {kept(NAMES.pose_numbers)} @change="trigger('type_pose', [$event.target.value])"></div>
        <div class="ussim-line" title="{_MATRIX_TIP}"><label for="pose-matrix">Matrix</label>
        <textarea id="pose-matrix" rows="4" :value="{NAMES.pose_matrix}" :disabled="{is_none}" spellcheck="false"
        {kept(NAMES.pose_matrix)} @change="trigger('type_pose', [$event.target.value])"></textarea></div>
        <div class="ussim-line" title="Format of the file"><label for="pose-format">Save pose as</label>
        <select id="pose-format">{options}</select></div>
        <button class="ussim-button" id="save-pose" :disabled="{is_none}" @click="{saved}"
        title="The present pose of the probe as a file">Save pose</button>"""
    )


def registration() -> None:
    """Calibration and registration of the tracked ultrasound."""
    state = NAMES.registration
    names = "".join(f"<option>{name}</option>" for name in _CALIBRATIONS)
    html.Div(
        f"""<div id="recording" class="ussim-opened">{{{{ {state.recording} ||
        'none: open a file with tracked ultrasound' }}}}</div><div v-show="{state.recording} !== ''">
        <div class="ussim-line" title="The frame of the tracker that is fixed to the patient">
        <label for="frame">Patient's frame</label>
        <select id="frame" :value="{state.frame}" @change="trigger('choose_frame', [$event.target.value])">
        <option v-for="frame in {state.frames}">{{{{ frame }}}}</option></select></div>
        {_file("Calibration", state.calibration, "A Plus configuration (.xml), or 16 numbers by rows (text, .json)")}
        <div class="ussim-line" title="From pixels to the tracked probe; more than one may lead there">
        <label for="calibration-name">Its name</label><input type="text" id="calibration-name"
        list="calibration-names" v-model="{state.name}"><datalist id="calibration-names">{names}</datalist></div>
        {_file("Registration", state.registration, "From the frame above to the patient: .tfm, .xfm, .json, 16 "
               "numbers, or .tag with landmarks in both")}</div>"""
    )  # fmt: skip


def _file(title: str, value: str, tip: str) -> str:
    """Where a transform is from, and an input for its file."""
    name = title.lower()
    return f"""<div id="{name}-from" class="ussim-opened mt-2" aria-live="polite">
        <b>{title}</b> <span>{{{{ {value} || 'none' }}}}</span></div>
        <div class="ussim-line" title="{tip}"><label for="{name}-file">{title} file</label>
        <input type="file" id="{name}-file"
        @change="window.ussim.send($event.target, {{for: 'open', as: '{name}'}})"></div>"""
