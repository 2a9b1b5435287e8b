"""fit: fit of simulated to tracked images, with or without registration, with the images before and after."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.fitting.fit_settings import FitSettings
from SlicerUSSim.Logic.fitting.image_similarity import Similarity, SimilaritySettings, similarity
from SlicerUSSim.Logic.fitting.optimization import AppearanceResult, optimize_appearance
from SlicerUSSim.Logic.fitting.parameters import ATTENUATION, TISSUES, Bounds, FreeParameters
from SlicerUSSim.Logic.fitting.registration import Registration, register_poses
from SlicerUSSim.Logic.fitting.search import Progress
from SlicerUSSim.Logic.fitting.speckle_fit import (
    SpeckleFit,
    fit_speckle,
    with_estimated_map,
    with_preset_texture,
)
from SlicerUSSim.Logic.fitting.texture_costs import TextureMisfit, TextureReference
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.poses import slice_under_probe
from SlicerUSSim.Logic.tissue.sheet_looks import DURA, DURA_KINDS, dura_label
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tracked.images import TrackedImages

if TYPE_CHECKING:
    from SlicerUSSim.Logic.fitting.control_costs import Prediction

_log = logging.getLogger(__name__)

#: Fraction of the evaluations for a fit before registration.
_FIRST_SHARE = 0.4
#: Successive registrations: bounds (mm and degrees) and evaluations. A fit at wrong poses is biased, and so is the
#: registration after it; later ones start closer.
_ROUNDS = ((8.0, 500), (4.0, 300), (2.0, 250))


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted parameters and poses, and the images."""

    appearance: AppearanceResult
    #: None without registration
    registration: Registration | None
    #: At the registered poses
    tracked: TrackedImages
    #: (rows, columns) uint8, simulated before and after the fit, with the parameters and poses of each
    before: list[np.ndarray] = field(repr=False)
    after: list[np.ndarray] = field(repr=False)
    #: T1 and T2 of each image (texture_costs.py), before and after
    texture_before: list[TextureMisfit] = field(default_factory=list)
    texture_after: list[TextureMisfit] = field(default_factory=list)
    #: None unless the speckle was fitted
    speckle: SpeckleFit | None = None
    #: None unless other images were predicted (control_costs.py)
    prediction: Prediction | None = None

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        found = {} if self.registration is None else {"registration": self.registration.to_dict()}
        speckle = {} if self.speckle is None else {"speckle": self.speckle.to_dict()}
        texture = [
            {"before": _plain(before), "after": _plain(after)}
            for before, after in zip(self.texture_before, self.texture_after, strict=True)
        ]
        prediction = {} if self.prediction is None else {"prediction": self.prediction.to_dict()}
        numbers = self.tracked.numbers
        return {
            **self.appearance.to_dict(), **found, **speckle, "texture": texture, "numbers": numbers, **prediction,
        }  # fmt: skip


