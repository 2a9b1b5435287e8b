"""HTML of the panel's controls: one element of the page for each Control of Widget/sections.py.

The elements are bound to fields of state.PageState through their NAMES, and call the server by trigger().
"""

from __future__ import annotations

from html import escape

from SlicerUSSim.Widget.interface import Control
from SlicerUSSim.Widget.tissue_presenter import TISSUE_COLUMNS
from SlicerUSSim.Workstation.state import NAMES, value_of

#: JavaScript of buttons that act on the page, by widget name.
_IN_PAGE = {
    "savePresetButton": "window.ussim.save('json')",
    "loadPresetButton": "window.document.getElementById('open-file').click()",
}


def kept(*fields: object) -> str:
    """Leaves what a user types alone until one of these fields changes, or an error is shown: then it is as before.

    Without it Vue sets fields to their values whenever anything on the page changes.
    """
    return f'v-memo="[{", ".join(map(str, fields))}, {NAMES.messages.errors}]"'


def control_html(control: Control) -> str:
    """The element of a control."""
    name, key = control.widget, value_of(control.widget)
    disabled = f"{NAMES.panel.can}.{name} === false"
    tip, label = escape(control.tip), escape(control.label)
    if control.kind == "slider":
        return slider_html(control)
    if control.kind in ("number", "text"):
        unit = f" [{control.unit}]" if control.unit else ""
        return _line(name, f"{label}{unit}", tip, _field(control))
    if control.kind == "tick":
        tick = f"trigger('set', ['{name}', $event.target.checked])"
        return f"""<label class="ussim-tick" title="{tip}"><input type="checkbox" id="{name}" :checked="{key}"
            :disabled="{disabled}" @change="{tick}"> {label}</label>"""
    if control.kind in ("choice", "node"):
        if control.kind == "node":  # an HTML option cannot be null: "" stands for None
            options = f"""<option v-for="item in ({NAMES.panel.nodes}.{name} ?? [])" :value="item.value ?? ''">
                {{{{ item.title }}}}</option>"""
        else:
            options = f"""<option v-for="item in {NAMES.panel.choices}.{name}">{{{{ item }}}}</option>"""
        chosen = f"trigger('set', ['{name}', $event.target.value])"
        select = f"""<select id="{name}" :value="{key} ?? ''" aria-label="{label or tip}"
            @change="{chosen}">{options}</select>"""
        return _line(name, label, tip, select)
    if control.kind == "button":
        pressed = _IN_PAGE.get(name) or f"trigger('press', ['{name}'])"
        return f"""<button class="ussim-button" id="{name}" :disabled="{disabled}" @click="{pressed}"
            :title="{NAMES.panel.tips}.{name} ?? `{tip}`">{label}</button>"""
    if control.kind == "words":
        lines = f"""v-for="line in ({key} ?? '').split('\\n')" :class="{{faint: line.includes('(not determined')}}\""""
        return f"""<div id="{name}" class="ussim-words" title="{tip}"><div {lines}>{{{{ line }}}}</div></div>"""
    if control.kind == "picture":
        return f"""<button class="ussim-button ussim-picture" id="{name}" v-show="{key}" title="{tip}"
            :disabled="{disabled}" @click="trigger('press', ['{name}'])"><img :src="{key}" alt="">{label}</button>"""
    if control.kind == "table":
        return _tissue_table(control)
    return f"""<div title="{tip}">{label}<div class="ussim-free" id="{name}">
        <label v-for="entry in {NAMES.fit.free}" style="display: block"><input type="checkbox" :checked="entry.on"
        :aria-label="entry.label" @change="trigger('set_free', [entry.name, $event.target.checked])">
        {{{{ entry.label }}}}</label></div></div>"""


