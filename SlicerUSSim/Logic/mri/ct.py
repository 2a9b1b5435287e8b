"""Segmentation of a CT into tissues by Hounsfield units (docs/ct.md)."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError, require, require_between, require_kind
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.ct_body import axis_of_slices, cells, extend_into, find_body, pooled
from SlicerUSSim.Logic.mri.ct_classes import BLOOD, NAMES, SKIN_MM, classified, sharpened
from SlicerUSSim.Logic.mri.ct_organs import laid_over, organs_of_ct
from SlicerUSSim.Logic.mri.ct_unit import hounsfield_offset, padding_of
from SlicerUSSim.Logic.mri.filtering import estimate_noise, guided_filter
from SlicerUSSim.Logic.mri.recognition import check_finite
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings
from SlicerUSSim.Logic.mri.segmentation_steps import StepTimes
from SlicerUSSim.Logic.opencl.device import DeviceChoice
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues
from SlicerUSSim.Logic.tissue.label_sources import not_intensities
from SlicerUSSim.Logic.tissue.texture import Texture, tissue_deviation

_log = logging.getLogger(__name__)

#: Numbers beyond these are cut off: padding below air, dense metal
LOWEST_HU, HIGHEST_HU = -1024, 3500
#: Strength of the guided filter, per deviation of the noise
_EPSILON_PER_NOISE = 2.0
#: Part of the noise that the filter leaves
_NOISE_LEFT = 0.5
#: Voxels that are filtered at once
_AT_ONCE = 8_000_000
#: Noise from which on, and voxels from which on, a result is doubtful
_NOISY_HU, _COARSE_MM = 60.0, 3.5
#: Contrast agent that is thicker than a vessel, mm; the heart is, and kidneys
_THICK_MM = 32.0


@dataclass(frozen=True, eq=False)
class CtSegmentation:
    """A label map of a CT, and how it was found."""

    #: uint8; 0 is outside the patient
    labels: Volume
    #: Of labels 1, 2, ...
    tissue_names: tuple[str, ...]
    #: (tissues,) mean and standard deviation of their numbers after the filter, HU
    means: np.ndarray
    standard_deviations: np.ndarray
    #: Standard deviation of the noise in the patient, HU
    noise: float
    #: Lines for the user: what was recognised and decided, and what should be checked
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    #: int16 (k, j, i), HU: after the filter, and with sharp borders
    _filtered: np.ndarray = field(repr=False)
    _sharp: np.ndarray = field(repr=False)

    def texture(self) -> Texture:
        """The part of every voxel on a border that the tissue beside it fills, and the filtered numbers in standard
        deviations of their tissue."""
        second, share = border_shares(self.labels.array, self._filtered, self._sharp, self.noise)
        return Texture(second, share, tissue_deviation(self._filtered, self.labels.array), share)

    def table(self) -> str:
        """Share, volume, mean and standard deviation of every label that occurs in HU, one per line."""
        counts = np.bincount(self.labels.array.ravel(), minlength=len(self.tissue_names) + 1)[1:]
        lines = [f"{'label':>5}  {'tissue':15} {'share':>6} {'ml':>8} {'HU':>6} {'sd':>5}"]
        for n, name in enumerate(self.tissue_names):
            if not counts[n]:
                continue
            lines.append(
                f"{n + 1:5d}  {name:15} {counts[n] / counts.sum():6.1%} {counts[n] * self.labels.voxel_ml:8.1f} "
                f"{self.means[n]:6.0f} {self.standard_deviations[n]:5.0f}"
            )
        return "\n".join(lines)


def segment_ct(
    ct: Volume,
    settings: SegmentationSettings | None = None,
    *,
    organs: LabelledTissues | None = None,
    mask: Volume | None = None,
    skin_mm: float = SKIN_MM,
    device: DeviceChoice = None,
    progress: Callable[[float], None] | None = None,
    **values: Any,
) -> CtSegmentation:
    """Label the tissues of a CT of any part of the body by Hounsfield units: docs/ct.md.

    Labels are those that occur of skin, fat, muscle (all soft tissue), blood (what contrast agent brightens),
    cancellous bone, bone (cortex), metal, lung and air, and the organs of `organs`.

    Parameters
    ----------
    ct : Hounsfield units; an offset of 1000 or 1024 is recognised and removed, with a note.
    organs : label map of organs of this patient on any grid, as tissue.read_label_file reads TotalSegmentator's. Its
        soft tissues replace muscle and blood; its bones fill what the numbers leave open in them. Gas, fat and cortex
        stay as the numbers have them.
    mask : the patient on the grid of `ct` (non-zero is inside); default: found, without couch and clothes.
    settings : of which the guided filter's are used, with its epsilon in HU squared; `values` change them by name.
    skin_mm : thickness of the skin, the outermost layer of the patient; 0: none.
    progress : called with the completed fraction, 0 to 1; it may raise errors.Cancelled.

    Raises SimulationError for an image that is constant or not finite, a label map, an MRI, numbers in another unit,
    an image without a patient, and organs that do not lie in what they are made of.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic import Volume, segment_ct
    >>> y, x = np.indices((60, 60)) - 30
    >>> r = np.hypot(x, y)  # a leg: a bone with its marrow in muscle and fat
    >>> hu = np.select([r < 6, r < 9, r < 22, r < 26], [200.0, 900.0, 50.0, -100.0], -1000.0)
    >>> ct = np.random.default_rng(0).normal(hu, 10.0, (20, 60, 60)).astype(np.float32)
    >>> found = segment_ct(Volume(ct, np.diag([2.0, 2.0, 2.0, 1.0])))
    >>> found.tissue_names
    ('skin', 'fat', 'muscle', 'cancellous bone', 'bone')
    """
    require_kind("ct", ct, Volume, "Volume.read reads a file")
    settings = SegmentationSettings.of(settings, **values)
    require_between("segmentation", "skin_mm", skin_mm, 0.0, 10.0)
    report = progress or (lambda share: None)
    timed, notes, warnings = StepTimes(), [], []
    check_finite(ct, "CT", "by -1000, which is air")
    given, ct, mask = ct, ct.along(), None if mask is None else mask.along()
    offset, note, doubt = _unit_of(ct)
    notes += [] if note is None else [note]
    warnings += [] if doubt is None else [doubt]
    timed("unit")
    report(0.05)
    hu = np.empty(ct.array.shape, np.int16)
    for part in _slabs(ct.array.shape):
        np.rint(np.clip(ct.array[part] - np.float32(offset), LOWEST_HU, HIGHEST_HU), out=hu[part], casting="unsafe")
    padding = _padding(ct, notes)
    if padding is not None:
        extend_into(hu, padding, axis_of_slices(ct))
    noise = _noise_of(hu)
    if settings.filter_radius:
        epsilon = (_EPSILON_PER_NOISE * noise) ** 2 if settings.filter_epsilon is None else settings.filter_epsilon
        hu = _filtered(hu, settings.filter_radius, epsilon, device, lambda share: report(0.05 + 0.45 * share))
    timed("filter")
    left = _NOISE_LEFT * noise if settings.filter_radius else noise
    sharp = sharpened(hu, left)
    timed("borders")
    report(0.6)
    body = _body(sharp, ct, mask, padding, notes)
    timed("body")
    report(0.7)
    classes = classified(sharp, hu, left, body, ct, skin_mm)
    if padding is not None:
        classes[padding] = 0
    timed("classes")
    report(0.85)
    names = NAMES
    if organs is not None:
        on_ct, lines = organs_of_ct(organs, classes, ct)
        warnings += lines
        classes, names, lines = laid_over(on_ct, classes, hu, names)
        notes += lines
        timed("organs")
    warnings += _doubts(classes, ct, noise, organs is not None)
    labels, names = _those_present(classes, names)
    means, deviations = _moments(hu, labels, len(names))
    notes.append(
        "all soft tissue but skin and fat is muscle" if organs is None else "soft tissue without an organ is muscle"
    )
    for line in notes:
        _log.info("%s", line)
    for line in warnings:
        _log.warning("%s", line)
    _log.debug("segmentation of a CT: %s", timed)
    report(1.0)
    labels, hu, sharp = (ct.with_array(array).along(given).array for array in (labels, hu, sharp))
    return CtSegmentation(
        given.with_array(labels), names, means, deviations, noise, tuple(notes), tuple(warnings), hu, sharp
    )


def _unit_of(ct: Volume) -> tuple[float, str | None, str | None]:
    """As hounsfield_offset; label maps are called so."""
    try:
        return hounsfield_offset(ct)
    except SimulationError as error:
        why = not_intensities(ct)
        raise SimulationError(f"CT: {error}" if why is None else f"CT {why}".replace("an MRI", "a CT")) from None


def _slabs(shape: tuple[int, ...], margin: int = 0) -> list[slice]:
    """Slices along k of about _AT_ONCE voxels."""
    count = max(_AT_ONCE // max(int(np.prod(shape[1:])), 1), 2 * margin + 1)
    return [slice(start, min(start + count, shape[0])) for start in range(0, shape[0], count)]


def _noise_of(hu: np.ndarray) -> float:
    """Standard deviation of the noise in soft tissue, HU; from slices in the middle."""
    count = max(_AT_ONCE // max(int(np.prod(hu.shape[1:])), 1), 8)
    first = max((hu.shape[0] - count) // 2, 0)
    middle = hu[first : first + count].astype(np.float32)
    return estimate_noise(middle, (middle > -200.0) & (middle < 300.0))


def _filtered(
    hu: np.ndarray, radius: int, epsilon: float, device: DeviceChoice, report: Callable[[float], None]
) -> np.ndarray:
    """int16, slab by slab: the guided filter needs ten times the memory of an image."""
    result, margin = np.empty_like(hu), 2 * radius
    for part in _slabs(hu.shape, margin):
        wide = slice(max(part.start - margin, 0), min(part.stop + margin, hu.shape[0]))
        values = hu[wide].astype(np.float32)
        found = guided_filter(values, values > -1e9, radius, epsilon, device)[part.start - wide.start :]
        np.rint(np.clip(found[: part.stop - part.start], LOWEST_HU, HIGHEST_HU), out=result[part], casting="unsafe")
        report(part.stop / hu.shape[0])
    return result


def _padding(ct: Volume, notes: list[str]) -> np.ndarray | None:
    """(k, j, i) bool, what lies outside of a round field of view; None where the whole image is in it."""
    number = padding_of(ct)
    if number is None:
        return None
    found = np.asarray(ct.array == number)
    notes.append(
        f"{found.mean():.0%} of the image is {number:g}, outside of the scanner's field of view, and is not labelled"
    )
    return found


def _body(
    sharp: np.ndarray, ct: Volume, mask: Volume | None, padding: np.ndarray | None, notes: list[str]
) -> np.ndarray:
    if mask is not None:
        require(
            mask.array.shape == ct.array.shape and np.allclose(mask.ijk_to_ras, ct.ijk_to_ras, atol=1e-2),
            f"the mask ({mask.size_text}) and the CT ({ct.size_text}) lie on different grids; resample one of them",
        )
        inside = np.asarray(mask.array != 0)
        require(inside.any(), "the mask is empty, expected the patient's voxels not to be 0")
        notes.append(f"patient: the given mask, {inside.sum() * ct.voxel_ml:.0f} ml")
        return inside
    inside, parts = find_body(sharp, ct)
    if inside is None:
        share = float(np.mean(sharp > -250))
        require(
            False,
            f"CT shows no body: {share * 100:.2g} % of it is denser than -250 HU, and no piece of it is 1 cm thick and "
            "has 10 ml; give the patient's mask (--mask), or check the voxel size",
        )
        raise AssertionError
    seen = np.count_nonzero(inside if padding is None else inside & ~padding)
    text = f"patient: {seen * ct.voxel_ml / 1000.0:.3g} litres"
    notes.append(text + (f" in {parts} parts" if parts > 1 else "") + "; couch and clothes are left out")
    return inside


def _doubts(classes: np.ndarray, ct: Volume, noise: float, has_organs: bool) -> list[str]:
    lines = []
    if noise > _NOISY_HU:
        lines.append(
            f"noise is {noise:.0f} HU, expected less than {_NOISY_HU:.0f}: fat and muscle cannot be told apart"
        )
    if ct.spacing_mm.max() > _COARSE_MM:
        lines.append(
            f"slices are {ct.spacing_mm.max():.2g} mm apart, expected up to {_COARSE_MM:g}: borders across them are "
            "coarse"
        )
    if not has_organs:
        size = cells(ct)
        blood = np.pad(pooled((classes == BLOOD).view(np.uint8), size, np.minimum), 1)
        spacing = np.array(size) * ct.spacing_mm[::-1]
        thick = 2.0 * float(np.max(ndimage.distance_transform_edt(blood, sampling=spacing.tolist())))  # type: ignore
        if thick > _THICK_MM:
            lines.append(
                f"what contrast agent brightens is blood, also where it is {thick:.0f} mm thick, as the heart and "
                "kidneys are; a label map of organs (--organs) tells them apart"
            )
    return lines


def _those_present(classes: np.ndarray, names: tuple[str, ...]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Labels renumbered without those that do not occur."""
    counts = np.bincount(classes.ravel(), minlength=len(names) + 1)
    present = [n for n in range(1, len(names) + 1) if counts[n]]
    lookup = np.zeros(256, np.uint8)
    lookup[present] = np.arange(1, len(present) + 1)
    return lookup[classes], tuple(names[n - 1] for n in present)


