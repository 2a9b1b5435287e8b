"""The sections of the panel, from which Slicer and the browser generate their widgets.

Declared parameters with Parameter.shown are included automatically: those of probe, display and settings in Probe,
Ultrasound and Rays, those of SegmentationSettings and FitSettings in Inputs and Fit. A button needs an entry here, with
the method of a presenter. Any other value needs a declaration in mrml/parameter_node.py.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

from SlicerUSSim.Logic.base.declaration import Parameter, Shown, parameters_of
from SlicerUSSim.Logic.imaging.preset import preset_parameters
from SlicerUSSim.Logic.mrml.fit_nodes import COMPARED
from SlicerUSSim.Logic.mrml.parameter_node import SceneParameters, SettingsParameter
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.tissue import TISSUE_PARAMETERS
from SlicerUSSim.Widget.interface import Can, Control, Kind, Row, Section
from SlicerUSSim.Widget.presenter import PanelPresenter
from SlicerUSSim.Widget.value_presenter import CUSTOM_PROBE, OPTIONAL, SCENE, SHOWN_PROBES, value_parameter

#: Values of the probe that are adjusted while viewing the image; shown in Ultrasound.
_CONSOLE = ("probe.depth_mm", "probe.frequency_mhz", "probe.focus_mm")
#: What decides which sheets images show, whose tissue the tissues then have
_DRAWN = tuple(f"{SCENE}.{name}" for name in SceneParameters.sheet.values)


def panel_sections(panel: PanelPresenter) -> tuple[Section, ...]:
    """The sections in order, with the actions of a presenter."""
    return (
        Section("Inputs", True, _inputs(panel)),
        Section("Sheets and vessels", False, _sheets()),
        Section("Lesions", False, _lesions(panel)),
        Section("Probe", True, _probe(panel)),
        Section("Craniotomy", False, _craniotomy(panel)),
        Section("Ultrasound", True, (*_of_preset("display"), *values(*_CONSOLE))),
        Section("Tissues", False, _tissues(panel)),
        Section("Rays", False, _of_preset("settings")),
        Section("Sequence", False, _sequence(panel)),
        Section("Fit to real ultrasound", False, _fit(panel)),
        Section("Output", True, _output(panel)),
    )


def _inputs(panel: PanelPresenter) -> tuple[Row, ...]:
    return (
        node("mri", "MRI", "MRI of a whole head, or of a skull-stripped brain"),
        node(
            "mask", "Mask", "Brain mask: a segmentation, or a label map on the MRI's grid; none: Segment extracts the "
            "brain from a whole head, and keeps its mask here",
        ),
        node(
            "second_mri", "Second MRI", "Another MRI of the same patient, on any grid, such as T2 or FLAIR: "
            "registered to the first and classified together with it",
        ),
        value("scene.second_contrast"),
        *_of_scene(SceneParameters.segmentation),
        node(
            "organs", "Organs of a CT", "Label map or segmentation of organs of a CT (contrast ct), such as "
            "TotalSegmentator's, on any grid: its soft tissues replace muscle and blood",
        ),
        node(
            "labels", "Tissues", "Segmentation or label map of the tissues: the output of Segment, or your own with "
            "names of tissues (csf, grey matter, white matter, tumour, blood, skull, ...)", new_node="Tissues",
        ),
        node(
            "lesions", "Lesions", "Segmentation whose segments are called tumour, oedema, necrosis, cyst, haematoma, "
            "cavity or as another tissue, on any grid; Segment and Add to tissues lay them over the tissues, the last "
            "on top", new_node="Lesions",
        ),
        (
            button(
                "segment", "Segment", "Segment the tissues of the MRI (some seconds), and lay the lesions over them; "
                "tissues that were not made by Segment, or edited since, are kept: the result is then a new node",
                panel.segmenting.segment, panel.segmenting.canSegment,
            ),
            button(
                "undoSegment", "Undo Segment",
                "Go back to tissues, mask, sheets and notes from before the last Segment",
                panel.segmenting.undoSegment, panel.segmenting.canUndoSegment,
            ),
            button(
                "addTissues", "Add to tissues",
                "Lay the lesions over these tissues; tissues that were not made by Segment, or edited since, are kept: "
                "the result is then a new node", panel.lesions.addTissues, panel.lesions.canAddTissues,
            ),
        ),
        Control(
            "notes", "words", tip="What was found in the MRI, what was done, and what to check",
            shows=panel.notes.text, depends=("probe", "settings", "tissues", "scene.gel"),
        ),
    )  # fmt: skip


def _sheets() -> tuple[Row, ...]:
    return (
        *_of_scene(SceneParameters.sheet),
        node(
            "sheets", "Sheets", "Model of the thin sheets that images show: those that Segment found, or a .vtp of "
            "ussim segment --sheets; none: the lines of the labels",
        ),
    )  # fmt: skip


def _lesions(panel: PanelPresenter) -> tuple[Row, ...]:
    return (
        node("seed", "Point", "Markups whose last point lies in the lesion", new_node="Lesion"),
        value("scene.lesion_as"),
        value("scene.lesion_size"),
        (
            button(
                "pickSeed", "Show the point",
                "Then click in the lesion, in a slice view: the lesion around it is added to the lesions",
                panel.lesions.pickSeed, panel.lesions.canGrow,
            ),
            button(
                "growAtPoint", "Grow at point",
                "Add the lesion around the point to the lesions; Add to tissues lays them over the tissues",
                panel.lesions.growAtPoint, panel.lesions.canGrowAtPoint,
            ),
            button(
                "removeGrown", "Remove", "Take the lesion that was grown last out of the lesions",
                panel.lesions.removeGrown, panel.lesions.canRemove,
            ),
        ),
    )  # fmt: skip


def _probe(panel: PanelPresenter) -> tuple[Row, ...]:
    return (
        Control(
            "probePreset", "choice", "Preset",
            "Geometry and frequency of a typical probe: "
            + ", ".join(f"{shown} {PROBES[name].frequency_mhz:g} MHz" for shown, name in SHOWN_PROBES.items()),
            choices=(CUSTOM_PROBE, *SHOWN_PROBES), shows=panel.values.probeName, sets=panel.values.chooseProbe,
            depends=("probe",),
        ),
        *values(*(name for name in _probe_values() if name not in _CONSOLE)),
        node(
            "probe_transform", "Transform", "Linear transform of the probe [mm]: x to the right of the image, y along "
            "its depth, origin in the middle of the probe face", new_node="Probe",
        ),
        (
            button(
                "place", "Place on surface at this slice",
                "Place the probe on the surface of the tissues, in the plane of the selected slice view, pointing down "
                "in the view", panel.placing.placeProbe, panel.canSimulate,
            ),
            Control("sliceView", "choice", tip="Slice view in which the probe is placed and the image is shown"),
        ),
        (
            button(
                "placeAtView", "Place at view",
                "Place the probe where the view on the right is seen from, on the skin if it is labelled",
                panel.placing.placeAtView, panel.canSimulate,
            ),
            value("scene.view"),
        ),
        value("scene.show_in_slice"),
        value("scene.gel"),
    )  # fmt: skip


def _craniotomy(panel: PanelPresenter) -> tuple[Row, ...]:
    return (
        value("scene.craniotomy_mm"),
        node(
            "opening", "Opening", "What is opened instead of a disc under the probe: a closed curve or other markups, "
            "whose points are a polygon over the skin, or a label map or segmentation",
        ),
        (
            button(
                "openCraniotomy", "Open skull", "Replace skin, scalp and skull in the opening by the coupling medium, "
                "in new labels; the tissues need them, as Segment makes them with Label what is outside the brain",
                panel.placing.openCraniotomy, panel.placing.canOpenCraniotomy,
            ),
            button(
                "closeCraniotomy", "Close skull", "Go back to the labels without the opening",
                panel.placing.closeCraniotomy, panel.placing.canCloseCraniotomy,
            ),
        ),
    )  # fmt: skip


def _tissues(panel: PanelPresenter) -> tuple[Row, ...]:
    columns = [f"{entry.symbol} [{entry.unit}]" if entry.unit else entry.symbol for entry in TISSUE_PARAMETERS]
    return (
        Control(
            "tissue", "table",
            tip=f"Acoustic and scatterer parameters of each tissue: {', '.join(columns)}; double-click to edit; "
            "the tool tip of a value is its source", depends=("tissues", *_DRAWN),
        ),
        (
            Control("tissuePreset", "choice", tip="Tissue to copy to the selected line", choices=tuple(TISSUES)),
            button(
                "assignTissue", "Use for selected line",
                "Copy the parameters of the tissue on the left to the selected line", panel.tissues.assignTissue,
            ),
            button("resetTissues", "Reset", "Reset all tissues to the presets", panel.tissues.resetTissues),
        ),
    )  # fmt: skip


def _sequence(panel: PanelPresenter) -> tuple[Row, ...]:
    return (
        node("transform_sequence", "Transforms", "Recorded sequence of probe transforms"),
        node("image_sequence", "Images", "Sequence for the simulated images; none: a new one", new_node="Ultrasound"),
        button(
            "simulateSequence", "Simulate sequence",
            "Simulate one image for each transform; the same sequence browser plays them",
            panel.images.simulateSequence, panel.canSimulate,
        ),
        node(
            "path", "Path", "Curve or line of Markups on the patient, along which the probe moves, its image planes "
            "across the path",
        ),
        button(
            "sweepAlongPath", "Sweep along path",
            "Simulate an image every millimetre of the path, as a sequence, and compound them to a volume",
            panel.images.sweepAlongPath, panel.canSimulate,
        ),
    )  # fmt: skip


def _fit(panel: PanelPresenter) -> tuple[Row, ...]:
    return (
        node(
            "real", "Real images", "Real ultrasound: a sequence of tracked images with its browser, a volume of one "
            "slice, or a 3D volume, which is resliced in the image plane",
        ),
        *_of_scene(SceneParameters.fit),
        Control(
            "free", "list", "Free",
            "Parameters that the fit varies; its result marks those that the images do not determine",
            depends=("tissues", "scene.fit_free", *_DRAWN),
        ),
        (
            button(
                "fit", "Fit", "Adjust the free parameters so that simulated images match the real ones",
                panel.fits.fit, panel.fits.canFit,
            ),
            button(
                "applyFit", "Apply", "Adopt the fitted probe, display and tissues; Save preset saves them",
                panel.fits.apply, panel.fits.canApply,
            ),
            button(
                "revertFit", "Revert", "Restore the values from before Apply, except those changed since",
                panel.fits.revert, panel.fits.canRevert,
            ),
        ),
        Control("fit", "words", tip="Result of the last fit", shows=lambda: panel.fits.summary),
        Control(
            "compare", "choice", "Show", "Image of the fit in the slice view: real, simulated, or their difference "
            "(grey: zero); the real image is in the background, and the view's opacity slider blends the two",
            choices=tuple(COMPARED), enabled=panel.fits.canCompare,
        ),
        Control(
            "compareNumber", "choice", "Image", "Number of the fitted image in the slice view",
            enabled=panel.fits.canCompare,
        ),
        Control(
            "blink", "tick", "Blink", "Alternate between real and simulated image twice a second",
            enabled=panel.fits.canCompare,
        ),
    )  # fmt: skip


def _output(panel: PanelPresenter) -> tuple[Row, ...]:
    return (
        node(
            "output", "Ultrasound", "Volume for the image, placed under the probe's transform; none: a new one",
            new_node="Ultrasound",
        ),
        node("outline", "Outline", "Model for the imaged field; none: a new one", new_node="Ultrasound outline"),
        (
            button(
                "simulate", "Simulate", "Simulate one image at the pose of the probe",
                panel.images.simulate, panel.canSimulate,
            ),
            Control(
                "live", "tick", "Live", "Update the image when the probe or a parameter changes",
                shows=panel.images.isLive, sets=panel.images.setLive, enabled=panel.canSimulate,
            ),
        ),
        (
            button(
                "loadPreset", "Load preset...",
                "Load probe, ultrasound, tissues and rays from a JSON file of this module or the ussim command",
                panel.values.loadPreset,
            ),
            button(
                "savePreset", "Save preset...",
                "Save probe, ultrasound, tissues and rays to a JSON file for this module and the ussim command",
                panel.values.savePreset,
            ),
        ),
        value("scene.preset_pose"),
        Control("status", "words", tip="Images per second, or a warning"),
    )  # fmt: skip


def _of_preset(section: str) -> tuple[Control, ...]:
    return values(*(name for name in preset_parameters() if name.startswith(f"{section}.")))


def _probe_values() -> list[str]:
    """Names of the probe's values; those of only some kinds come before those of all kinds."""
    shared = {f"probe.{entry.name}" for entry in parameters_of(Probe)}
    return sorted((name for name in preset_parameters() if name.startswith("probe.")), key=lambda name: name in shared)


