"""Layout of the page, as on a scanner: a banner, the probes, the image, its controls, the anatomy, and the cine.

What is not needed while one looks at the image is in the drawer: the sections of the Slicer panel. The page is HTML for
Vue, bound to fields of state.PageState through their NAMES. Actions of the user reach the workstation as triggers by
name (Workstation._answer_pages), and as changes of those fields; what concerns one page alone is in static/.
"""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from trame.ui.vuetify3 import VAppLayout
from trame.widgets import html, vuetify3 as v3
from trame_server import Server

from SlicerUSSim.Logic.probe.arrays import PROBES, Probe
from SlicerUSSim.Widget.interface import Control, by_widget
from SlicerUSSim.Widget.value_presenter import SHOWN_PROBES
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.controls import control_html, range_html, slider_html, upright_html
from SlicerUSSim.Workstation.page_parts import HELP, offer, pose_numbers, question_dialog, registration
from SlicerUSSim.Workstation.pose_registration import SECTION
from SlicerUSSim.Workstation.state import IMAGE, NAMES, ComparisonMode, value_of
from SlicerUSSim.Workstation.view_tools import anatomy_column, cross_hair

_STATIC = Path(__file__).parent / "static"
#: Files that the page loads in addition to those of trame.
MODULE = {
    "serve": {"ussim": str(_STATIC)},
    "module_scripts": ["ussim/workstation.js"],
    "styles": ["ussim/workstation.css", "ussim/views.css"],
}
#: Controls of the panel that are not on the page: its views follow the probe and show it, it compares the fit in the
#: ultrasound view, it has a separate button to place the probe, and no editor of segments.
NOT_SHOWN = {
    "sliceViewComboBox", "showInSliceCheckBox", "showIn3dCheckBox", "showProbeCheckBox", "layoutButton",
    "compareComboBox", "compareNumberComboBox", "blinkCheckBox", "statusLabel", "placeButton", "editTissuesButton",
    "probePresetComboBox", "liveCheckBox", "differenceCheckBox",
}  # fmt: skip
#: Controls beside the image, and the gains at eight depths
_BESIDE = ("gainSlider", "depthSlider", "frequencySlider", "focusSlider", "dynamicRangeSlider")
_TGC = tuple(f"depthGain{number}Slider" for number in range(1, 9))
_BELOW_TGC = ("tgcSlider", "lookComboBox", "greyMapComboBox")


#: Sliders of the pose: field of surface.SurfacePose, label, tip, range, step, unit
_POSE_SLIDERS = (
    ("right_deg", "Left - right", "Position on the head, from its vertex", -120, 120, 0.5, "°"),
    ("front_deg", "Back - front", "Position on the head, from its vertex", -120, 120, 0.5, "°"),
    ("rotate_deg", "Rotate", "About the probe's axis (keys Q, E; Ctrl and drag)", -180, 180, 1.0, "°"),
    ("rock_deg", "Rock", "In the image plane (keys A, D; Shift and drag)", -75, 75, 0.5, "°"),
    ("tilt_deg", "Tilt", "Out of the image plane (keys W, S; Shift and drag)", -75, 75, 0.5, "°"),
    ("lift_mm", "Lift", "Off the surface; negative: pressed in (keys +, -)", -10, 30, 0.5, "mm"),
)
#: What Save offers: pictures that the page composes, with banner, scale and measurements, and files of the server
_COMPOSED = {
    "picture": ("savePicture()", "Picture with scale and measurements (PNG)"),
    "video": ("saveVideo()", "Cine with scale and measurements (WebM)"),
    "dicom": ("saveDicom(false)", "DICOM ultrasound image"), "dicom-cine": ("saveDicom(true)", "DICOM ultrasound cine"),
}  # fmt: skip
_FILES = {
    "png": "Image alone (PNG)", ".nrrd": "Image with geometry (NRRD)", ".mha": "Image with geometry (MHA)",
    ".vti": "Image with geometry (VTI)", "cine": "Cine with poses (.igs.mha)", "mrb": "Scene for 3D Slicer (MRB)",
    "json": "Settings (JSON)",
}  # fmt: skip
_TOOLS = (
    ("distance", "Distance", "Two clicks (M)"), ("ellipse", "Ellipse", "Two clicks on its long axis, one on its side"),
    ("angle", "Angle", "Three clicks, the apex second"), ("depth", "Depth", "One click"),
    ("text", "Text", "One click, then type (T)"), ("mmode", "M-mode", "Two clicks: grey levels of a line over time"),
    ("bodymark", "Body mark", "Where the probe is on the head, on and off"), ("clear", "Clear", "Remove them all"),
)  # fmt: skip
#: Names of fields of the state that scripts read, as attributes of the screens
_SHARED_WITH_SCRIPTS = [
    f'data-{name}="{field}"'
    for name, field in {
        "pose": NAMES.pose, "cine-first": NAMES.cine.first, "cine-last": NAMES.cine.last,
        "cine-index": NAMES.cine.index, "cine-seconds": NAMES.cine.seconds,
    }.items()
]  # fmt: skip
_MMODE = """<canvas data-stream="mmode"></canvas><button class="ussim-icon" title="Close M-mode"
    aria-label="Close M-mode" @click="window.ussim.tool('mmode-off')"><i class="mdi mdi-close"></i></button>"""