def fit(
    simulator: UltrasoundSimulator,
    tracked: TrackedImages,
    *,
    free: Iterable[str] | Mapping[str, Bounds | None],
    display: DisplaySettings | None = None,
    register: bool = False,
    speckle: bool = False,
    max_evaluations: int = FitSettings().of_search,
    restarts: int = FitSettings.restarts,
    seed: int = 0,
    settings: SimilaritySettings | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Fit:
    """Fit display and tissue parameters (optimization.optimize_appearance) and, with `register`, the poses.

    Registration requires similar images and the fit requires poses. Short fits and registrations therefore alternate,
    followed by the complete fit at the resulting poses. With `speckle`, a short fit with the real images' grey map is
    followed by fit_speckle, and the complete fit begins where both have ended. Of the free parameters, "tissues" means
    those that the images can show (see below).
    Raises SimulationError as those do.
    """
    display = display or DisplaySettings()
    free = parameters_seen(free, simulator, tracked)
    masks = [tracked.mask] * len(tracked.images)
    given = tracked
    references = [TextureReference(image, tracked.grid.pixel_spacing_mm, tracked.mask) for image in tracked.images]
    for number, reference in zip(tracked.numbers, references, strict=True):
        if reference.is_dark:
            _log.warning(
                "image %d is dark in all that is left of the probe's field (%.0f %% of it): its texture cannot be "
                "compared, and the fit is unreliable; expected an image of the patient",
                number, 100.0 * tracked.mask.sum() / max(tracked.grid.field(tracked.probe).sum(), 1),
            )  # fmt: skip

    def appearance_at(poses: Sequence[np.ndarray], **options: Any) -> AppearanceResult:
        return optimize_appearance(
            simulator, tracked.probe, poses, references=tracked.images, free=free, grid=tracked.grid, masks=masks,
            seed=seed, settings=settings, **options,
        )  # fmt: skip

    registration = None
    if register:
        step_from = partial(
            register_poses, simulator, tracked.probe, references=tracked.images, grid=tracked.grid, masks=masks,
            settings=settings, progress=Progress.named("registration", progress),
        )  # fmt: skip
        short = partial(
            appearance_at, display=display, restarts=0, max_evaluations=max(int(_FIRST_SHARE * max_evaluations), 1),
            progress=Progress.named("for the registration", progress),
        )  # fmt: skip
        tracked, registration = _registered(simulator, tracked, short, step_from)
    begun = simulator.medium.tissues
    start, begin, found = display, None, None
    if speckle:
        found = _speckle_of(simulator, tracked, display, free, seed, settings, max_evaluations, progress)
        start, begin = _at_the_levels_of(found.display, display), (found.tissues, found.display)
    with simulator.with_tissues(begun if found is None else _at_the_levels_of_tissues(found.tissues, begun)):
        appearance = appearance_at(
            tracked.poses, display=start, begin=begin, restarts=restarts, max_evaluations=max_evaluations,
            progress=progress,
        )  # fmt: skip
    before = simulated(simulator, given, begun, display)
    after = simulated(simulator, tracked, appearance.tissues, appearance.display)
    if speckle:
        was = _similarities(given, before, settings or SimilaritySettings())
        appearance = replace(appearance, similarity_before=was, cost_before=float(np.mean([one.total for one in was])))
    textures = ([r.misfit(i) for r, i in zip(references, images, strict=True)] for images in (before, after))
    return Fit(appearance, registration, tracked, before, after, *textures, speckle=found)


def _speckle_of(
    simulator: UltrasoundSimulator,
    tracked: TrackedImages,
    display: DisplaySettings,
    free: Iterable[str] | Mapping[str, Bounds | None],
    seed: int,
    settings: SimilaritySettings | None,
    max_evaluations: int,
    progress: Callable[[Progress], None] | None,
) -> SpeckleFit:
    """The grey map of the real images, a short fit with it, and the speckle there."""
    tissues = with_preset_texture(simulator.medium.tissues)
    shown, has_map = with_estimated_map(display, tracked)
    with simulator.with_tissues(tissues):
        first = optimize_appearance(
            simulator, tracked.probe, tracked.poses, references=tracked.images, free=free, display=shown,
            grid=tracked.grid, masks=[tracked.mask] * len(tracked.images), seed=seed, settings=settings,
            restarts=0, max_evaluations=max(int(_FIRST_SHARE * max_evaluations), 1),
            progress=Progress.named("levels for the speckle", progress),
        )  # fmt: skip
    shares = Progress.shares("smoothing and texture of the speckle", progress)
    return replace(fit_speckle(simulator, tracked, first.tissues, first.display, shares), has_map=has_map)


def _at_the_levels_of(found: DisplaySettings, given: DisplaySettings) -> DisplaySettings:
    """What was found of the speckle, with the rest as given: the user's values are from before the fit."""
    names = ("smoothing_axial_mm", "smoothing_lateral_deg", "grey_map", "map_black", "map_dark", "map_white")
    return replace(given, **{name: getattr(found, name) for name in names})


def _at_the_levels_of_tissues(found: TissueTable, given: TissueTable) -> TissueTable:
    for tissue in given.all_tissues():
        of = found.tissue(tissue.name)
        names = ("texture_db", "texture_mm", "specks_per_mm3", "speck_db")
        given = given.with_tissue(replace(tissue, **{name: getattr(of, name) for name in names}))
    return given


def _similarities(tracked: TrackedImages, images: list[np.ndarray], settings: SimilaritySettings) -> list[Similarity]:
    return [
        similarity(
            image, real, tracked.grid.pixel_spacing_mm, patch_mm=settings.patch_mm, bins=settings.bins,
            sad_weight=settings.sad_weight, mask=tracked.mask & tracked.grid.field(tracked.probe),
        )
        for image, real in zip(images, tracked.images, strict=True)
    ]  # fmt: skip


def _plain(misfit: TextureMisfit) -> dict:
    values = {"t1": misfit.autocorrelation, "t2": misfit.extrema}
    return {name: value if np.isfinite(value) else None for name, value in values.items()}


def _registered(
    simulator: UltrasoundSimulator,
    tracked: TrackedImages,
    appearance_at: Callable[..., AppearanceResult],
    step_from: Callable[..., Registration],
) -> tuple[TrackedImages, Registration]:
    """The images at the poses where a short fit has the lowest cost, and their registration with its costs.

    `appearance_at` poses is a short fit, `step_from` poses a registration as a function of display and bounds.
    """
    candidates: list[tuple[float, TrackedImages, Registration]] = []
    moved = Registration.none(tracked.poses)

    def fitted() -> AppearanceResult:
        result = appearance_at(tracked.poses)
        candidates.append((result.cost_after, tracked, moved))
        return result

    for bound, most in _ROUNDS:
        first = fitted()
        with simulator.with_tissues(first.tissues):
            step = step_from(
                tracked.poses, display=first.display, range_mm=bound, range_deg=bound, max_evaluations=most
            )
        moved = step.after(moved)
        _log.info(
            "registration within %g mm and degrees: moved by %.2f mm and %.2f degrees in total", bound, moved.shift_mm,
            moved.turn_deg,
        )  # fmt: skip
        tracked = replace(tracked, poses=step.poses)
    fitted()
    cost, best, registration = min(candidates, key=lambda candidate: candidate[0])
    return best, replace(registration, cost_before=candidates[0][0], cost_after=cost)


def simulated(
    simulator: UltrasoundSimulator, tracked: TrackedImages, tissues: TissueTable, display: DisplaySettings
) -> list[np.ndarray]:
    """(rows, columns) uint8 simulated images on the pixels of the tracked ones."""
    still = replace(display, persistence=0.0)  # images of a recording need not follow each other
    with simulator.with_tissues(tissues):
        return [simulator.simulate(tracked.probe, pose, still, tracked.grid).image for pose in tracked.poses]


# ---- what the images show of the patient: which parameters "tissues" stands for --------------------------------------


#: A tissue of less than this part of the imaged fields is too small to show its parameters.
_LEAST_SHARE = 0.002
#: Mean path through a tissue, mm, from which its attenuation shows: at 5 MHz a change by the parameter's tolerance,
#: 0.1 dB/(cm MHz), then changes the tissue behind by 0.3 dB.
_LEAST_PATH_MM = 3.0
#: Surfels are 1 mm apart: a sheet that crosses an image has some this near to its plane.
_BESIDE_MM = 1.0


def shares(simulator: UltrasoundSimulator, tracked: TrackedImages) -> dict[str, float]:
    """{tissue: its part of the imaged fields, 0 to 1}, without the part outside the labels."""
    medium = simulator.medium
    count = np.zeros(256, int)
    for pose in tracked.poses:
        labels = slice_under_probe(medium.labels, tracked.grid, pose, order=0)[tracked.mask]
        count += np.bincount(labels.astype(int), minlength=256)
    found: dict[str, float] = {}
    for label, tissue in medium.tissues.items():
        found[tissue.name] = found.get(tissue.name, 0.0) + float(count[label]) / max(int(count.sum()), 1)
    return found


def _shows_dura(simulator: UltrasoundSimulator, tracked: TrackedImages) -> bool:
    """Whether a sheet of the dura that was found in the MRI crosses the imaged field of one of the images."""
    medium = simulator.medium
    if medium.sheets is None or dura_label(medium.tissues) < 0:
        return False
    place = medium.sheets.of_kind(*DURA_KINDS).place
    for pose in tracked.poses:
        across, down, aside = ((place - pose[:3, 3]) @ pose[:3, :3]).T
        if (tracked.probe.holds(across, down) & (np.abs(aside) < _BESIDE_MM)).any():
            return True
    return False


def parameters_seen(
    free: Iterable[str] | Mapping[str, Bounds | None], simulator: UltrasoundSimulator, tracked: TrackedImages
) -> dict[str, Bounds | None]:
    """The free parameters with "tissues" replaced by those that the images can show.

    These are the echogenicity of every tissue in the imaged fields, of the membrane, and of the dura where sheets of it
    were found there, and the attenuation of tissues through which the beams pass for some millimetres. Other names do
    not change.
    """
    entries = dict(free) if isinstance(free, Mapping) else dict.fromkeys([free] if isinstance(free, str) else free)
    if TISSUES not in entries or entries[TISSUES] is not None:
        return entries
    table = simulator.medium.tissues
    thin = {DURA} if _shows_dura(simulator, tracked) else set()
    if table.membrane is not None:
        thin.add(table.membrane.tissue.name)
    part, depth = shares(simulator, tracked), tracked.probe.depth_mm
    chosen: dict[str, Bounds | None] = {}
    left_out = []
    for parameter in FreeParameters.of([TISSUES], table, DisplaySettings()):
        tissue = str(parameter.tissue)
        share = part.get(tissue, 0.0)
        is_path = parameter.attribute == ATTENUATION
        shows = share * depth >= _LEAST_PATH_MM if is_path else share >= _LEAST_SHARE or tissue in thin
        if shows:
            chosen[parameter.name] = None
        else:
            left_out.append(parameter.name)
    if left_out:
        _log.info("the images show too little of these to fit them: %s", ", ".join(left_out))
    result: dict[str, Bounds | None] = {}
    for name, bounds in entries.items():
        result.update(chosen if name == TISSUES else {name: bounds})
    return result
