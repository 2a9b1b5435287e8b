"""The part of the page with the pose of the probe as numbers and files."""

from __future__ import annotations

from trame.widgets import html, vuetify3 as v3

from SlicerUSSim.Workstation.pose_entry import POSE_SUFFIXES
from SlicerUSSim.Workstation.state import NAMES

_NUMBERS_TIP = (
    "R, A, S of the middle of the probe's face in mm, and its angles about these axes in degrees (turned about R, then "
    "A, then S; all 0: its depth towards A, its columns towards R)"
)
_MATRIX_TIP = "4x4 matrix from the probe to RAS by rows; columns: lateral, depth, elevational, position in mm"
#: What the formats are for
_FORMATS = {".json": "for ussim --pose", ".tfm": "ITK, 3D Slicer", ".h5": "ITK, 3D Slicer", ".mat": "ITK",
            ".txt": "16 numbers"}  # fmt: skip


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
