"""Layout of the page: the panel's sections (left), the ultrasound image (middle), the anatomy and the probe (right).

The page is built from trame's widgets, which are bound to fields of state.PageState through their NAMES. Actions of the
user reach the workstation as calls of methods, as triggers by name (Workstation._answer_pages), and as changes of those
fields.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from pathlib import Path

from trame.ui.vuetify3 import VAppLayout
from trame.widgets import html, vuetify3 as v3
from trame_server import Server

from SlicerUSSim.Widget.image_presenter import FROZEN
from SlicerUSSim.Widget.interface import Control
from SlicerUSSim.Widget.tissue_presenter import TISSUE_COLUMNS
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.page_parts import offer, pose_numbers, question_dialog, registration
from SlicerUSSim.Workstation.pose_registration import SECTION
from SlicerUSSim.Workstation.state import IMAGE, NAMES, ComparisonMode, value_of
from SlicerUSSim.Workstation.view_tools import anatomy_column, cross_hair

_STATIC = Path(__file__).parent / "static"
#: Files that the page loads in addition to those of trame.
MODULE = {
    "serve": {"ussim": str(_STATIC)},
    "scripts": ["ussim/overlay.js", "ussim/workstation.js", "ussim/views.js"],
    "styles": ["ussim/workstation.css", "ussim/views.css"],
}
#: Controls of the panel that are not on the page: its views follow the probe and show it, it compares the fit in the
#: ultrasound view, it has a button of its own to place the probe, and no editor of segments.
NOT_SHOWN = {
    "sliceViewComboBox", "showInSliceCheckBox", "showIn3dCheckBox", "showProbeCheckBox", "layoutButton",
    "compareComboBox", "compareNumberComboBox", "blinkCheckBox", "statusLabel", "placeButton", "editTissuesButton",
}  # fmt: skip
#: JavaScript of buttons that act on the page, by widget name.
_IN_PAGE = {
    "savePresetButton": "window.ussim.save('json')",
    "loadPresetButton": "window.document.getElementById('open-file').click()",
}


@dataclass(frozen=True)
class PoseSlider:
    """The slider of one component of the probe's pose."""

    #: Field of surface.SurfacePose
    name: str
    label: str
    tip: str
    minimum: float
    maximum: float
    step: float
    unit: str


POSE_SLIDERS = (
    PoseSlider("right_deg", "Left - right", "Position on the head, from its vertex", -120, 120, 0.5, "°"),
    PoseSlider("front_deg", "Back - front", "Position on the head, from its vertex", -120, 120, 0.5, "°"),
    PoseSlider("rotate_deg", "Rotate", "About the probe's axis (keys Q, E; Ctrl and drag)", -180, 180, 1.0, "°"),
    PoseSlider("rock_deg", "Rock", "In the image plane (keys A, D; Shift and drag)", -75, 75, 0.5, "°"),
    PoseSlider("tilt_deg", "Tilt", "Out of the image plane (keys W, S; Shift and drag)", -75, 75, 0.5, "°"),
    PoseSlider("lift_mm", "Lift", "Off the surface; negative: pressed in (keys +, -)", -10, 30, 0.5, "mm"),
)
_EXPORTS = {
    "png": "Image (PNG)", ".nrrd": "Image with geometry (NRRD)", ".mha": "Image with geometry (MHA)",
    ".vti": "Image with geometry (VTI)", "gif": "Cine of the last images (GIF)", "mrb": "Scene for 3D Slicer (MRB)",
    "json": "Settings (JSON)",
}  # fmt: skip

#: In the browser's tab
_PROGRAM = "SlicerUSSim"


def build_page(server: Server, panel: BrowserPanel, keys: tuple[str, ...]) -> None:
    """Build the page of a server. `keys` are the keys sent to the server."""
    server.enable_module(MODULE)
    server.state.trame__title = _PROGRAM

    @server.state.change(NAMES.title)
    def show_in_tab(**values: object) -> None:
        title = values.get(NAMES.title)
        server.state.trame__title = f"{title} - {_PROGRAM}" if title else _PROGRAM

    with VAppLayout(server) as page:
        page.root.theme = "dark"
        with v3.VNavigationDrawer(permanent=True, width=376, disable_resize_watcher=True, disable_route_watcher=True):
            _drawer(panel)
        with v3.VMain(style="height: 100vh"), html.Div(classes="ussim-main"):
            with html.Div(classes="ussim-stage"):
                offer()
                _tools()
                _screens(keys)
                _player()
                _status(panel)
            with html.Div(classes="ussim-anatomy"):
                anatomy_column(server)
        _messages()
        question_dialog()


