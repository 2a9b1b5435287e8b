"""Parts of the page: questions, the session, the pose of the probe, and registration of tracked ultrasound."""

from __future__ import annotations

from trame.widgets import html, vuetify3 as v3

from SlicerUSSim.Workstation.pose_entry import POSE_SUFFIXES
from SlicerUSSim.Workstation.pose_registration import PICK_IMAGE, PICK_PATIENT
from SlicerUSSim.Workstation.state import NAMES

#: Names of transforms that calibrations usually are
_CALIBRATIONS = ("ImageToProbe", "ImageToTransducer", "TransducerToProbe")
_KEEP_TIP = (
    "Patient, tissues, probe and settings are kept on the computer of the server, for its user alone, and are there "
    "after a crash; off: nothing is kept, and what was is removed"
)
_NUMBERS_TIP = (
    "R, A, S of the middle of the probe's face in mm, and its angles about these axes in degrees (turned about R, then "
    "A, then S; all 0: its depth towards A, its columns towards R)"
)
_MATRIX_TIP = "4x4 matrix from the probe to RAS by rows; columns: lateral, depth, elevational, position in mm"
#: What the formats are for
_FORMATS = {".json": "for ussim --pose", ".tfm": "ITK, 3D Slicer", ".h5": "ITK, 3D Slicer", ".mat": "ITK",
            ".txt": "16 numbers"}  # fmt: skip


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


def session_offer() -> None:
    """A bar with the question whether the last session is to be restored, and for session.js what it needs."""
    html.Span(hidden=True, id="proof-key", raw_attrs=[f':data-key="{NAMES.proof_key}"'])
    is_busy = f"{NAMES.messages.progress_title} !== ''"
    with html.Div(
        v_if=NAMES.offer, classes="ussim-bar ussim-offer", id="session-offer", raw_attrs=['role="status"']
    ):  # fmt: skip
        html.Span(f"{{{{ {NAMES.offer} }}}}", id="session-offer-text")
        v3.VBtn(
            "Restore", size="small", color="primary", click="trigger('restore_session')", id="restore-session",
            disabled=(is_busy,), title="It takes the place of the patient that is open now",
        )  # fmt: skip
        v3.VBtn(
            "Discard", size="small", variant="outlined", click="trigger('discard_session')", id="discard-session",
            disabled=(is_busy,), title="Remove it from the disk",
        )  # fmt: skip


def keep_session() -> None:
    """A tick box: whether this session is kept."""
    with html.Div(title=_KEEP_TIP):
        v3.VCheckbox(
            label="Keep this session for a crash (autosave)", v_model=(NAMES.keeps_session,), density="compact",
            hide_details=True, id="keeps-session", disabled=(f"!{NAMES.can_keep_session}",),
        )  # fmt: skip


def pose_numbers() -> None:
    """Fields for the pose, and buttons to open and save it."""
    is_none = f"{NAMES.pose_numbers} === ''"
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
    suffixes = ",".join(POSE_SUFFIXES)
    html.Div(
        f"""<label for="open-pose">Open pose</label><input type="file" id="open-pose" accept="{suffixes}"
        @change="window.ussim.send($event.target, {{for: 'pose'}})">""",
        classes="ussim-line", title="JSON, 16 numbers, or a linear transform of ITK as 3D Slicer saves it",
    )  # fmt: skip
    options = "".join(f'<option value="{suffix}">{suffix} ({_FORMATS[suffix]})</option>' for suffix in POSE_SUFFIXES)
    html.Div(
        f"""<label for="pose-format">Save pose as</label><select id="pose-format">{options}</select>""",
        classes="ussim-line", title="Format of the file",
    )  # fmt: skip
    v3.VBtn(
        "Save pose", size="small", classes="ma-1", id="save-pose", disabled=(is_none,),
        click="window.ussim.save('pose' + window.document.getElementById('pose-format').value)",
        title="The present pose of the probe as a file",
    )  # fmt: skip


def registration() -> None:
    """Calibration, registration and landmarks of the tracked ultrasound."""
    state = NAMES.registration
    html.Div(
        f"{{{{ {state.recording} || 'none: open a file with tracked ultrasound' }}}}", id="recording",
        classes="ussim-opened",
    )  # fmt: skip
    with html.Div(v_show=f"{state.recording} !== ''"):
        _frame()
        _calibration()
        _registration()
        _landmarks()


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
    _values("calibration", "Calibration, 16 numbers by rows", state.calibration_text)
    _button("calibrate", "Calibrate", f"trigger('calibrate', [{state.name}, {state.calibration_text}])", "Use them")


def _registration() -> None:
    state = NAMES.registration
    _heading("Registration", state.registration, "registration")
    _file(
        "registration", "Registration file", "From the frame above to the patient: .tfm, .xfm, .json, 16 numbers, or "
        ".tag with landmarks in both",
    )  # fmt: skip
    _values("registration", "Registration, 16 numbers by rows", state.registration_text)
    _button("register", "Register", f"trigger('register', [{state.registration_text}])", "Use them")


def _landmarks() -> None:
    state = NAMES.registration
    html.Div(
        f"""<table class="ussim-table" id="landmarks" v-if="{state.landmarks}.length"><tr><th>Ultrasound, pixel</th>
        <th>Patient, RAS [mm]</th><th>Left</th><th><span class="ussim-hidden">Remove</span></th></tr>
        <tr v-for="(mark, n) in {state.landmarks}"><td>{{{{ mark.ultrasound }}}}</td><td>{{{{ mark.patient }}}}</td>
        <td>{{{{ mark.remaining }}}}</td><td><button class="ussim-plain" :aria-label="'Remove landmark ' + (n + 1)"
        @click="trigger('remove_landmark', [n])">x</button></td></tr></table>"""
    )
    _button(
        "pick-landmark", "Pick a landmark", "trigger('pick_landmark')",
        "A click in the real image, then one at the same place in a slice view",
    )  # fmt: skip
    _button(
        "fit-landmarks", "Register by landmarks", "trigger('fit_landmarks')",
        "The rigid map with the least squared distances of three or more",
    )  # fmt: skip
    html.Div(
        f"""{{{{ {{ultrasound: '{PICK_IMAGE}', patient: '{PICK_PATIENT}'}}[{state.picking}] ?? '' }}}}""",
        id="picking", classes="ussim-opened ussim-asked", raw_attrs=['aria-live="polite"'],
    )  # fmt: skip
    for field, name, label, hint in (
        (state.typed_pixel, "landmark-pixel", "In the image", "column row"),
        (state.typed_point, "landmark-point", "In the patient", "R A S in mm"),
    ):
        html.Div(
            f"""<label for="{name}">{label}</label>
            <input type="text" id="{name}" placeholder="{hint}" v-model="{field}">""",
            classes="ussim-line", title="A landmark of the real image that is shown",
        )  # fmt: skip
    _button(
        "add-landmark", "Add this landmark", f"trigger('add_landmark', [{state.typed_pixel}, {state.typed_point}])",
        "Of the real image that is shown",
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


def _values(name: str, label: str, field: str) -> None:
    html.Div(
        f"""<textarea rows="4" class="ussim-area" id="{name}-values" aria-label="{label}" placeholder="{label}"
        v-model="{field}"></textarea>"""
    )


def _button(name: str, label: str, click: str, tip: str) -> None:
    v3.VBtn(label, size="small", classes="ma-1", id=name, click=click, title=tip)