def _moments(hu: np.ndarray, labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(tissues,) mean and standard deviation."""
    numbers, first, second = (np.zeros(count + 1) for _ in range(3))
    for part in _slabs(hu.shape):
        label, value = labels[part].ravel(), hu[part].ravel().astype(np.float64)
        numbers += np.bincount(label, minlength=count + 1)
        first += np.bincount(label, value, count + 1)
        second += np.bincount(label, value**2, count + 1)
    mean = first / np.maximum(numbers, 1)
    return mean[1:], np.sqrt(np.maximum(second / np.maximum(numbers, 1) - mean**2, 0.0))[1:]


# ---- partial volumes: the part of a voxel on a border that the tissue beside it fills --------------------------------

#: The part of the range between two tissues in which a number tells a share, as in texture.volume_shares; a step is
#: clear from this many deviations of the noise on
_INNER_RANGE, _CLEAR = 0.7, 5.0


def border_shares(
    labels: np.ndarray, filtered: np.ndarray, sharp: np.ndarray, noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """((k, j, i) uint8 label of the other tissue in every voxel, float32 part that it fills, 0 to 1/2).

    A voxel beside another label, whose filtered number lies between the numbers that both have beyond the border (the
    sharpened ones), is filled in that proportion. Of several neighbours the one across the largest step counts.
    """
    second, share = np.zeros(labels.shape, np.uint8), np.zeros(labels.shape, np.float32)
    step = np.zeros(labels.shape, np.int16)
    for axis in range(3):
        for towards in (1, -1):
            here, there = (_side(axis, towards * sign) for sign in (1, -1))
            differs = labels[here] != labels[there]
            rise = sharp[there] - sharp[here]
            larger = differs & (np.abs(rise) > np.abs(step[here])) & (np.abs(rise) > _CLEAR * noise)
            np.copyto(step[here], rise, where=larger)
            np.copyto(second[here], labels[there], where=larger)
    on_border = step != 0
    part = (filtered[on_border].astype(np.float32) - sharp[on_border]) / step[on_border]
    share[on_border] = np.clip((part - 0.5) / _INNER_RANGE + 0.5, 0.0, 0.5)
    return second, share


def _side(axis: int, sign: int) -> tuple[slice, ...]:
    parts = [slice(None)] * 3
    parts[axis] = slice(None, -1) if sign > 0 else slice(1, None)
    return tuple(parts)