# ---- left ------------------------------------------------------------------------------------------------------------


def _drawer(panel: BrowserPanel) -> None:
    html.Div("Ultrasound Simulator", classes="text-subtitle-1 px-4 pt-2")
    html.Div(f"{{{{ {NAMES.title} }}}}", classes="text-caption px-4 pb-1 text-medium-emphasis", id="title")
    with v3.VExpansionPanels(multiple=True, v_model=(NAMES.open_sections,), variant="accordion"):
        # First what is used while one looks at the image
        for section in sorted(panel.sections, key=lambda section: section.title != "Ultrasound"):
            with v3.VExpansionPanel(value=section.title):
                v3.VExpansionPanelTitle(section.title, style="min-height: 36px; font-size: 13px")
                with v3.VExpansionPanelText(eager=True, id=f"section-{section.title.replace(' ', '-').lower()}"):
                    if section.title == "Patient":
                        _open_file()
                    if section.title == SECTION:
                        registration()
                    for control in section.controls:
                        if control.widget not in NOT_SHOWN:
                            _control(control, panel)
                    if section.title == "Probe":
                        _pose_sliders(panel)
                        pose_numbers()
                    if section.title.startswith("Fit"):
                        _cost_curve()


def _open_file() -> None:
    html.Div(
        """<label for="open-file">Open files</label>
        <input type="file" multiple id="open-file" @change="window.ussim.send($event.target, {for: 'open'})">""",
        classes="ussim-line",
        title="Also dropped on the page: MRI, CT, label map (with its table), mask, DICOM, tracked ultrasound, its "
        "calibration or registration, sheets (.vtp), a scene (.mrb), preset, pose. What they are is recognised by "
        "their content",
    )  # fmt: skip
    html.Div(
        """<label for="open-folder">Open a folder</label>
        <input type="file" webkitdirectory id="open-folder"
        @change="window.ussim.send($event.target, {for: 'open'})">""",
        classes="ussim-line", title="Of DICOM images; of several series the one is asked",
    )  # fmt: skip
    html.Div(
        f"""<div v-for="line in {NAMES.opened}">{{{{ line }}}}</div>""", id="opened", classes="ussim-opened",
        raw_attrs=['aria-live="polite"'],
    )  # fmt: skip
    v3.VBtn(
        "Close patient", size="small", classes="mb-1", id="close-patient", click="trigger('close_patient')",
        title="Nothing of the patient stays on the page, in the scene or in memory; settings stay",
        disabled=(f"{NAMES.title} === ''",),
    )  # fmt: skip


def _control(control: Control, panel: BrowserPanel) -> None:
    name, kind, low, high = control.widget, control.kind, control.range.low, control.range.high
    key = value_of(name)
    disabled = f"{NAMES.panel.can}.{name} === false"
    if kind == "slider":
        # Values of a loaded preset can exceed the slider's range.
        _slider(
            key, name, control.label, control.tip, f"Math.min({low}, {key} ?? 0)", f"Math.max({high}, {key} ?? 0)",
            control.range.step, control.unit, control.decimals, (panel.set, f"['{name}', $event]"),
        )  # fmt: skip
    elif kind in ("number", "text"):
        unit = f" [{control.unit}]" if control.unit else ""
        value = "Number($event.target.value)" if kind == "number" else "$event.target.value"
        shown = f"{key} === null ? '' : +Number({key}).toFixed({control.decimals})" if kind == "number" else key
        limits = f'min="{low:.10g}" max="{high:.10g}" step="{control.range.step:g}"'
        limits = limits if kind == "number" else ""
        none_at = control.range.none_at
        if kind == "number" and none_at is not None:  # an empty field, and not a number that means it
            limits += ' placeholder="none"'
            shown = f"{key} === null || {key} <= {none_at:.10g} ? '' : +Number({key}).toFixed({control.decimals})"
            value = "$event.target.value === '' ? null : Number($event.target.value)"
        html.Div(
            f"""<label for="{name}">{escape(control.label)}{unit}</label>
            <input type="{kind}" id="{name}" {limits}
            :value="{shown}" :disabled="{key} === null" @change="trigger('set', ['{name}', {value}])">""",
            classes="ussim-line", title=control.tip,
        )  # fmt: skip
    elif kind == "tick":
        with html.Div(title=control.tip):  # a title of the check box would not apply to its label
            v3.VCheckbox(
                label=control.label, model_value=(key,), density="compact", hide_details=True, id=name,
                update_modelValue=(panel.set, f"['{name}', $event]"), disabled=(disabled,),
            )  # fmt: skip
    elif kind in ("choice", "node"):
        if kind == "node":  # an HTML option cannot be null: "" is no node
            items = f"{NAMES.panel.nodes}.{name} ?? []"
            options = f"""<option v-for="item in ({items})" :value="item.value ?? ''">{{{{ item.title }}}}
            </option>"""
        else:
            options = f"""<option v-for="item in {NAMES.panel.choices}.{name}">{{{{ item }}}}</option>"""
        html.Div(
            f"""<label for="{name}">{escape(control.label)}</label>
            <select id="{name}" :value="{key} ?? ''" aria-label="{escape(control.label or control.tip)}"
            @change="trigger('set', ['{name}', $event.target.value])">{options}</select>""",
            classes="ussim-line", title=control.tip,
        )  # fmt: skip
    elif kind == "button":
        v3.VBtn(
            control.label, size="small", classes="ma-1", id=name,
            click=_IN_PAGE.get(name) or (panel.press, f"['{name}']"), disabled=(disabled,),
            title=(f"{NAMES.panel.tips}.{name} ?? `{control.tip}`",),
        )  # fmt: skip
    elif kind == "words":
        html.Div(f"{{{{ {key} }}}}", id=name, style="white-space: pre-line; font-size: 12px", title=control.tip)
    elif kind == "table":
        _tissue_table(control)
    else:
        html.Div(
            f"""<div style="font-size: 12px">{control.label}</div><div class="ussim-free" id="{name}">
            <label v-for="entry in {NAMES.fit.free}" style="display: block"><input type="checkbox" :checked="entry.on"
            :aria-label="entry.label" @change="trigger('set_free', [entry.name, $event.target.checked])">
            {{{{ entry.label }}}}</label></div>""",
            title=control.tip,
        )


