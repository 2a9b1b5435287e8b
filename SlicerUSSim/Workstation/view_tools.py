"""The views of the anatomy on the page, with what is shown over them: tools, letters of the sides, linked cross-hair.

static/views.js folds, maximises and swaps them, by classes of the body: `ussim-folded` (no views), `ussim-max-NAME` (one
view fills the column), `ussim-swap-NAME` (a view and the ultrasound image have changed places). static/views.css does
the rest, with .ussim-main as a grid of the areas rail, stage, console, and one per view.
"""

from __future__ import annotations

from trame.widgets import client, html, vuetify3 as v3
from trame_server import Server
from trame_slicer.views import AbstractView

from SlicerUSSim.Workstation.state import NAMES, PLANES, SLICE_VIEWS, THREED

#: Names of the views as users know them, by Slicer's, and the colours of their marks
_TITLES = {THREED: "3D", "Red": "red", "Green": "green"}
#: What changes the arrangement: name in views.js, icon, and what it does with a view
_ARRANGE = (
    ("max", "mdi-arrow-expand-vertical", "Let the {} view fill the column"),
    ("swap", "mdi-swap-horizontal", "Let the {} view and the ultrasound image change places"),
)


def anatomy_column(server: Server) -> None:
    """The 3D view and the slice views, one above the other."""
    for name in (THREED, *SLICE_VIEWS):
        with html.Div(classes="ussim-view", id=f"view-{name}"):
            client.ServerTemplate(name=server.translator.translate_key(name))


def view_tools(_server: Server, _view_id: str, view: AbstractView) -> None:
    """What is over a view: a selector of its plane or a camera button, buttons that arrange it, letters, cross-hair."""
    name = view.get_singleton_tag()
    with html.Div(classes="ussim-view-tool"):
        if name in SLICE_VIEWS:
            html.Div(classes=f"ussim-stripe bg-{_TITLES[name]}")
            options = "".join(f"<option>{plane}</option>" for plane in PLANES)
            html.Div(
                f"""<select :value="{NAMES.views.planes}['{name}']" id="plane-{name}"
                    aria-label="Plane of the {_TITLES[name]} view"
                    @change="trigger('plane', ['{name}', $event.target.value])">{options}</select>"""
            )
        else:
            _button("look", "mdi-camera-flip-outline", "Turn the camera to the probe", "trigger('look')")
        v3.VSpacer()
        for kind, icon, tip in _ARRANGE:
            _button(f"{kind}-{name}", icon, tip.format(_TITLES[name]), f"window.ussim.arrange('{kind}', '{name}')")
    if name in SLICE_VIEWS:
        letters = f"{NAMES.views.letters}['{name}']"
        sides = ("left", "right", "top", "bottom")
        html.Div("".join(f'<b class="{side}">{{{{ {letters}?.[{n}] }}}}</b>' for n, side in enumerate(sides)),
                 classes="ussim-letters")  # fmt: skip
    html.Div(cross_hair(name))


def cross_hair(name: str) -> str:
    """HTML of the mark of the point under the mouse in a view; faint if it is more than 1 mm beside its plane."""
    at = f"{NAMES.views.cross}['{name}']"
    return f"""<div v-if="{at}" class="ussim-cross" :class="{{beside: {at}?.[2] > 1}}"
        :style="{{left: 100 * {at}?.[0] + '%', top: 100 * {at}?.[1] + '%'}}"></div>"""


def _button(name: str, icon: str, tip: str, click: str) -> None:
    with v3.VBtn(
        icon=True, size="x-small", variant="text", click=click, id=name, title=tip, raw_attrs=[f'aria-label="{tip}"'],
    ):  # fmt: skip
        v3.VIcon(icon)
