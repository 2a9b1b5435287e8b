"""The sections of the panel, from which Slicer and the browser generate their widgets.

The first three are one screen in the order of work, the others are closed at first. Declared parameters with
Parameter.shown are included automatically: those of display and probe in Beam and display, those of settings and
SegmentationSettings in Advanced, those of FitSettings in Fit. A button needs an entry here, with the method of a
presenter, or an action of the view (Panel, BrowserPanel). Any other value needs a declaration in
mrml/parameter_node.py.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

from SlicerUSSim.Logic.base.declaration import Parameter, Shown
from SlicerUSSim.Logic.imaging.preset import preset_parameters
from SlicerUSSim.Logic.mrml.fit_nodes import COMPARED
from SlicerUSSim.Logic.mrml.parameter_node import SceneParameters
from SlicerUSSim.Logic.probe.arrays import PROBES
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Widget.interface import Can, Control, Kind, Row, Section, tr as _
from SlicerUSSim.Widget.presenter import PanelPresenter
from SlicerUSSim.Widget.tissue_presenter import COLUMN_PARAMETERS
from SlicerUSSim.Widget.value_presenter import CUSTOM_PROBE, SCENE, SHOWN_PROBES, value_parameter

#: Values that are adjusted while viewing the image
_CONSOLE = (
    "display.gain_db", "probe.depth_mm", "display.dynamic_range_db", "probe.frequency_mhz", "probe.focus_mm",
    "display.tgc_db_cm_mhz",
)  # fmt: skip
#: Values that have another place than the others of their dataclass
_ELSEWHERE = ("probe.scan_lines", "scene.contrast", "scene.outside")
#: What decides which sheets images show, whose tissue the tissues then have
_DRAWN = tuple(f"{SCENE}.{name}" for name in SceneParameters.sheet.values)


def panel_sections(panel: PanelPresenter) -> tuple[Section, ...]:
    """The sections in order, with the actions of a presenter."""
    return (
        Section(_("Patient"), True, _patient(panel)),
        Section(_("Probe"), True, _probe(panel)),
        Section(_("Ultrasound"), True, _ultrasound(panel)),
        Section(_("Lesions and other images"), False, _other_images(panel)),
        Section(_("Approach"), False, _approach(panel)),
        Section(_("Beam and display"), False, (*_of_preset("probe"), *_of_preset("display"))),
        Section(_("Tissues"), False, _tissues(panel)),
        Section(_("Tracked ultrasound"), False, _tracked(panel)),
        Section(_("Fit to real ultrasound"), False, _fit(panel)),
        Section(_("Advanced"), False, _advanced(panel)),
    )


def _patient(panel: PanelPresenter) -> tuple[Row, ...]:
    segmenting = panel.segmenting
    return (
        node("mri", _("MRI or CT"), _("MRI of a whole head or of a skull-stripped brain, or a CT")),
        value("scene.contrast"),
        (
            button(
                "segment", _("Segment"),
                _("Segment the tissues of the MRI (some seconds) and lay the lesions over them. Tissues that you made "
                  "or edited are kept: the result is then a new node"), segmenting.segment, segmenting.canSegment,
            ),
            button(
                "editTissues", _("Edit tissues..."), _("Open the tissues in the Segment Editor"),
                enabled=segmenting.canEdit,
            ),
            button(
                "undoSegment", _("Undo"), _("Go back to the tissues, mask and sheets from before the last Segment"),
                segmenting.undoSegment, segmenting.canUndoSegment,
            ),
        ),
        Control(
            "notes", "words", tip=_("What was found in the MRI, what was done, and what to check"),
            shows=panel.notes.text, depends=("tissues",),
        ),
    )  # fmt: skip


def _probe(panel: PanelPresenter) -> tuple[Row, ...]:
    placing = panel.placing
    probes = ", ".join(f"{shown} {PROBES[name].frequency_mhz:g} MHz" for shown, name in SHOWN_PROBES.items())
    return (
        Control(
            "probePreset", "choice", _("Preset"), _("Geometry and frequency of a typical probe: {probes}").format(
                probes=probes
            ), choices=(CUSTOM_PROBE, *SHOWN_PROBES), shows=panel.values.probeName, sets=panel.values.chooseProbe,
            depends=("probe",),
        ),
        (
            _("Standard view"), value("scene.view"),
            button(
                "placeAtView", _("Place at view"),
                _("Place the probe where the chosen view is seen from, on the skin if it is labelled"),
                placing.placeAtView, panel.canSimulate,
            ),
        ),
        (
            _("Slice view"),
            Control("sliceView", "choice", tip=_("Slice view in which the probe is placed and the image is shown")),
            button(
                "place", _("Place at slice"),
                _("Place the probe on the surface of the tissues, in the plane of the chosen slice view, pointing down "
                  "in the view"), placing.placeProbe, panel.canSimulate,
            ),
        ),
        (
            button(
                "openCraniotomy", _("Open skull"),
                _("Replace skin, scalp and skull in the opening by the coupling medium, in new labels; the tissues "
                  "need skin and skull: tick their box below Lesions and other images before Segment"),
                placing.openCraniotomy, placing.canOpenCraniotomy,
            ),
            button(
                "closeCraniotomy", _("Close skull"), _("Go back to the labels without the opening"),
                placing.closeCraniotomy, placing.canCloseCraniotomy,
            ),
        ),
        Control(
            "probeNotes", "words", tip=_("Where the probe is, its contact with the patient, and bone in front of it"),
            shows=panel.notes.aboutProbe, depends=("probe", "settings", "tissues", "scene.gel"),
        ),
    )  # fmt: skip


def _ultrasound(panel: PanelPresenter) -> tuple[Row, ...]:
    return (
        (
            Control(
                "live", "tick", _("Live"), _("Update the image when the probe or a parameter changes"),
                shows=panel.images.isLive, sets=panel.images.setLive, enabled=panel.canSimulate,
            ),
            button(
                "simulate", _("Single image"), _("Simulate one image at the pose of the probe"),
                panel.images.simulate, panel.canSimulate,
            ),
        ),
        Control("status", "words", tip=_("Images per second, or a warning")),
        *values(*_CONSOLE),
        (
            _("Show"), *values("scene.show_in_slice", "scene.show_in_3d", "scene.show_probe"),
            button(
                "layout", _("Layout"),
                _("Arrange the views for ultrasound: a large slice view beside the 3D view. Press again, or leave the "
                  "module, to get your layout back"),
            ),
        ),
    )  # fmt: skip


def _other_images(panel: PanelPresenter) -> tuple[Row, ...]:
    lesions = panel.lesions
    return (
        node(
            "labels", _("Tissues"), _("Segmentation or label map of the tissues: the output of Segment, or your own "
            "with names of tissues (csf, grey matter, white matter, tumour, blood, skull, ...)"),
            new_node=_("Tissues"),
        ),
        (
            _("Lesions"),
            node(
                "lesions", _("Lesions"), _("Segmentation whose segments are called tumour, oedema, necrosis, cyst, "
                "haematoma, cavity or as another tissue, on any grid; Segment and Add to tissues lay them over the "
                "tissues, the last on top"), new_node=_("Lesions"),
            ),
            button(
                "addTissues", _("Add to tissues"),
                _("Lay the lesions over these tissues; tissues that you made or edited are kept: the result is then a "
                  "new node"), lesions.addTissues, lesions.canAddTissues,
            ),
        ),
        (_("Grow lesion"), value("scene.lesion_as"), value("scene.lesion_size")),
        (
            button(
                "pickSeed", _("Grow at a click"),
                _("Then click in the lesion, in a slice view: the lesion around it is added to the lesions"),
                lesions.pickSeed, lesions.canGrow,
            ),
            button(
                "removeGrown", _("Remove grown lesion"), _("Remove the lesion that was grown last from the lesions"),
                lesions.removeGrown, lesions.canRemove,
            ),
        ),
        Control(
            "lesionNotes", "words", tip=_("What was grown last"), shows=panel.notes.aboutLesions, depends=("tissues",)
        ),
        node(
            "mask", _("Brain mask"), _("Segmentation, or label map on the MRI's grid; none: Segment extracts the brain "
            "from a whole head, and keeps its mask here"),
        ),
        value("scene.outside"),
        node(
            "second_mri", _("Second MRI"), _("Another MRI of the same patient, on any grid, such as T2 or FLAIR: "
            "registered to the first and classified together with it"),
        ),
        value("scene.second_contrast"),
        node(
            "organs", _("Organs of a CT"), _("Label map or segmentation of organs of a CT (contrast ct), such as "
            "TotalSegmentator's, on any grid: its soft tissues replace muscle and blood"),
        ),
        value("scene.sheet_find"),
        node(
            "sheets", _("Sheets"), _("Model of the thin sheets that images show: those that Segment found, or a .vtp "
            "of ussim segment --sheets; none: the lines of the labels"),
        ),
        value("scene.craniotomy_mm"),
        node(
            "opening", _("Opening"), _("What Open skull opens instead of a disc under the probe: a closed curve or "
            "other markups, whose points are a polygon over the skin, or a label map or segmentation"),
        ),
    )  # fmt: skip


def _approach(panel: PanelPresenter) -> tuple[Row, ...]:
    approach = panel.approach
    return (
        (
            _("Target"), value("scene.target"),
            button("plan", _("Plan"), _("Compare paths to the target (seconds)"), approach.plan, panel.canSimulate),
        ),
        Control(
            "approachNotes", "words", tip=_("The target, and what is known of the chosen candidate"),
            shows=approach.text, depends=("tissues",),
        ),
        tuple(
            Control(
                f"candidate{number + 1}", "picture", _("Candidate {number}").format(number=number + 1),
                _("Image with the outline of the target; press it to see path and opening in the views"),
                shows=partial(approach.picture, number), action=partial(approach.choose, number),
                enabled=partial(approach.canChoose, number), depends=("tissues",),
            )
            for number in range(3)  # as many as are offered
        ),
        button(
            "openHere", _("Open here"), _("Open the skull in the closed curve, and aim the probe from its middle"),
            approach.openHere, partial(approach.canChoose, 0),
        ),
        value("scene.keep_in_opening"),
    )  # fmt: skip


def _tissues(panel: PanelPresenter) -> tuple[Row, ...]:
    columns = [f"{entry.symbol} [{entry.unit}]" if entry.unit else entry.symbol for entry in COLUMN_PARAMETERS]
    tip = _("Acoustic and scatterer parameters of each tissue: {columns}; double-click to edit; a value's tool tip is "
            "its source")  # fmt: skip
    return (
        Control("tissue", "table", tip=tip.format(columns=", ".join(columns)), depends=("tissues", *_DRAWN)),
        (
            Control("tissuePreset", "choice", tip=_("Tissue to copy to the selected line"), choices=tuple(TISSUES)),
            button(
                "assignTissue", _("Use for selected line"),
                _("Copy the parameters of the tissue on the left to the selected line"),
            ),
            button("resetTissues", _("Reset"), _("Reset all tissues to the presets"), panel.tissues.resetTissues),
        ),
    )  # fmt: skip


def _tracker(panel: PanelPresenter) -> tuple[Row, ...]:
    """In Slicer only: the page has its own tracker, and a page must not name files of the server."""
    tracking = panel.tracking
    return (
        node("tracked", _("Tracked transform"), _("Pose of the sensor on the probe, such as ProbeToReference of Plus")),
        node(
            "calibration", _("Calibration"), _("ImageToProbe: from pixels of the real image to the sensor, mm; none: "
            "the text below"),
        ),
        *values("scene.calibration_text", "scene.face_pixel"),
        (
            button(
                "useCalibration", _("Use calibration"), _("Let the tracked transform move the probe's face, whose "
                "place follows from the calibration"), tracking.useCalibration,
            ),
            button(
                "sendImages", _("Send images"), _("Start an OpenIGTLink server that sends the image and the probe's "
                "transform (needs the extension SlicerOpenIGTLink)"), tracking.sendImages,
            ),
        ),
        Control("tracked", "words", tip=_("How the calibration was read"), shows=tracking.text),
    )  # fmt: skip


def _tracked(panel: PanelPresenter) -> tuple[Row, ...]:
    return (
        *(_tracker(panel) if panel.placing.handles else ()),
        node(
            "probe_transform", _("Probe transform"), _("Linear transform of the probe [mm], such as a tracker's: x to "
            "the right of the image, y along its depth, origin in the middle of the probe face"), new_node=_("Probe"),
        ),
        node("transform_sequence", _("Recorded poses"), _("Recorded sequence of probe transforms")),
        button(
            "simulateSequence", _("Simulate sequence"),
            _("Simulate one image for each recorded pose; the same sequence browser plays them"),
            panel.images.simulateSequence, panel.canSimulate,
        ),
        Control("sequence", "words", tip=_("Result of Simulate sequence"), shows=lambda: panel.images.sequenceDone),
        node(
            "path", _("Path"), _("Curve or line of Markups on the patient, along which the probe moves, its image "
            "planes across the path"),
        ),
        button(
            "sweepAlongPath", _("Sweep along path"),
            _("Simulate an image every millimetre of the path, as a sequence, and compound them to a volume"),
            panel.images.sweepAlongPath, panel.canSimulate,
        ),
    )  # fmt: skip


def _fit(panel: PanelPresenter) -> tuple[Row, ...]:
    fits = panel.fits
    return (
        node(
            "real", _("Real images"), _("Real ultrasound: a sequence of tracked images with its browser, a volume of "
            "one slice, or a 3D volume, which is resliced in the image plane"),
        ),
        *values(*(f"{SCENE}.{name}" for name in SceneParameters.fit.values)),
        Control(
            "free", "list", _("Parameters"),
            _("Parameters that the fit varies; its result marks those that the images do not determine"),
            depends=("tissues", "scene.fit_free", *_DRAWN),
        ),
        (
            button(
                "fit", _("Fit"), _("Adjust the free parameters so that simulated images match the real ones"),
                fits.fit, fits.canFit,
            ),
            button(
                "applyFit", _("Apply"), _("Adopt the fitted probe, display and tissues; Save preset saves them"),
                fits.apply, fits.canApply,
            ),
            button(
                "revertFit", _("Revert"), _("Restore the values from before Apply, except those changed since"),
                fits.revert, fits.canRevert,
            ),
        ),
        Control("fit", "words", tip=_("Result of the last fit"), shows=lambda: fits.summary),
        (
            _("Show"),
            Control(
                "compare", "choice", tip=_("Image of the fit in the slice view: real, simulated, or their difference "
                "(grey: zero); the real image is in the background, and the view's opacity slider blends the two"),
                choices=tuple(COMPARED), enabled=fits.canCompare,
            ),
            Control("compareNumber", "choice", tip=_("Number of the fitted image"), enabled=fits.canCompare),
            Control(
                "blink", "tick", _("Blink"), _("Alternate between real and simulated image twice a second"),
                enabled=fits.canBlink,
            ),
            Control(
                "difference", "tick", _("Difference"), _("Show where the real image in the background is brighter or "
                "darker than the simulated one; grey: no difference"), enabled=fits.canBlink, sets=fits.showDifference,
            ),
        ),
    )  # fmt: skip


def _advanced(panel: PanelPresenter) -> tuple[Row, ...]:
    return (
        (
            button(
                "loadPreset", _("Load preset..."),
                _("Load probe, ultrasound, tissues and settings from a JSON file of this module or the ussim command"),
            ),
            button(
                "savePreset", _("Save preset..."),
                _("Save probe, ultrasound, tissues and settings to a JSON file for this module and the ussim command"),
            ),
        ),
        value("scene.preset_pose"),
        *_others(f"{SCENE}.{name}" for name in SceneParameters.segmentation.values),
        value("scene.gel"),
        *_of_preset("settings"),
        value("probe.scan_lines"),
        node(
            "output", _("Image volume"), _("Volume for the image, placed under the probe's transform; none: a new one"),
            new_node=_("Ultrasound"),
        ),
    )  # fmt: skip


def _of_preset(section: str) -> tuple[Control, ...]:
    return _others(name for name in preset_parameters() if name.startswith(f"{section}."))


def _others(names: Iterable[str]) -> tuple[Control, ...]:
    """The controls for those of the named values that have no place of their own."""
    return values(*(name for name in names if name not in (*_CONSOLE, *_ELSEWHERE)))


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
        kind = "tick"
    widget = _camel_case(_without_unit(declared))
    decides = ("probe.kind",) if name.startswith("probe.") else ()  # which values the probe has
    label, tip = _(declared.label), _(declared.tip)
    result = Control(widget, kind, label, tip, name, declared, choices=declared.choices, depends=(name, *decides))
    if isinstance(declared.shown, Shown):
        span = _("{low} to {high}").format(low=f"{declared.shown.low:.10g}", high=f"{declared.shown.high:.10g}")
        result = replace(result, tip=f"{tip} ({span}{result.suffix})")
    return result


def values(*names: str) -> tuple[Control, ...]:
    """The controls for those of the named values that panels show."""
    return tuple(value(name) for name in names if value_parameter(name).shown)


def node(role: str, label: str, tip: str, new_node: str = "") -> Control:
    """The node selector for a role of SceneParameters."""
    return Control(_camel_case(role), "node", label, tip, node=role, new_node=new_node)


def button(
    name: str, label: str, tip: str, action: Callable[[], object] | None = None, enabled: Can | None = None
) -> Control:  # fmt: skip
    """A button; without an action, the view has its own."""
    return Control(name, "button", label, tip, action=action, enabled=enabled)


def _without_unit(declared: Parameter) -> str:
    """The name without the suffix of its unit: gain for gain_db."""
    unit = "deg" if declared.unit == "°" else re.sub(r"[^a-z]+", "_", declared.unit.lower()).strip("_")
    return declared.name.removesuffix(f"_{unit}") if unit else declared.name


def _camel_case(name: str) -> str:
    first, *more = name.split("_")
    return first + "".join(word.capitalize() for word in more)