#: In the browser's tab
_PROGRAM = "SlicerUSSim"


def build_page(server: Server, panel: BrowserPanel, keys: tuple[str, ...]) -> None:
    """Build the page of a server; `keys` are the keys that are sent to it."""
    server.enable_module(MODULE)
    server.state.trame__title = _PROGRAM

    @server.state.change(NAMES.title)
    def show_in_tab(**values: object) -> None:
        title = values.get(NAMES.title)
        server.state.trame__title = f"{title} - {_PROGRAM}" if title else _PROGRAM

    controls = by_widget(panel.sections)
    with VAppLayout(server) as page:
        page.root.theme = "dark"
        with html.Div(classes="ussim-page", id="page"):
            html.Div(_banner(), classes="ussim-banner")
            with html.Div(classes="ussim-main"):
                html.Div(_probes(), classes="ussim-rail", raw_attrs=['aria-label="Probes"', 'role="group"'])
                with html.Div(classes="ussim-stage"):
                    offer()
                    html.Div(_advice())
                    html.Div(_screens(keys), classes="ussim-screens", id="screens", raw_attrs=_SHARED_WITH_SCRIPTS)
                    html.Div(_MMODE, classes="ussim-mmode", id="mmode", raw_attrs=["hidden"])
                    html.Div(_player(), classes="ussim-bars")
                html.Div(_console(controls), classes="ussim-console")
                with html.Div(classes="ussim-anatomy"):
                    anatomy_column(server)
            html.Div(_foot(), classes="ussim-foot")
            with html.Div(classes="ussim-drawer", id="drawer", raw_attrs=['aria-label="Settings"', 'role="region"']):
                _drawer(panel)
        _messages()
        question_dialog()
        html.Div(HELP)


# ---- banner, and what matters most now -------------------------------------------------------------------------------


