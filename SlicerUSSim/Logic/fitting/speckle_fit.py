"""fit_speckle: grey map, smoothing of the envelope and texture of tissue from real images (docs/realism.md#fit).

In the order in which they can be told apart: the grey map from the real images alone; then smoothing and texture by the
costs of texture T1 + T2 / 2 (texture_costs.py), to which the paper's cost is nearly blind. T2 counts grains and has no
gradient, so the search uses none; it is short, since few parameters are left. They see the width of the speckle only to
a quarter of it, so that the smoothing is found once more, by them and the width (speckle_width.py). The probe's
bandwidth and aperture by the width of the real speckle are a start that is taken only with T2 (below): widths
alone do not tell them from smoothing and texture. Its frequency stays, since no image tells it from the bandwidth.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.fitting.appearance import AppearanceModel
from SlicerUSSim.Logic.fitting.parameters import DISPLAY_BOUNDS
from SlicerUSSim.Logic.fitting.speckle_width import SpeckleWidth, speckle_widths, width_misfit
from SlicerUSSim.Logic.fitting.texture_costs import TextureMisfit, TextureReference
from SlicerUSSim.Logic.imaging.grey_map import estimate_grey_map
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import Probe
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
    #: What the width of the real speckle says of the point spread function; None: not looked for
    spread: PointSpread | None = None

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        shown = (*_NAMES, "grey_map", "map_black", "map_dark", "map_white")
        return {
            **{name: getattr(self.display, name) for name in shown},
            "texture_factor": self.texture_factor,
            "grey_map_found": self.has_map,
            "before": vars(self.before),
            "after": vars(self.after),
            "point_spread": None if self.spread is None else self.spread.to_dict(),
        }  # fmt: skip

    def rows(self) -> list[tuple[str, str]]:
        """(what, what was found of it) of texts, in the order of the steps, for reports."""
        shown, spread = self.display, self.spread
        slopes = (
            f"slope {shown.map_black:.2f} at black, {shown.map_dark:.2f} at a quarter of white, {shown.map_white:.2f} "
            "at white, relative to that at half of it"
        )
        rows = [
            ("grey map, from the images alone", slopes if self.has_map else "as given: they have too few grey levels"),
            ("T1 and T2 before", _in_words(self.before)),
            (
                "smoothing of the envelope",
                f"{shown.smoothing_axial_mm:.3f} mm axially, {shown.smoothing_lateral_deg:.2f}° laterally",
            ),
            ("texture of the tissues", f"x {self.texture_factor:g}"),
            ("T1 and T2 with these", _in_words(self.after)),
        ]
        if spread is not None:
            rows.append(("point spread function", spread.in_words()))
            if spread.with_it is not None and spread.without is not None:
                rows.append(("T1 and T2 with it; without", f"{_in_words(spread.with_it)}; {_in_words(spread.without)}"))
        return rows


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
    by_width: bool = True,
) -> SpeckleFit:
    """Fit smoothing and texture at these levels of tissues and display, which should fit the images already.

    `factors` of the texture are tried; `by_width`, the smoothing is found once more with the width of the speckle;
    `progress` gets the part done. Raises SimulationError if no patch of the images is bright enough in both.
    """
    spacing = tracked.grid.pixel_spacing_mm
    references = [TextureReference(image, spacing, tracked.mask) for image in tracked.images]
    with simulator.with_tissues(tissues):
        model = AppearanceModel(simulator, tracked.probe, tracked.poses, {}, tracked.grid)
    done, total = 0, sum(_EVALUATIONS[: len(factors)]) + by_width * _WIDTH_EVALUATIONS

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

    if not by_width:
        return SpeckleFit(shown, table, factor, before, after, True)
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


def with_point_spread(
    simulator: UltrasoundSimulator,
    tracked: TrackedImages,
    first: SpeckleFit,
    display: DisplaySettings,
    progress: Callable[[float], None] | None = None,
) -> tuple[SpeckleFit, TrackedImages]:
    """The fit of the speckle, and the images with the probe that has it.

    The point spread function by the width of the real speckle is a start only: another fit begins with it, at the
    texture of `first` and with `display`'s levels, and is taken if T1 + T2 / 2 is lower and T2, the number of grains,
    not higher. `progress` gets the part done.
    """
    spread = point_spread(_widths(tracked, tracked.images), tracked.probe)
    other = replace(tracked, probe=spread.of(tracked.probe))
    if other.probe == tracked.probe:
        return replace(first, spread=spread), tracked
    try:
        found = fit_speckle(simulator, other, first.tissues, display, progress, factors=(1.0,), by_width=False)
    except Cancelled:
        raise
    except SimulationError as error:  # with that probe an image would take minutes, or is dark
        _log.info("the point spread function by the width of the speckle cannot be tried: %s", error)
        return replace(first, spread=spread), tracked
    is_better = found.after.total < first.after.total and found.after.extrema <= first.after.extrema
    spread = replace(spread, is_taken=is_better, with_it=found.after, without=first.after)
    _log.info(
        "%s: T1 %.3f, T2 %.2f with it, %.3f and %.2f without", spread.in_words(), found.after.autocorrelation,
        found.after.extrema, first.after.autocorrelation, first.after.extrema,
    )  # fmt: skip
    if not is_better:
        return replace(first, spread=spread), tracked
    return replace(found, texture_factor=first.texture_factor, before=first.before, spread=spread), other


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


# ---- point spread function by the width of the speckle: a start, which fits accept only with T2 ----------------------
# Axially the width s tells the band, frequency x fractional bandwidth = 0.2886 / s (mm, MHz: two-way pulses at
# 1540 m/s), laterally the aperture in wavelengths. Frequency itself is in neither: 3.5 to 6 MHz fit equally. What is
# measured in a patient is wider than the point spread function, by texture and by the scanner's processing: with the
# function that has the measured widths, images have half as many grains.

#: Frequency x fractional bandwidth x sigma of the amplitude, MHz mm
BAND_SIGMA = 0.2886
#: Bounds of what is estimated, as probes have them
_BANDWIDTHS, _APERTURES_MM = (0.05, 1.5), (1.0, 60.0)


@dataclass(frozen=True)
class PointSpread:
    """What the width of the speckle says of a point spread function."""

    #: Width of the band, MHz, and aperture in mm times frequency in MHz; NaN where no speckle could be measured
    band_mhz: float
    aperture_mm_mhz: float
    #: Whether a fit took it; None: not tried
    is_taken: bool | None = None
    #: T1 and T2 with it, and without; None: not tried
    with_it: TextureMisfit | None = None
    without: TextureMisfit | None = None

    def of(self, probe: Probe) -> Probe:
        """The probe with this point spread function at its own frequency, which is not known from the images."""
        changes = {}
        if np.isfinite(self.band_mhz):
            changes["fractional_bandwidth"] = float(np.clip(self.band_mhz / probe.frequency_mhz, *_BANDWIDTHS))
        if np.isfinite(self.aperture_mm_mhz):
            changes["aperture_mm"] = float(np.clip(self.aperture_mm_mhz / probe.frequency_mhz, *_APERTURES_MM))
        return replace(probe, **changes)

    def to_dict(self) -> dict:
        """Plain values for JSON; what could not be measured is None."""
        values = {"band_mhz": self.band_mhz, "aperture_mm_mhz": self.aperture_mm_mhz}
        plain = {name: value if np.isfinite(value) else None for name, value in values.items()}
        tried = {
            name: {key: value if np.isfinite(value) else None for key, value in vars(misfit).items()}
            for name, misfit in (("with_it", self.with_it), ("without", self.without))
            if misfit is not None
        }
        return {**plain, "is_taken": self.is_taken, **tried, "frequency_mhz": None}

    def in_words(self) -> str:
        """One line, with what cannot be known."""
        taken = {
            None: "; not tried",
            True: "; taken, with as many grains",
            False: "; not taken: its grains are no more like the real ones",
        }[self.is_taken]
        return (
            f"speckle is as wide as that of a band of {self.band_mhz:.2f} MHz and an aperture of "
            f"{self.aperture_mm_mhz:.0f} mm MHz{taken}; the frequency itself cannot be known from B-mode images"
        )


def point_spread(widths: Sequence[SpeckleWidth], probe: Probe) -> PointSpread:
    """From the widths at some depths, of which axially the smallest counts, as texture only widens.

    Laterally it is the aperture with which `probe`, at its own frequency, focus and receive f-number, is closest to the
    measured widths at these depths, by least squares of their logarithms.
    """
    axial = [w.axial_mm for w in widths if np.isfinite(w.axial_mm)]
    band = BAND_SIGMA / min(axial) if axial else float("nan")
    measured = [(w.depth_mm, w.lateral_mm) for w in widths if np.isfinite(w.lateral_mm)]
    if not measured:
        return PointSpread(band, float("nan"))
    depth, lateral = np.array(measured).T
    apertures = np.geomspace(*_APERTURES_MM, 41)
    # Near the face the receive f-number makes the width, whatever the aperture: depths count by how much they tell
    misfits = [
        float(np.sum(np.log(replace(probe, aperture_mm=float(size)).speckle_sigma_mm(depth) / lateral) ** 2))
        for size in apertures
    ]
    best = apertures[int(np.argmin(misfits))]
    return PointSpread(band, float(best * probe.frequency_mhz))
