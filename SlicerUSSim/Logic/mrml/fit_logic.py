"""FitLogic: fits of simulated to real ultrasound in a scene, and what is adopted and shown of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import required
from SlicerUSSim.Logic.fitting.fit_settings import FitSettings
from SlicerUSSim.Logic.fitting.held_out import predict
from SlicerUSSim.Logic.fitting.search import Progress
from SlicerUSSim.Logic.fitting.tracked_fit import Fit, fit
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.fit_nodes import CostPlot, neighbours_in, tracked_images, write_compared
from SlicerUSSim.Logic.mrml.nodes import pose_in_labels, probe_pose, require_node, set_node_to_world, show_in_slice
from SlicerUSSim.Logic.mrml.own_results import REGISTRATION, mark_as_result, require_result
from SlicerUSSim.Logic.mrml.patient_logic import PatientLogic
from SlicerUSSim.Logic.tissue.sheet_looks import DURA, DURA_KINDS, with_dura


class FitLogic:
    """Fits on the labels of a scene; they change its preset only by applyFit and revertFit."""

    def __init__(self, patient: PatientLogic) -> None:
        self._patient, self._parameters = patient, patient.parameters

    def optimize(
        self, labels_node, images_node, *, probe_transform_node=None, frames: Sequence[int] | None = None,
        validate: Sequence[int] = (),
        free: Iterable[str] | Mapping[str, tuple[float, float] | None] = ("display", "tissues"),
        register: bool = False, speckle: bool = False, estimate_geometry: bool = False,
        max_evaluations: int = FitSettings().of_search, restarts: int = FitSettings.restarts,
        plot: CostPlot | None = None, progress: Callable[[Progress], None] | None = None,
    ) -> Fit:  # fmt: skip
        """Fit display and tissue parameters, with `register` the poses and with `speckle` the speckle, to
        real images. See fitting.fit.

        `images_node` is a sequence of images with its browser's transforms, a volume of one slice, or a 3D ultrasound
        volume, resampled in the image plane. `frames` are numbers of images (default: six, evenly spaced), `validate`
        those of others, which are predicted beside controls (fitting.predict). `plot` shows the cost during the fit.
        Nothing else in the scene changes; applyFit adopts the result. `progress` may raise errors.Cancelled.
        """
        imaged, work = self._patient.imaged(labels_node), self._patient.work
        patient, preset = imaged.patient, imaged.preset
        pose = None if probe_transform_node is None else probe_pose(probe_transform_node)
        tracked = tracked_images(
            images_node, frames, preset.probe, probe_to_world=pose, estimate_geometry=estimate_geometry, apart=validate
        )
        tracked = replace(tracked, poses=[patient.pose(pose) for pose in tracked.poses])
        tracked, others = tracked.split(validate) if validate else (tracked, None)
        near = [neighbours_in(images_node, images) for images in (tracked, others) if images is not None]

        def report(step: Progress) -> None:
            if plot is not None:
                work.tell(partial(plot.add, step))
            if progress is not None:
                progress(replace(step, number=tracked.numbers[0]))

        def compute() -> Fit:
            simulator = self._patient.simulator(imaged)
            found = fit(
                simulator, tracked, free=free, display=preset.display, register=register,
                speckle=speckle, restarts=restarts, max_evaluations=max_evaluations, progress=report,
            )  # fmt: skip
            if others is None:
                return found
            prediction = predict(
                found, simulator, others, free=free, display=preset.display, speckle=speckle, fitted_neighbours=near[0],
                neighbours=near[1], max_evaluations=max_evaluations, restarts=restarts, progress=report,
            )  # fmt: skip
            return replace(found, prediction=prediction)

        try:
            return work.do(compute)
        finally:
            if plot is not None:
                plot.draw()

    def applyFit(self, found: Fit) -> Preset:
        """Adopt probe, display and tissues of a fit in the preset; returns the previous preset, for reverting."""
        before = self._parameters.preset
        self._parameters.preset = with_fit(before, found)
        return before

    def revertFit(self, found: Fit, before: Preset) -> list[str]:
        """Take back what applyFit adopted in the preset `before`; returns names of values changed since, which stay."""
        self._parameters.preset, kept = taken_back(before, with_fit(before, found), self._parameters.preset)
        return kept

    def writeRegistration(self, found: Fit, labels_node, transform_node) -> None:
        """Write the registration's correction into a linear transform: the last parent of the tracking.

        Raises SimulationError for a transform that is neither the identity nor written by this method.
        """
        require_node(transform_node, "vtkMRMLLinearTransformNode", use="registration")
        registration = required(found.registration, "the fit was made without registration")
        require_result(transform_node, "registration")
        to_world = _fit_to_world(labels_node)
        set_node_to_world(transform_node, to_world @ registration.correction @ np.linalg.inv(to_world))
        mark_as_result(transform_node, REGISTRATION)

    def showFit(self, found: Fit, labels_node, nodes: Mapping[str, object], number: int | None = None) -> None:
        """Write one image of a fit, by default the first, into volume nodes: any of {"real": ..., "before": ...,
        "after": ..., "difference": ...}.

        Raises SimulationError for one with data that this module did not make; none is changed then.
        """
        number = found.tracked.numbers[0] if number is None else number
        write_compared(dict(nodes), found, number, _fit_to_world(labels_node))

    def showFitInSlice(self, slice_node, found: Fit, labels_node, shown_node, real_node, number: int) -> None:
        """Move a slice view to the plane of an image of a fit: `shown_node` in front of `real_node`, for fading."""
        require_node(slice_node, "vtkMRMLSliceNode", use="slice view")
        pose = _fit_to_world(labels_node) @ found.tracked.poses[found.tracked.numbers.index(number)]
        show_in_slice(slice_node, shown_node, pose, found.tracked.probe, fit=True, behind=real_node)


def _fit_to_world(labels_node) -> np.ndarray:
    """(4, 4) from the frame of a fit's poses, which is the labels' frame unless its transform scales."""
    in_labels, _ = pose_in_labels(labels_node, np.eye(4))
    return np.linalg.inv(in_labels)


# ---- adopting the result of a fit in a preset, and taking it back later ----------------------------------------------

#: Of a section that has no such value
_NONE = object()
#: What a section is about: with another one, its values are not compared one by one
_KINDS = ("name", "kind")
_SOURCES = "sources"


def with_fit(preset: Preset, found: Fit) -> Preset:
    """A preset with probe, display and tissues of a fit."""
    tissues = preset.tissues
    changed = set(found.appearance.parameters.varied())
    if found.speckle is not None:  # which gives tissues a texture
        changed |= {tissue.name for tissue in found.speckle.tissues.all_tissues() if tissue.texture_db > 0.0}
    if DURA in changed:  # of sheets that were found: under the label that it has in images
        tissues = with_dura(tissues, DURA_KINDS)
    for name in sorted(changed):
        tissues = tissues.with_tissue(found.appearance.tissues.tissue(name))
    return replace(preset, probe=found.tracked.probe, display=found.appearance.display, tissues=tissues)


def taken_back(before: Preset, adopted: Preset, now: Preset) -> tuple[Preset, list[str]]:
    """(`now` with the values that came from `before` to `adopted` as they were before, names of the others).

    Values that were changed since `adopted` stay, and are listed, such as "csf mu0". Raises SimulationError if previous
    values do not fit together with those that stay.
    """
    if now == adopted:
        return before, []
    kept: list[str] = []
    merged = _merged(_plain(before), _plain(adopted), _plain(now), (), kept)
    return Preset.from_dict(merged), list(dict.fromkeys(kept))


def _plain(preset: Preset) -> dict[str, Any]:
    return json.loads(json.dumps(preset.to_dict()))


def _merged(before: Any, adopted: Any, now: Any, called: tuple[str, ...], kept: list[str]) -> Any:
    """The value to be used, _NONE for none; appends what was changed since to `kept`."""
    if now == adopted:
        return before
    sections = [value for value in (before, adopted, now) if isinstance(value, dict)]
    if len(sections) == 3 and all(value.get(kind) == now.get(kind) for value in sections for kind in _KINDS):
        found = {}
        for name in dict.fromkeys([*before, *now]):
            was, came, has = (value.get(name, _NONE) for value in (before, adopted, now))
            value = _merged(was, came, has, _called(called, name, now), kept)
            if value is not _NONE:
                found[name] = value
        return found
    if _SOURCES not in called and now != before:
        kept.append(" ".join(called))
    return now


def _called(called: tuple[str, ...], name: str, section: dict[str, Any]) -> tuple[str, ...]:
    """The words for a value of a section: tissues by their names, and not by their labels."""
    entry = section.get(name)
    if called == ("tissues",) and isinstance(entry, dict):
        return (str(entry.get("name", name)),)
    return (*called, name)