def _banner() -> str:
    image = NAMES.image
    saved = _COMPOSED | {kind.strip("."): (f"save('{kind}')", words) for kind, words in _FILES.items()}
    saves = "".join(
        f"""<button class="ussim-item" id="save-{name}" @click="window.ussim.{script}">{words}</button>"""
        for name, (script, words) in saved.items()
    )
    views = NAMES.views
    toggles = "".join(
        f"""<button class="ussim-icon" id="{name}" title="{tip}" aria-label="{tip}" :aria-pressed="!!{state}"
        @click="{state} = !{state}"><i class="mdi mdi-{icon}"></i></button>"""
        for state, name, icon, tip in (
            (views.show_tissues, "show-tissues", "palette", "Colour the tissues in the slice views"),
            (views.follow, "follow", "crosshairs-gps", "Let the slice views follow the probe"),
            (NAMES.show_latency, "show-latency", "timer-outline", "Measure images per second and latency"),
        )
    )
    return f"""
    <button class="ussim-icon" id="menu" title="Patient, lesions, tissues, fit and all settings (F2)"
      aria-label="Settings" @click="window.ussim.toggle('drawer-open')"><i class="mdi mdi-menu"></i></button>
    <b id="title">{{{{ {NAMES.title} || '{_PROGRAM}' }}}}</b>
    <span id="image-caption">{{{{ {image.patient} && {image.patient} !== {NAMES.title} ? {image.patient} + ' · ' : ''
      }}}}{{{{ {image.probe} }}}} {{{{ {image.frequency} }}}} {{{{ {image.time} ? '· ' + {image.time} : '' }}}}</span>
    <span class="ussim-space"></span>{toggles}
    <label class="ussim-blend">Blend <input type="range" id="blend" min="0" max="1" step="0.05" :value="{views.blend}"
      aria-label="Blend of image and MRI" @input="{views.blend} = Number($event.target.value)"></label>
    <span v-if="{image.status}" class="ussim-status" :class="{image.status}.toLowerCase()" id="image-status"
      role="status">{{{{ {image.status} }}}}</span>
    <button class="ussim-icon" id="fold" title="Hide or show the views" aria-label="Fold the views"
      @click="window.ussim.arrange('fold')"><i class="mdi mdi-dock-right"></i></button>
    <details class="ussim-menu" id="save"><summary>Save</summary><div>{saves}</div></details>
    <button class="ussim-button" id="help-button" title="Keys and gestures (F1)"
      @click="window.ussim.help()">? F1</button>"""


def _advice() -> str:
    advice, remedy, image = NAMES.advice, NAMES.remedy, NAMES.image
    is_outdated = f"{image.status} === 'OUTDATED'"
    return f"""<div class="ussim-advice" id="advice" role="status" v-if="{is_outdated} || {advice}">
      <span :title="{advice}">
      {{{{ {is_outdated} ? 'The image is outdated: ' + {image.differs} + ' changed' : {advice} }}}}</span>
      <button v-if="{is_outdated} || {remedy}" class="ussim-button" id="remedy"
      @click="trigger('remedy', [{is_outdated}])">{{{{ {is_outdated} ? 'Simulate' : {remedy} }}}}</button>
      <button v-if="!({is_outdated})" class="ussim-icon" id="dismiss-advice" title="Do not show this again"
      aria-label="Dismiss" @click="trigger('dismiss_advice')"><i class="mdi mdi-close"></i></button></div>"""


# ---- beside the image ------------------------------------------------------------------------------------------------


def _probes() -> str:
    """A button with the imaged field of each probe."""
    chosen = value_of("probePresetComboBox")
    return "".join(
        f"""<button class="ussim-probe" id="probe-{name}" :aria-pressed="{chosen} === '{shown}'"
        title="{shown}, {PROBES[name].frequency_mhz:g} MHz" @click="trigger('set', ['probePresetComboBox', '{shown}'])">
        {_field_picture(PROBES[name])}{shown}<small>{PROBES[name].frequency_mhz:g} MHz</small></button>"""
        for shown, name in SHOWN_PROBES.items()
    )


def _field_picture(probe: Probe) -> str:
    """An outline of the imaged field, of all probes in the same box."""
    outline = probe.outline_mm(9)[:, :2]
    low, size = outline.min(axis=0), np.ptp(outline, axis=0)
    scaled = (outline - low - [0.5 * size[0], 0.0]) * min(38.0 / size[0], 26.0 / size[1]) + [20.0, 1.0]
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in scaled)
    return f'<svg viewBox="0 0 40 28" aria-hidden="true"><polygon points="{points}"/></svg>'