def _slider(
    key: str, name: str, label: str, tip: str, minimum: str, maximum: str, step: float, unit: str, decimals: int,
    event: str | tuple[Callable[..., object], str],
) -> None:  # fmt: skip
    """A slider with its value beside it; `key`, `minimum` and `maximum` are JavaScript expressions."""
    with html.Div(classes="ussim-slider", title=tip):
        html.Div(label)
        v3.VSlider(
            model_value=(f"{key} ?? {minimum}",), min=(minimum,), max=(maximum,), step=step, density="compact",
            name=label, hide_details=True, thumb_size=12, track_size=2, disabled=(f"{key} === null",),
            id=f"slider-{name}", update_modelValue=event,
        )  # fmt: skip
        html.Div(f"{{{{ {key} === null ? '' : Number({key}).toFixed({decimals}) }}}} {unit}", classes="value")


def _tissue_table(control: Control) -> None:
    heads = "".join(f'<th title="{tip}">{head}</th>' for _, head, tip in TISSUE_COLUMNS)
    names = ", ".join(f"'{parameter}'" for parameter, _, _ in TISSUE_COLUMNS)
    html.Div(
        f"""<table class="ussim-table" id="{control.widget}"><tr><th>Tissue</th>{heads}</tr>
        <tr v-for="row in {NAMES.panel.tissues}" :class="{{chosen: row.name === {NAMES.panel.chosen_tissue}}}"
        @click="{NAMES.panel.chosen_tissue} = row.name">
        <td>{{{{ row.name }}}}</td>
        <td v-for="(value, n) in row.values"><input :value="value" :title="row.sources[n]"
        :aria-label="row.name + ' ' + [{names}][n]"
        @change="trigger('set_tissue', [row.name, [{names}][n], $event.target.value])"></td></tr></table>""",
        title=control.tip,
    )


def _pose_sliders(panel: BrowserPanel) -> None:
    v3.VDivider(classes="my-1")
    for slider in POSE_SLIDERS:
        _slider(
            f"({NAMES.pose}?.{slider.name} ?? null)", f"pose-{slider.name}", slider.label, slider.tip,
            str(slider.minimum), str(slider.maximum), slider.step, slider.unit, 1,
            f"trigger('set_pose', ['{slider.name}', $event])",
        )  # fmt: skip
    v3.VCheckbox(
        label="Keep the probe along the surface normal", v_model=(NAMES.upright,), density="compact", hide_details=True,
        title="While it slides; otherwise it keeps its angles to the normal", id="upright",
    )  # fmt: skip
    v3.VBtn(
        "Place at craniotomy", size="small", classes="ma-1", id="place", click=(panel.press, "['placeButton']"),
        disabled=(f"{NAMES.panel.can}.placeButton === false",),
        title="Coronal view through a parasagittal craniotomy, or into the opening, aimed at a tumour below it",
    )  # fmt: skip
    v3.VBtn(
        "Align with normal", size="small", classes="ma-1", click="trigger('key', ['Home', false])", id="stand-upright"
    )


