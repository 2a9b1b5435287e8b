"""The panel: its sections, in Slicer and in the browser, which make their widgets from this list.

A declared parameter that says how it is shown (Parameter.shown) is here by itself: those of probe, display and settings
in the sections Probe, Ultrasound and Rays, those of SegmentationSettings and FitSettings in Inputs and Fit. A button
needs its line here and the presenter's method; a value beside those a declaration in mrml/parameter_node.py.
"""

from __future__ import annotations

from SlicerUSSim.Logic.base.declaration import parameters_of
from SlicerUSSim.Logic.imaging.preset import preset_parameters
from SlicerUSSim.Logic.mrml.fit_nodes import COMPARED
from SlicerUSSim.Logic.mrml.parameter_node import SceneParameters, SettingsParameter
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.tissue import TISSUE_PARAMETERS
from SlicerUSSim.Widget.controls import SCENE, Control, Row, Section, button, node, value, values

#: What the choice of probes shows for one of the user's own.
CUSTOM_PROBE = "custom"
#: What one turns while one looks at the image.
_CONSOLE = ("probe.depth_mm", "probe.frequency_mhz", "probe.focus_mm")


def panel_sections() -> tuple[Section, ...]:
    """The sections in their order."""
    return (
        Section("Inputs", True, _inputs()),
        Section("Probe", True, _probe()),
        Section("Ultrasound", True, (*_of_preset("display"), *values(*_CONSOLE))),
        Section("Tissues", False, _tissues()),
        Section("Rays", False, _of_preset("settings")),
        Section("Sequence", False, _sequence()),
        Section("Fit to real ultrasound", False, _fit()),
        Section("Output", True, _output()),
    )


def _inputs() -> tuple[Row, ...]:
    return (
        node("mri", "MRI", "Skull-stripped brain MRI, or any with a mask"),
        node(
            "mask", "Mask",
            "Where the brain is: a segmentation, or a label map on the MRI's grid. None: everything brighter than the "
            "background",
        ),
        *_of_scene(SceneParameters.segmentation),
        node(
            "labels", "Tissues",
            "Segmentation or label map with the tissues: the output of Segment, or one of your own whose names are "
            "tissues (csf, grey matter, white matter, tumour, blood, skull, ...)", new_node="Tissues",
        ),
        button("segment", "Segment", "Label the tissues of the MRI; takes one or two seconds", enabled="canSegment"),
    )  # fmt: skip


def _probe() -> tuple[Row, ...]:
    return (
        Control(
            "probePreset", "choice", "Preset", "Geometry and frequency of a typical probe",
            choices=(CUSTOM_PROBE, *PROBES), shows="probeName", action="chooseProbe",
        ),
        *values(*(name for name in _probe_values() if name not in _CONSOLE)),
        node(
            "probe_transform", "Transform",
            "Linear transform that moves the probe: x to the right of the image, y along its depth, origin in the "
            "middle of the probe's face [mm]", new_node="Probe",
        ),
        (
            button(
                "place", "Place on surface at this slice",
                "Put the probe on the surface of the tissues, in the plane of the chosen slice view, looking down in "
                "it",
                action="placeProbe", enabled="canSimulate",
            ),
            Control("sliceView", "choice", tip="Slice view that the probe is placed in, and that shows the image"),
        ),
        value("scene.show_in_slice"),
    )  # fmt: skip


def _tissues() -> tuple[Row, ...]:
    columns = [f"{entry.symbol} [{entry.unit}]" if entry.unit else entry.symbol for entry in TISSUE_PARAMETERS]
    return (
        Control(
            "tissue", "table",
            tip=f"Acoustic parameters and scatterers of every tissue: {', '.join(columns)}; double-click to change. "
            "The tool tip of a number is its source",
        ),
        (
            Control(
                "tissuePreset", "choice", tip="Tissue whose numbers the selected line shall take",
                choices=tuple(TISSUES),
            ),
            button(
                "assignTissue", "Use for selected line",
                "Give the selected tissue the numbers of the tissue on the left",
            ),
            button("resetTissues", "Reset", "All numbers back to the presets of the project"),
        ),
    )  # fmt: skip