def _console(controls: dict[str, Control]) -> str:
    live, image = value_of("liveCheckBox"), NAMES.image
    tools = "".join(
        f"""<button class="ussim-item" id="tool-{name}" title="{tip}" @click="window.ussim.tool('{name}')">{label}
        <small>{tip}</small></button>"""
        for name, label, tip in _TOOLS
    )
    beside = "".join(slider_html(controls[name]) for name in _BESIDE)
    tgc = "".join(upright_html(controls[name]) for name in _TGC)
    names = ",".join(_TGC)
    return f"""<div class="ussim-buttons">
    <button class="ussim-button wide" id="live" :aria-pressed="!{live}" title="Freeze or live (space, F)"
      :disabled="{NAMES.panel.can}.liveCheckBox === false" @click="trigger('freeze')">
      {{{{ {live} ? 'Freeze' : 'Live' }}}}</button>
    <details class="ussim-menu" id="measure"><summary>Measure</summary><div>{tools}</div></details>
    <button class="ussim-button" id="compare" title="Real ultrasound beside, blinking or subtracted (C)"
      :disabled="{NAMES.sequence.length} === 0" @click="trigger('compare_next')">Compare</button></div>
    {beside}
    <div class="ussim-tgc" role="group" aria-label="TGC at eight depths">{tgc}
      <input type="range" class="ussim-upright master" id="tgc-master" min="-20" max="20" step="1" value="0"
      aria-label="TGC master" title="All eight together" data-names="{names}"
      @input="window.ussim.tgcMaster($event.target)" @change="$event.target.value = 0"></div>
    {"".join(control_html(controls[name]) for name in _BELOW_TGC)}
    <div class="ussim-buttons">
    <button class="ussim-button" id="dual" title="Keep this image beside the next ones"
      @click="window.ussim.dual()" :disabled="!{image.status}">Dual</button>
    <button class="ussim-button" id="fit-view" title="Whole image: no zoom, not moved (0)"
      @click="window.ussim.fitView()">Whole</button>
    <button class="ussim-button" id="flip" title="Left and right exchanged" @click="window.ussim.flip('x')">Flip ⇄
      </button>
    <button class="ussim-button" id="flip-depth" title="Upside down" @click="window.ussim.flip('y')">Flip ⇅</button>
    <button class="ussim-button wide" id="place"
      title="Move the probe to the opening of the skull, or to the default place on the brain"
      :disabled="{NAMES.panel.can}.placeButton === false" @click="trigger('press', ['placeButton'])">
      Place at craniotomy</button></div>"""


# ---- the image -------------------------------------------------------------------------------------------------------


def _screens(keys: tuple[str, ...]) -> str:
    there, mode = f"{NAMES.sequence.length} > 0", NAMES.sequence.comparison
    beside, blink, over = (
        f"{mode} === '{chosen.value}'"
        for chosen in (ComparisonMode.BESIDE, ComparisonMode.BLINK, ComparisonMode.DIFFERENCE)
    )
    title = NAMES.messages.progress_title
    wait = f'<div v-if="{title} && !{NAMES.image.status}" class="ussim-wait" id="wait">{{{{ {title} }}}} …</div>'
    lines = f'<div v-for="(value, name) in {NAMES.image.values}">{{{{ name }}}} {{{{ value }}}}</div>'
    outline = f"""<svg v-if="{NAMES.sequence.mask} && {mode} !== '{ComparisonMode.SIMULATED.value}'" class="ussim-mask"
        :viewBox="{NAMES.sequence.box}" preserveAspectRatio="none"><path :d="{NAMES.sequence.mask}"/></svg>"""
    frame = f'<div class="ussim-frame">{outline}{cross_hair(IMAGE)}</div>'
    screen = """<div class="ussim-screen" data-screen="{name}" {more}>{canvas}<svg class="ussim-overlay"
        role="img" aria-label="Ruler and measurements of the {name} image"></svg>{frame}{words}</div>"""
    return (
        screen.format(
            name="simulated", more="", frame=frame,
            canvas=f"""<canvas data-stream="simulated" data-keys="{escape(" ".join(keys))}"></canvas>
            <canvas data-stream="real-over" v-show="{there} && ({blink} || {over})"
            :class="{{blink: {blink}, difference: {over}}}"></canvas>""",
            words=f"""<div class="ussim-corner" id="image-values">{lines}
            <div v-if="{there} && {over}">minus real {{{{ {NAMES.sequence.name} }}}}</div></div>{wait}""",
        )
        + screen.format(
            name="real", frame=frame.replace(">", f' v-show="{NAMES.sequence.is_placed}">', 1),
            more=f'v-show="{there} && {beside}"', canvas='<canvas data-stream="real"></canvas>',
            words=f'<div class="ussim-corner">Real, {{{{ {NAMES.sequence.name} }}}}</div>',
        )
        + screen.format(
            name="best", frame="", canvas='<canvas data-stream="best"></canvas>',
            more=f'v-show="{NAMES.fit.best} && {NAMES.messages.progress_title} === `Fit`"',
            words=f'<div class="ussim-corner" id="best-caption">{{{{ {NAMES.fit.best} }}}}</div>',
        )
        + screen.format(
            name="kept", frame="", more="hidden", canvas='<canvas data-stream="kept"></canvas>',
            words='<div class="ussim-corner" id="kept-caption"></div>',
        )
    )  # fmt: skip


