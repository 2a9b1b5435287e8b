"""python_script: a Python script that reproduces the image on the screen, pixel by pixel."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pprint import pformat
from textwrap import indent
from typing import Any

import numpy as np

from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mri.masks import SEVERAL
from SlicerUSSim.Logic.mri.segmentation_settings import CT
from SlicerUSSim.Logic.tissue.presets import TISSUES

_TEMPLATE = '''"""Reproduces an image of a SlicerUSSim workstation."""
{missing}
import numpy as np

from SlicerUSSim.Logic import {imports}
from SlicerUSSim.Logic.imaging.preset import Preset
{more_imports}
{labels}
preset = Preset.from_dict(
    {preset}
)
probe_to_ras = np.array({pose})

simulator = UltrasoundSimulator(labels, preset.tissues, preset.settings{texture}{sheets})
frame = simulator.simulate(preset.probe, probe_to_ras, preset.display, noise_seed={seed})
frame.to_volume().write("image.nrrd")  # frame.image is a (rows, columns) uint8 array
print(frame.image.shape, "pixels, mean", frame.image.mean())
'''


@dataclass(frozen=True)
class LabelSource:
    """Source of labels: a label file, or the segmentation of an MRI."""

    #: File of the MRI or of the labels; "" is the demo brain. Of files without a path, which were opened in a page, the
    #: name
    path: str
    is_labels: bool = False
    #: File of the mask, if one was used
    mask: str | None = None
    #: Other arguments of segment_mri
    options: dict = field(default_factory=dict)
    #: {label in the file: the simulator's number}
    relabelled: Mapping[int, int] = field(default_factory=dict)
    #: Of labels 1, 2, ... in a label file, in the simulator's numbers
    tissue_names: tuple[str, ...] = ()
    #: {contrast: file} of further MRIs
    others: Mapping[str, str] = field(default_factory=dict)
    #: Kinds of sheets that Segment looked for
    sheets: tuple[str, ...] = ()
    #: (tissue, file) of the masks added on top
    additions: tuple[tuple[str, str], ...] = ()
    #: Of a craniotomy: diameter of the disc, mm, and the (4, 4) pose of the probe in the frame of the labels
    disc: tuple[float, np.ndarray] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        values = asdict(self)
        values["relabelled"] = [[int(old), int(new)] for old, new in self.relabelled.items()]
        if self.disc is not None:
            values["disc"] = [float(self.disc[0]), np.asarray(self.disc[1]).tolist()]
        return values

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> LabelSource:
        """The inverse of to_dict, also after JSON. Raises TypeError or ValueError for other values."""
        disc = values.get("disc")
        return cls(
            **{
                **values,
                "relabelled": {int(old): int(new) for old, new in values.get("relabelled", ())},
                "tissue_names": tuple(values.get("tissue_names", ())),
                "sheets": tuple(values.get("sheets", ())),
                "additions": tuple((str(tissue), str(file)) for tissue, file in values.get("additions", ())),
                "disc": None if disc is None else (float(disc[0]), np.array(disc[1], float)),
            }
        )

    @property
    def missing(self) -> tuple[str, ...]:
        """The files whose place is not known."""
        files = (self.path, self.mask, *self.others.values(), *(file for _, file in self.additions))
        return tuple(dict.fromkeys(file for file in files if file and not os.path.isabs(file)))


def python_script(
    source: LabelSource,
    preset: Preset,
    probe_to_ras: np.ndarray,
    sheets: Sequence[str] | str = (),
    number: int | None = None,
) -> str:
    """A script that simulates an image of these labels with `preset`, whose tissues are by label, at a pose (4, 4).

    `sheets` are the kinds of those that Segment found which the image shows, or the file with all that it shows.
    `number` is that of an image of a sequence, the seed of its noise; otherwise that follows from the pose.
    """
    imports, more, lines = ["UltrasoundSimulator", *(["seed_of_pose"] if number is None else [])], "", []
    is_demo, is_ct = not source.path, source.options.get("contrast") == CT
    if is_demo:
        more = "from SlicerUSSim.Logic.mri.samples import demo_mri\n"
        lines.append("mri, _ = demo_mri()")
    else:
        imports.append("Volume")
        lines.append(f"{'labels' if source.is_labels else 'mri'} = Volume.read({source.path!r})")
    if source.is_labels:
        if any(old != new for old, new in source.relabelled.items()):
            lines += [
                f"numbers = np.zeros({max(source.relabelled) + 1}, np.uint8)",
                f"numbers[{list(source.relabelled)}] = {list(source.relabelled.values())}",
                "labels = labels.with_array(numbers[labels.array.astype(int)])",
            ]
    else:
        function, values = "segment_mri", source.options
        if is_ct:
            function, values = "segment_ct", {name: values[name] for name in ("filter_radius", "filter_epsilon")}
        imports.append(function)
        options = [f"{name}={value!r}" for name, value in values.items()]
        if source.mask is not None:
            imports.append("Volume")
            options.append(f"mask=Volume.read({source.mask!r})")
        if source.others:
            imports.append("Volume")
            others = ", ".join(f"{name!r}: Volume.read({path!r})" for name, path in source.others.items())
            options.append(f"others={{{others}}}")
        lines += [f"segmentation = {function}({', '.join(['mri', *options])})", "labels = segmentation.labels"]
    texture, names = "segmentation.texture()", "segmentation.tissue_names"
    if source.is_labels:
        names = repr(list(source.tissue_names))
    surfels = ""
    if source.sheets:
        more += "from SlicerUSSim.Logic.mri import add_tissues\nfrom SlicerUSSim.Logic.mri.sheets import find_sheets\n"
        lines += [
            f"kinds, contrast = {source.sheets!r}, {source.options['contrast']!r}",
            "sheets = find_sheets(mri, segmentation, contrast=contrast, kinds=kinds)",
            f"added = add_tissues(labels, {names}, sheets.masks(), has_brain_mask=True)",
            "labels = added.labels",
        ]
        names = "added.tissue_names"
    if isinstance(sheets, str):
        more += "from SlicerUSSim.Logic.mri.sheets.polydata import read_surfels\n"
        surfels = f", sheets=read_surfels({sheets!r})"
    elif source.sheets and sheets:
        surfels = f", sheets=sheets.surfels.of_kind({', '.join(map(repr, sheets))})"
    if source.additions:
        more += "from SlicerUSSim.Logic.mri import add_tissues, read_mask\n"
        masks = ", ".join(f"({name!r}, read_mask({path!r}), {path!r})" for name, path in source.additions)
        own = [tissue.name for tissue in preset.tissues.all_tissues()]
        also = [name for name, _ in source.additions if name in own and name not in TISSUES]
        if any(name in SEVERAL for name, _ in source.additions):
            lines.append("# The page has one segment for each tissue of a BraTS map; borders may differ by a voxel.")
        more_options = (f", also={also!r}" if also else "") + (
            "" if source.is_labels or is_ct else ", has_brain_mask=True"
        )
        lines += [f"added = add_tissues(labels, {names}, [{masks}]{more_options})", "labels = added.labels"]
        names = "added.tissue_names"
    if source.disc is not None:
        more += "from SlicerUSSim.Logic.placement.craniotomy import disc_opening, opened\n"
        diameter, pose = source.disc
        lines += [
            f"opening = disc_opening(labels, {names}, np.array({_array(pose)}), {diameter!r})",
            f"labels, _ = opened(labels, {names}, opening)",
        ]
    is_changed = bool(source.additions) or bool(source.sheets) or source.disc is not None
    if is_changed:
        texture = f"texture_below({texture}, mri, segmentation.labels, labels)"
    settings = preset.settings
    needs_texture = (settings.needs_texture or settings.partial_volume is not False) and not source.is_labels
    if needs_texture and is_changed:
        more += "from SlicerUSSim.Logic.mri.pathology import texture_below\n"
    return _TEMPLATE.format(
        missing="".join(
            f"# Opened in a page; give its path below, or run this beside it: {name!r}\n" for name in source.missing
        ),
        imports=", ".join(sorted(set(imports))),
        more_imports=more,
        labels="\n".join(lines),
        preset=indent(pformat(_plain(preset), width=112, sort_dicts=False), "    ").strip(),
        pose=_array(probe_to_ras),
        seed="seed_of_pose(probe_to_ras)" if number is None else number,
        texture=f", texture={texture}" if needs_texture else "",
        sheets=surfels,
    )


def _array(matrix: np.ndarray) -> str:
    return np.array2string(matrix, separator=", ", floatmode="unique", max_line_width=118)


def _plain(preset: Preset) -> dict:
    """The preset as in its JSON file, which has only values that Python can write as literals."""
    return json.loads(json.dumps(preset.to_dict()))