def _cost_curve() -> None:
    with html.Div(v_if=f"{NAMES.fit.curve}.length > 1", id="cost-curve"):
        v3.VSparkline(
            model_value=(NAMES.fit.curve,), color="orange", line_width=1.5, padding=4, height=70, smooth=False,
            fill=False,
        )  # fmt: skip
        html.Div(f"{{{{ {NAMES.fit.costs} }}}}", classes="text-caption")


# ---- middle ----------------------------------------------------------------------------------------------------------


def _tools() -> None:
    live = value_of("liveCheckBox")
    with html.Div(classes="ussim-tool"):
        with v3.VBtn(
            icon=True, size="small", variant="text", id="live",
            title="Live or frozen", raw_attrs=['aria-label="Live"', f':aria-pressed="{live}"'],
            disabled=(f"{NAMES.panel.can}.liveCheckBox === false",),
            click=f"trigger('set', ['liveCheckBox', !{live}])", color=(f"{live} ? 'success' : undefined",),
        ):  # fmt: skip
            v3.VIcon(icon=(f"{live} ? 'mdi-play-circle' : 'mdi-snowflake'",))
        v3.VSpacer()
        html.Div("Blend", classes="text-caption")
        v3.VSlider(
            v_model=(NAMES.views.blend,), min=0, max=1, step=0.05, density="compact", hide_details=True, thumb_size=12,
            track_size=2, style="max-width: 90px; min-width: 60px", id="blend", name="Blend of image and MRI",
        )  # fmt: skip
        for state, name, icon, tip in (
            (NAMES.views.show_tissues, "show-tissues", "mdi-palette", "Colour the tissues in the slice views"),
            (NAMES.views.follow, "follow", "mdi-crosshairs-gps", "Let the slice views follow the probe"),
            (NAMES.show_latency, "show-latency", "mdi-timer-outline", "Measure images per second and latency"),
        ):
            with v3.VBtn(
                icon=True, size="small", variant="text", click=f"{state} = !{state}", id=name,
                title=tip, raw_attrs=[f'aria-label="{tip}"', f':aria-pressed="{state}"'],
                color=(f"{state} ? 'primary' : undefined",),
            ):  # fmt: skip
                v3.VIcon(icon)
        with v3.VMenu():
            with v3.Template(v_slot_activator="{ props }"):
                v3.VBtn("Export", size="small", v_bind="props", prepend_icon="mdi-download", id="export")
            with v3.VList(density="compact"):
                for kind, words in _EXPORTS.items():
                    v3.VListItem(title=words, click=f"window.ussim.save('{kind}')", id=f"export-{kind.strip('.')}")


def _screens(keys: tuple[str, ...]) -> None:
    there, mode = f"{NAMES.sequence.length} > 0", NAMES.sequence.comparison
    beside, blink, over = (
        f"{mode} === '{chosen.value}'"
        for chosen in (ComparisonMode.BESIDE, ComparisonMode.BLINK, ComparisonMode.DIFFERENCE)
    )
    simulated = f"{mode} === '{ComparisonMode.SIMULATED.value}'"
    with html.Div(classes=(f"{{'ussim-screens': true, 'ussim-stacked': {there} && {beside}}}",)):
        with html.Div(classes="ussim-screen"):
            simulated_too = f"<span>{{{{ {there} && !({simulated}) ? 'Simulated, ' : '' }}}}</span>"
            html.Div(f'{simulated_too}<span id="image-caption"></span>', classes="ussim-caption")
            html.Div(
                FROZEN, v_show=NAMES.is_frozen, classes="ussim-frozen", id="frozen",
                title="The image does not follow the probe: it stays where it was taken",
            )  # fmt: skip
            with html.Div(classes="ussim-frame", id="ultrasound"):
                html.Div(f'<canvas data-stream="simulated" data-keys="{escape(" ".join(keys))}"></canvas>')
                html.Div(
                    f"""<canvas data-stream="real-over" :class="{{blink: {blink}, difference: {over}}}"></canvas>""",
                    v_show=f"{there} && ({blink} || {over})",
                )
                html.Div((_STATIC / "overlay.html").read_text())
                cross_hair(IMAGE)
        with html.Div(classes="ussim-screen", v_show=f"{there} && {beside}"):
            html.Div(f"Real, {{{{ {NAMES.sequence.name} }}}}", classes="ussim-caption")
            with html.Div(classes="ussim-frame", id="real"):
                html.Div('<canvas data-stream="real"></canvas>')