def _player() -> str:
    """The bars of the real images and of the cine."""
    sequence, cine = NAMES.sequence, NAMES.cine
    modes = "".join(
        f"""<button class="ussim-button" id="compare-{mode.value.lower()}" :aria-pressed="{sequence.comparison} ===
        '{mode.value}'" @click="{sequence.comparison} = '{mode.value}'">{mode.value}</button>"""
        for mode in ComparisonMode
    )
    return f"""<div class="ussim-bar" id="player" v-if="{sequence.length} > 0">
      <button class="ussim-icon" id="play" @click="trigger('play')"
      :aria-label="{sequence.playing} ? 'Stop the sequence' : 'Play the sequence'">
      <i class="mdi" :class="{sequence.playing} ? 'mdi-pause' : 'mdi-play'"></i></button>
      <input type="range" id="sequence-slider" min="0" :max="Math.max({sequence.length} - 1, 1)" step="1"
      :value="{sequence.number}" aria-label="Image of the sequence"
      @input="trigger('show_number', [Number($event.target.value)])">
      <span id="sequence-text">Real {{{{ {sequence.name} }}}} ({{{{ {sequence.numbers} }}}})</span>
      <span role="group" aria-label="Comparison" id="comparison">{modes}</span>
      <span id="similarity" title="Cost of the paper for the simulated and the real image; 0 if they are equal">
      {{{{ {sequence.similarity} && {sequence.is_elsewhere} ? 'the probe is not at this image'
      : {sequence.similarity} }}}}</span></div>
    <div class="ussim-bar" id="cine-none" v-if="{cine.length} === 1 && {NAMES.image.status} === 'FROZEN'">
      No cine: in the last 10 s nothing moved, or depth or probe changed</div>
    <div class="ussim-bar" id="cine" v-if="{cine.length} > 1 && {NAMES.image.status} === 'FROZEN'">
      <button class="ussim-icon" id="cine-play" :aria-label="{cine.playing} ? 'Stop the cine' : 'Play the cine'"
      @click="trigger('cine_play')"><i class="mdi" :class="{cine.playing} ? 'mdi-pause' : 'mdi-play'"></i></button>
      <input type="range" id="cine-slider" min="0" :max="{cine.length} - 1" step="1" :value="{cine.index}"
      aria-label="Image of the cine" @input="trigger('cine_show', [Number($event.target.value)])">
      <span id="cine-text">{{{{ {cine.source} === 'live' ? {cine.index} + 1 + ' of ' + {cine.length} :
      'Simulated image ' + {cine.index} + ' (0 to ' + ({cine.length} - 1) + ')' }}}},
      {{{{ {cine.seconds}.toFixed(1) }}}} s
      </span>
      <button class="ussim-button" id="cine-from" title="The cine begins here"
      @click="trigger('cine_trim', [{cine.index}, {cine.last}])">[ From</button>
      <button class="ussim-button" id="cine-to" title="The cine ends here"
      @click="trigger('cine_trim', [{cine.first}, {cine.index}])">To ]</button>
      <button class="ussim-button" id="cine-source" v-if="{cine.sequence_length} > 0"
      title="The last seconds, or the images of Simulate sequence"
      @click="trigger('cine_source', [{cine.source} === 'live' ? 'sequence' : 'live'])">
      {{{{ {cine.source} === 'live' ? 'Simulated sequence' : 'Last seconds' }}}}</button></div>"""


