"""fit_speckle: grey map, smoothing of the envelope and texture of tissue from real images (docs/realism.md#fit).

In the order in which they can be told apart: the grey map from the real images alone; then smoothing and texture by the
costs of texture T1 + T2 / 2 (texture_costs.py), to which the paper's cost is nearly blind. T2 counts grains and has no
gradient, so the search uses none; it is short, since few parameters are left. They see the width of the speckle only to
a quarter of it, so that the smoothing is found once more, by them and the width (speckle_width.py). The probe's
bandwidth and aperture stay: widths alone do not tell them from smoothing and texture.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.fitting.appearance import AppearanceModel
from SlicerUSSim.Logic.fitting.parameters import DISPLAY_BOUNDS
from SlicerUSSim.Logic.fitting.speckle_width import SpeckleWidth, speckle_widths, width_misfit
from SlicerUSSim.Logic.fitting.texture_costs import TextureMisfit, TextureReference
from SlicerUSSim.Logic.imaging.grey_map import estimate_grey_map
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import Tissue
from SlicerUSSim.Logic.tracked.images import TrackedImages

_log = logging.getLogger(__name__)

_NAMES = ("smoothing_axial_mm", "smoothing_lateral_deg")
#: Where the search for them begins, and the first step
_START, _STEP = (0.06, 0.25), (0.04, 0.12)
#: Factors of the texture's deviation that are tried, and evaluations of the smoothing for each
_FACTORS, _EVALUATIONS = (1.0, 0.5, 1.4, 0.0), (24, 14, 14, 14)
_MOST_TEXTURE_DB = 8.0
#: Evaluations of the smoothing with the width of the speckle, and what a width that is wrong by a factor of e adds
_WIDTH_EVALUATIONS, _WIDTH_WEIGHT = 16, 0.25
#: Depths at which the width of the real speckle is measured, parts of the image depth
_WIDTH_DEPTHS = (0.33, 0.5, 0.7, 0.92)


@dataclass(frozen=True)
class SpeckleFit:
    """Display and tissues with the speckle of real images."""

    display: DisplaySettings
    tissues: TissueTable
    #: Factor of the tissues' texture_db
    texture_factor: float
    #: Mean over the images, before and after
    before: TextureMisfit
    after: TextureMisfit
    #: Whether the real images had enough grey levels for a map
    has_map: bool

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        shown = (*_NAMES, "grey_map", "map_black", "map_dark", "map_white")
        return {
            **{name: getattr(self.display, name) for name in shown},
            "texture_factor": self.texture_factor,
            "grey_map_found": self.has_map,
            "before": vars(self.before),
            "after": vars(self.after),
        }  # fmt: skip

    def rows(self) -> list[tuple[str, str]]:
        """(what, what was found of it) of texts, in the order of the steps, for reports."""
        shown = self.display
        slopes = (
            f"slope {shown.map_black:.2f} at black, {shown.map_dark:.2f} at a quarter of white, {shown.map_white:.2f} "
            "at white, relative to that at half of it"
        )
        return [
            ("grey map, from the images alone", slopes if self.has_map else "as given: they have too few grey levels"),
            ("T1 and T2 before", _in_words(self.before)),
            (
                "smoothing of the envelope",
                f"{shown.smoothing_axial_mm:.3f} mm axially, {shown.smoothing_lateral_deg:.2f}° laterally",
            ),
            ("texture of the tissues", f"x {self.texture_factor:g}"),
            ("T1 and T2 with these", _in_words(self.after)),
        ]


def with_estimated_map(display: DisplaySettings, tracked: TrackedImages) -> tuple[DisplaySettings, bool]:
    """The display with the grey map of the real images, and whether they have enough grey levels for one."""
    try:
        found = estimate_grey_map(tracked.images, tracked.grid.pixel_spacing_mm, tracked.mask)
    except SimulationError as error:
        _log.warning("no grey map: %s", error)
        return display, False
    _log.info("grey map: slopes %.2f at black, %.2f at a quarter, %.2f at white", *found.changes().values())
    return replace(display, grey_map="linear", **found.changes()), True


def with_preset_texture(tissues: TissueTable) -> TissueTable:
    """The table in which even tissues vary as the presets of their names do."""
    for tissue in tissues.all_tissues():
        preset = TISSUES.get(tissue.name)
        if preset is not None and preset.texture_db > 0.0 and tissue.texture_db == 0.0:
            changes = {
                name: getattr(preset, name) for name in ("texture_db", "texture_mm", "specks_per_mm3", "speck_db")
            }
            tissues = tissues.with_tissue(replace(tissue, **changes))
    return tissues


def fit_speckle(
    simulator: UltrasoundSimulator,
    tracked: TrackedImages,
    tissues: TissueTable,
    display: DisplaySettings,
    progress: Callable[[float], None] | None = None,
    factors: Sequence[float] = _FACTORS,
) -> SpeckleFit:
    """Fit smoothing and texture at these levels of tissues and display, which should fit the images already.

    `factors` of the texture are tried. `progress` gets the part done. Raises SimulationError if no patch of the images
    is bright enough in both.
    """
    spacing = tracked.grid.pixel_spacing_mm
    references = [TextureReference(image, spacing, tracked.mask) for image in tracked.images]
    with simulator.with_tissues(tissues):
        model = AppearanceModel(simulator, tracked.probe, tracked.poses, {}, tracked.grid)
    done, total = 0, sum(_EVALUATIONS[: len(factors)]) + _WIDTH_EVALUATIONS

    def images_of(table: TissueTable, shown: DisplaySettings) -> list[np.ndarray]:
        return [model.image(n, table, shown) for n in range(len(references))]

    def texture_of(images: Sequence[np.ndarray]) -> TextureMisfit:
        return _mean([r.misfit(image) for r, image in zip(references, images, strict=True)])

    def misfit(table: TissueTable, shown: DisplaySettings) -> TextureMisfit:
        return texture_of(images_of(table, shown))

    def search(
        cost: Callable[[DisplaySettings], float], start: np.ndarray, evaluations: int
    ) -> tuple[DisplaySettings, float]:  # fmt: skip
        """The smoothing of the least cost near this one, and the cost."""

        def evaluated(values: np.ndarray) -> float:
            nonlocal done
            done += 1
            if progress is not None:
                progress(min(done / total, 1.0))
            value = cost(_smoothed(display, values))
            return value if np.isfinite(value) else 10.0

        simplex = np.array([start, start + [_STEP[0], 0.0], start + [0.0, _STEP[1]]])
        found = optimize.minimize(
            evaluated, start, method="Nelder-Mead",
            options={"initial_simplex": simplex, "maxfev": evaluations, "xatol": 1e-3, "fatol": 1e-4},
        )  # fmt: skip
        return _smoothed(display, found.x), float(found.fun)

    before = misfit(tissues, display)
    if not np.isfinite(before.total):
        raise SimulationError("no patch of the real images is as bright as 15 grey levels, expected some for speckle")
    candidates: list[tuple[float, float, DisplaySettings, TissueTable, TextureMisfit]] = []
    start = np.array(_START)
    has_texture = any(tissue.texture_db > 0.0 for tissue in tissues.all_tissues())
    for factor, evaluations in zip(factors, _EVALUATIONS, strict=False):
        if factor != 1.0 and not has_texture:
            continue
        table = _scaled(tissues, factor)
        if factor != 1.0:
            model.anchor(table)

        def cost(shown: DisplaySettings, table: TissueTable = table) -> float:
            return misfit(table, shown).total

        shown, value = search(cost, start, evaluations)
        candidates.append((value, factor, shown, table, misfit(table, shown)))
        start = _smoothing(shown)
        _log.info("texture x %.2g: T1 + T2 / 2 is %.3f with smoothing %.3f mm, %.2f degrees", factor, value, *start)
    # The table as it is, with nothing smoothed, is a candidate as well
    candidates.append((before.total, 1.0, display, tissues, before))
    _, factor, shown, table, after = min(candidates, key=lambda candidate: candidate[0])

    real = _widths(tracked, tracked.images)

    def with_widths(shown: DisplaySettings) -> float:
        images = images_of(table, shown)
        return texture_of(images).total + _WIDTH_WEIGHT * width_misfit(_widths(tracked, images), real)

    model.anchor(table)
    first = with_widths(shown)
    if np.isfinite(first):  # else no width can be measured, in the real or the simulated images
        other, value = search(with_widths, _smoothing(shown), _WIDTH_EVALUATIONS)
        if value < first:
            shown, after = other, misfit(table, other)
            _log.info("with the width of the speckle: smoothing %.3f mm, %.2f degrees", *_smoothing(shown))
    return SpeckleFit(shown, table, factor, before, after, True)


def _widths(tracked: TrackedImages, images: Sequence[np.ndarray]) -> list[SpeckleWidth]:
    depths = [share * tracked.probe.depth_mm for share in _WIDTH_DEPTHS]
    return speckle_widths(images, tracked.probe, tracked.grid, depths, tracked.mask)


def _in_words(misfit: TextureMisfit) -> str:
    return f"{misfit.autocorrelation:.3f} and {misfit.extrema:.2f}, T1 + T2 / 2 = {misfit.total:.3f}"


def _smoothing(display: DisplaySettings) -> np.ndarray:
    return np.array([getattr(display, name) for name in _NAMES])


def _smoothed(display: DisplaySettings, values: Sequence[float] | np.ndarray) -> DisplaySettings:
    bounded = {name: float(np.clip(value, *DISPLAY_BOUNDS[name])) for name, value in zip(_NAMES, values, strict=True)}
    return replace(display, **bounded)


def _scaled(tissues: TissueTable, factor: float) -> TissueTable:
    def changed(tissue: Tissue) -> Tissue:
        return replace(tissue, texture_db=min(factor * tissue.texture_db, _MOST_TEXTURE_DB))

    for tissue in tissues.all_tissues():
        if tissue.texture_db > 0.0:
            tissues = tissues.with_tissue(changed(tissue))
    return tissues


def _mean(misfits: Sequence[TextureMisfit]) -> TextureMisfit:
    known = [m for m in misfits if np.isfinite(m.total)]
    if not known:
        return TextureMisfit(float("nan"), float("nan"))
    return TextureMisfit(float(np.mean([m.autocorrelation for m in known])), float(np.mean([m.extrema for m in known])))