def _player() -> None:
    number, length = NAMES.sequence.number, NAMES.sequence.length
    with html.Div(classes="ussim-bar", v_if=f"{length} > 0"):
        with v3.VBtnToggle(
            v_model=(NAMES.sequence.comparison,), density="compact", mandatory=True, id="comparison", divided=True
        ):
            for mode in ComparisonMode:
                v3.VBtn(mode.value, value=mode.value, size="small", id=f"compare-{mode.value.lower()}")
        html.Div(
            f"{{{{ {NAMES.sequence.similarity} }}}}", classes="ussim-similarity", id="similarity",
            title="Cost of the paper for the simulated and the real image; 0 if they are equal",
        )  # fmt: skip
    with html.Div(classes="ussim-bar", v_if=f"{length} > 0", id="player"):
        with v3.VBtn(
            icon=True, size="x-small", variant="text", click="trigger('play')", id="play",
            raw_attrs=[f""":aria-label="{NAMES.sequence.playing} ? 'Stop the sequence' : 'Play the sequence'\""""],
        ):  # fmt: skip
            v3.VIcon(icon=(f"{NAMES.sequence.playing} ? 'mdi-pause' : 'mdi-play'",))
        v3.VSlider(
            model_value=(number,), min=0, max=(f"Math.max({length} - 1, 1)",), step=1, density="compact",
            hide_details=True, thumb_size=12, track_size=2, id="sequence-slider", name="Image of the sequence",
            update_modelValue="trigger('show_number', [$event])",
        )  # fmt: skip
        html.Div(f"{{{{ {number} + 1 }}}} of {{{{ {length} }}}}", style="white-space: nowrap", id="sequence-text")
    simulated = NAMES.simulated
    with html.Div(classes="ussim-bar", v_if=f"{simulated.length} > 0", id="simulated-player"):
        with v3.VBtn(
            icon=True, size="x-small", variant="text", click="trigger('play_simulated')", id="play-simulated",
            title="Images of Simulate sequence; live images pause",
            raw_attrs=[f""":aria-label="({simulated.playing} ? 'Stop' : 'Play') + ' the simulated sequence'\""""],
        ):  # fmt: skip
            v3.VIcon(icon=(f"{simulated.playing} ? 'mdi-pause' : 'mdi-play'",))
        v3.VSlider(
            model_value=(simulated.number,), min=0, max=(f"Math.max({simulated.length} - 1, 1)",), step=1,
            density="compact", hide_details=True, thumb_size=12, track_size=2, id="simulated-slider",
            name="Image of the simulated sequence", update_modelValue="trigger('show_simulated', [$event])",
        )  # fmt: skip
        html.Div(
            f"Simulated {{{{ {simulated.number} + 1 }}}} of {{{{ {simulated.length} }}}}", style="white-space: nowrap",
            id="simulated-text",
        )  # fmt: skip


def _status(panel: BrowserPanel) -> None:
    messages = NAMES.messages
    with html.Div(classes="ussim-bar"):
        with html.Div(
            v_if=messages.progress_title, style="display: flex; gap: 8px; align-items: center", id="progress"
        ):
            # Readers of files tell no share of what they have done
            percent = messages.progress_percent
            share = f"{{{{ {percent} ? {percent} + ' %' : '…' }}}}"
            html.Span(f"{{{{ {messages.progress_title} }}}} {share} {{{{ {messages.progress_s} }}}} s")
            v3.VProgressLinear(
                model_value=(percent,), indeterminate=(f"{percent} === 0",), color="orange", style="width: 140px"
            )
            v3.VBtn("Cancel", size="x-small", click=(panel.cancel, "[]"), id="cancel")
        html.Div(
            """<span id="upload" hidden><span id="upload-text"></span>
            <button id="upload-cancel" class="ussim-plain">Cancel</button></span>"""
        )
        html.Span(f"{{{{ {messages.status} }}}}", id="status")
        v3.VSpacer()
        html.Span(f"{{{{ {NAMES.views.under_mouse} }}}}", id="under-mouse")
        html.Span(f"{{{{ {messages.tracker} }}}}", v_if=messages.tracker, id="tracker")
        html.Span(v_if=NAMES.show_latency, id="ussim-latency")  # workstation.js measures while it exists


def _messages() -> None:
    with html.Div(style="position: fixed; bottom: 44px; left: 400px; z-index: 3000; max-width: 60vw"):
        v3.VAlert(
            "{{ message }}", v_for=f"(message, n) in {NAMES.messages.errors}", key=("n",), type="error",
            density="compact", closable=True, classes="mb-1 ussim-error",
            update_modelValue="trigger('dismiss', [n])",
        )  # fmt: skip