def _of_scene(settings: SettingsParameter) -> tuple[Control, ...]:
    return values(*(f"{SCENE}.{name}" for name in settings.values))


# ---- controls --------------------------------------------------------------------------------------------------------


def value(name: str) -> Control:
    """The control for a declared value: slider, number, tick, choice or text, depending on the declaration."""
    declared = value_parameter(name)
    kind: Kind = "text"
    if isinstance(declared.shown, Shown):
        kind = "slider" if declared.shown.is_slider else "number"
    elif declared.choices:
        kind = "choice"
    elif declared.type is bool:
        kind = "choice" if declared.can_be_none else "tick"
    widget = _camel_case(_without_unit(declared))
    choices = tuple(OPTIONAL) if kind == "choice" and declared.type is bool else declared.choices
    decides = ("probe.kind", "probe.transmit") if name.startswith("probe.") else ()  # which values the probe has
    result = Control(
        widget, kind, declared.label, declared.tip, name, declared, choices=choices, depends=(name, *decides)
    )
    if isinstance(declared.shown, Shown):
        span = f"{declared.shown.low:.10g} to {declared.shown.high:.10g}{result.suffix}"
        result = replace(result, tip=f"{declared.tip} ({span})")
    return result


def values(*names: str) -> tuple[Control, ...]:
    """The controls for those of the named values that panels show."""
    return tuple(value(name) for name in names if value_parameter(name).shown)


def node(role: str, label: str, tip: str, new_node: str = "") -> Control:
    """The node selector for a role of SceneParameters."""
    return Control(_camel_case(role), "node", label, tip, node=role, new_node=new_node)


def button(name: str, label: str, tip: str, action: Callable[..., object], enabled: Can | None = None) -> Control:
    """A button."""
    return Control(name, "button", label, tip, action=action, enabled=enabled)


def _without_unit(declared: Parameter) -> str:
    """The name without the suffix of its unit: gain for gain_db."""
    unit = "deg" if declared.unit == "°" else re.sub(r"[^a-z]+", "_", declared.unit.lower()).strip("_")
    return declared.name.removesuffix(f"_{unit}") if unit else declared.name


def _camel_case(name: str) -> str:
    first, *more = name.split("_")
    return first + "".join(word.capitalize() for word in more)