def _foot() -> str:
    messages, percent = NAMES.messages, NAMES.messages.progress_percent
    return f"""<span v-if="{messages.progress_title}" id="progress">{{{{ {messages.progress_title} }}}}
      {{{{ {percent} ? {percent} + ' %' : '…' }}}} {{{{ {messages.progress_s} }}}} s
      <progress :value="{percent} || undefined" max="100" aria-label="Progress"></progress>
      <button class="ussim-button" id="cancel" @click="trigger('cancel')">Cancel</button></span>
      <span id="upload" hidden><span id="upload-text"></span>
      <button id="upload-cancel" class="ussim-button">Cancel</button></span>
      <span id="status">{{{{ {messages.status} }}}}</span>
      <span class="ussim-space"></span>
      <span v-if="{messages.tracker}" id="tracker">{{{{ {messages.tracker} }}}}</span>
      <span v-if="{NAMES.show_latency}" id="ussim-latency"></span>
      <span id="under-mouse">{{{{ {NAMES.views.under_mouse} }}}}</span>"""


# ---- the drawer ------------------------------------------------------------------------------------------------------


def _drawer(panel: BrowserPanel) -> None:
    for section in panel.sections:
        is_open = "open" if section.title == "Patient" else ""
        name = section.title.replace(" ", "-").lower()
        with html.Details(id=f"section-{name}", raw_attrs=[is_open] if is_open else []):
            html.Summary(section.title)
            if section.title == "Patient":
                html.Div(_open_file())
            if section.title == SECTION:
                registration()
            shown = [one for one in section.controls if one.widget not in {*NOT_SHOWN, *_BESIDE, *_BELOW_TGC}]
            html.Div("".join(map(control_html, shown)))
            if section.title == "Probe":
                html.Div("".join(_pose_slider(*slider) for slider in _POSE_SLIDERS) + _upright())
                pose_numbers()
            if section.title.startswith("Fit"):
                html.Div(_cost_curve())


def _open_file() -> str:
    tip = (
        "Also dropped on the page: MRI, CT, label map (with its table), mask, DICOM, tracked ultrasound, calibration, "
        "registration, sheets (.vtp), scene (.mrb), preset, pose. The page recognises them by their content"
    )
    sent = "window.ussim.send($event.target, {for: 'open'})"
    return f"""<div class="ussim-line" title="{tip}"><label for="open-file">Open files</label>
      <input type="file" multiple id="open-file" @change="{sent}"></div>
      <div class="ussim-line" title="DICOM images; the page asks which of several series"><label for="open-folder">
      Open a folder</label><input type="file" webkitdirectory id="open-folder" @change="{sent}"></div>
      <div id="opened" class="ussim-opened" aria-live="polite">
      <div v-for="line in {NAMES.opened}">{{{{ line }}}}</div></div>
      <button class="ussim-button" id="close-patient" @click="trigger('close_patient')" :disabled="{NAMES.title} === ''"
      title="Nothing of the patient stays on the page, in the scene or in memory; settings stay">Close patient
      </button>"""


def _pose_slider(name: str, *shown: Any) -> str:
    moved = f"trigger('set_pose', ['{name}', Number($event.target.value)])"
    return range_html(f"({NAMES.pose}?.{name} ?? null)", f"pose-{name}", moved, *shown)


def _upright() -> str:
    return f"""<label class="ussim-tick" title="While it slides; otherwise it keeps its angles to the normal">
      <input type="checkbox" id="upright" :checked="{NAMES.upright}" @change="{NAMES.upright} = $event.target.checked">
      Keep the probe along the surface normal</label>"""


def _cost_curve() -> str:
    curve = NAMES.fit.curve
    return f"""<div v-if="{curve}.length > 1" id="cost-curve"><v-sparkline :model-value="{curve}" color="orange"
      :line-width="1.5" :padding="4" :height="70" :smooth="false"></v-sparkline></div>"""


def _messages() -> None:
    with html.Div(classes="ussim-messages"):
        v3.VAlert(
            "{{ message }}", v_for=f"(message, n) in {NAMES.messages.errors}", key=("message + n",), type="error",
            density="compact", closable=True, classes="mb-1 ussim-error",
            update_modelValue="trigger('dismiss', [n])",
        )  # fmt: skip
