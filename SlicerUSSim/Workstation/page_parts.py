"""Parts of the page about what is opened: questions, and calibration and registration of tracked ultrasound."""

from __future__ import annotations

from trame.widgets import html, vuetify3 as v3

from SlicerUSSim.Workstation.registration import PICK_IMAGE, PICK_PATIENT, SECTION
from SlicerUSSim.Workstation.state import NAMES

#: Names of transforms that calibrations usually are
_CALIBRATIONS = ("ImageToProbe", "ImageToTransducer", "TransducerToProbe")


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


def registration_section() -> None:
    """The section with calibration, registration and landmarks of the tracked ultrasound."""
    state = NAMES.registration
    there = f"{state.recording} !== ''"
    with v3.VExpansionPanel(value=SECTION):
        v3.VExpansionPanelTitle(SECTION, style="min-height: 36px; font-size: 13px")
        with v3.VExpansionPanelText(eager=True, id="section-tracked-ultrasound"):
            html.Div(
                f"{{{{ {state.recording} || 'none: open a file with tracked ultrasound' }}}}", id="recording",
                classes="ussim-opened",
            )  # fmt: skip
            with html.Div(v_show=there):
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