def _sequence() -> tuple[Row, ...]:
    return (
        node("transform_sequence", "Transforms", "Recorded sequence of probe transforms"),
        node(
            "image_sequence", "Images", "Sequence that the simulated images go to; none: a new one",
            new_node="Ultrasound",
        ),
        button(
            "simulateSequence", "Simulate sequence",
            "One image for every transform of the sequence; played by the same sequence browser", enabled="canSimulate",
        ),
    )  # fmt: skip


def _fit() -> tuple[Row, ...]:
    return (
        node(
            "real", "Real images",
            "Real ultrasound: a sequence of tracked images with its browser, a volume of one slice, or a 3D volume, "
            "which is cut where the probe is",
        ),
        *_of_scene(SceneParameters.fit),
        Control("free", "list", "Free", "What may be changed; what the images cannot tell is said after the fit"),
        (
            button(
                "fit", "Fit", "Change the free parameters until simulated and real images agree",
                action="fits.fit", enabled="fits.canFit",
            ),
            button(
                "applyFit", "Apply", "Take the fitted probe, display and tissues over; Save preset keeps them",
                action="fits.apply", enabled="fits.canApply",
            ),
            button(
                "revertFit", "Revert", "Go back to what was before Apply",
                action="fits.revert", enabled="fits.canRevert",
            ),
        ),
        Control("fit", "words", tip="What the last fit found", shows="fits.summary"),
        Control(
            "compare", "choice", "Show",
            "What the slice view shows of the fit: the real image, the simulated ones, or their difference (grey is "
            "none). The real one lies in the background, so that the view's opacity slider fades between them",
            choices=tuple(COMPARED), enabled="fits.canCompare",
        ),
        Control(
            "compareNumber", "choice", "Image", "Which of the fitted images the slice view shows",
            enabled="fits.canCompare",
        ),
        Control(
            "blink", "tick", "Blink", "Switch between real and simulated twice a second", enabled="fits.canCompare"
        ),
    )  # fmt: skip


def _output() -> tuple[Row, ...]:
    return (
        node(
            "output", "Ultrasound",
            "Volume that the image goes to; none: a new one. It is put under the probe's transform",
            new_node="Ultrasound",
        ),
        node(
            "outline", "Outline", "Model that shows the imaged field; none: a new one", new_node="Ultrasound outline"
        ),
        (
            button("simulate", "Simulate", "Simulate the image under the probe", enabled="canSimulate"),
            Control(
                "live", "tick", "Live", "The image follows the probe and every change of the parameters",
                shows="isLive", action="setLive", enabled="canSimulate",
            ),
        ),
        (
            button(
                "loadPreset", "Load preset...",
                "Probe, ultrasound, tissues and rays from a JSON file, of this module or of the ussim command",
            ),
            button(
                "savePreset", "Save preset...",
                "Probe, ultrasound, tissues and rays to a JSON file, for this module and for the ussim command",
            ),
        ),
        Control("status", "words", tip="Images per second, or what is wrong"),
    )  # fmt: skip


def _of_preset(section: str) -> tuple[Control, ...]:
    return values(*(name for name in preset_parameters() if name.startswith(f"{section}.")))


def _probe_values() -> list[str]:
    """Names of the probe's values, those that only some kinds have before those that all share."""
    shared = {f"probe.{entry.name}" for entry in parameters_of(Probe)}
    return sorted((name for name in preset_parameters() if name.startswith("probe.")), key=lambda name: name in shared)


def _of_scene(settings: SettingsParameter) -> tuple[Control, ...]:
    return values(*(f"{SCENE}.{name}" for name in settings.values))