def slider_html(control: Control) -> str:
    """A slider with its value, which can be typed, and its unit."""
    name, shown = control.widget, control.range
    return range_html(
        value_of(name), name, f"trigger('set', ['{name}', Number($event.target.value)])", control.label, control.tip,
        shown.low, shown.high, shown.step, control.unit, control.decimals,
    )  # fmt: skip


def range_html(
    key: str, name: str, event: str, label: str, tip: str, low: float, high: float, step: float, unit: str,
    decimals: int = 1,
) -> str:  # fmt: skip
    """A slider with a field for its value; `key` and `event` are JavaScript. Values of presets can exceed its range."""
    value = f"{key} === null ? '' : Number({key}).toFixed({decimals})"
    limits = f""":min="Math.min({low}, {key} ?? {low})" :max="Math.max({high}, {key} ?? {high})" step="{step:g}" """
    return f"""<div class="ussim-slider" title="{escape(tip)}" {kept(key)}><label for="{name}">{escape(label)}</label>
        <span><input type="number" id="{name}" min="{low:.10g}" max="{high:.10g}" step="{step:g}" :value="{value}"
        :disabled="{key} === null" @change="{event}"> {unit}</span>
        <input type="range" id="slider-{name}" aria-label="{escape(label)}" {limits} :value="{key} ?? {low}"
        :disabled="{key} === null" @input="{event}"></div>"""


def upright_html(control: Control) -> str:
    """A slider that stands upright, one of several side by side."""
    name, key, shown = control.widget, value_of(control.widget), control.range
    return f"""<input type="range" class="ussim-upright" id="tgc-{name}" min="{shown.low:g}" max="{shown.high:g}"
        step="{shown.step:g}" :value="{key} ?? 0" aria-label="{escape(control.label)}"
        :title="`{escape(control.label)}: ${{{key}}} {control.unit}`" {kept(key)}
        @input="trigger('set', ['{name}', Number($event.target.value)])">"""


def _field(control: Control) -> str:
    name, key, shown = control.widget, value_of(control.widget), control.range
    if control.kind == "text":
        value, entered, limits = key, "$event.target.value", ""
    else:
        none, entered = f"{key} === null", "Number($event.target.value)"
        limits = f'min="{shown.low:.10g}" max="{shown.high:.10g}" step="{shown.step:g}"'
        if shown.none_at is not None:  # an empty field, and not a number that means it
            limits += ' placeholder="none"'
            none += f" || {key} <= {shown.none_at:.10g}"
            entered = f"$event.target.value === '' ? null : {entered}"
        value = f"{none} ? '' : +Number({key}).toFixed({control.decimals})"
    return f"""<input type="{control.kind}" id="{name}" {limits} :value="{value}" :disabled="{key} === null" {kept(key)}
        @change="trigger('set', ['{name}', {entered}])">"""


def _line(name: str, label: str, tip: str, element: str) -> str:
    return f"""<div class="ussim-line" title="{tip}"><label for="{name}">{label}</label>{element}</div>"""


def _tissue_table(control: Control) -> str:
    heads = "".join(f'<th title="{escape(tip)}">{head}</th>' for _, head, tip in TISSUE_COLUMNS)
    names = ", ".join(f"'{parameter}'" for parameter, _, _ in TISSUE_COLUMNS)
    memo = kept(NAMES.panel.tissues, NAMES.panel.chosen_tissue)
    return f"""<table class="ussim-table" id="{control.widget}" title="{escape(control.tip)}" {memo}>
        <tr><th>Tissue</th>{heads}
        </tr><tr v-for="row in {NAMES.panel.tissues}" :class="{{chosen: row.name === {NAMES.panel.chosen_tissue}}}"
        @click="trigger('choose_tissue', [row.name])">
        <td>{{{{ row.name }}}}</td>
        <td v-for="(value, n) in row.values"><input :value="value" :title="row.sources[n]"
        :aria-label="row.name + ' ' + [{names}][n]"
        @change="trigger('set_tissue', [row.name, [{names}][n], $event.target.value])"></td></tr></table>"""
