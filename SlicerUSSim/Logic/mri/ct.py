"""Segmentation of a CT into tissues by Hounsfield units (docs/ct.md)."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require, require_between, require_kind
from SlicerUSSim.Logic.base.neighbourhood import smallest_around
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.ct_body import find_body
from SlicerUSSim.Logic.mri.ct_classes import AIR, BLOOD, BONE, LUNG, NAMES, SKIN_MM, SOFT, SPONGY, classified, sharpened
from SlicerUSSim.Logic.mri.ct_unit import FIELD_HU, hounsfield_offset
from SlicerUSSim.Logic.mri.filtering import estimate_noise, guided_filter
from SlicerUSSim.Logic.mri.recognition import check_finite
from SlicerUSSim.Logic.mri.segmentation import label_table
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings
from SlicerUSSim.Logic.opencl.device import DeviceChoice
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues
from SlicerUSSim.Logic.tissue.texture import Texture, tissue_deviation

_log = logging.getLogger(__name__)

#: Numbers beyond these are cut off: padding below air, dense metal
LOWEST_HU, HIGHEST_HU = -1024, 3500
#: Strength of the guided filter per deviation of the noise, the part of the noise that it leaves, and voxels at once
_EPSILON_PER_NOISE, _NOISE_LEFT, _AT_ONCE = 2.0, 0.5, 8_000_000
#: Noise above which fat and muscle cannot be told apart; the least patient
_NOISY_HU, _LEAST_ML = 60.0, 10.0
#: Tissues of a label map of organs that the numbers know better, and those of bone
_BY_NUMBER = {"lung", "air", "fat", "skin", "scalp", "metal", "muscle", "coupling"}
_BONES = {"bone", "skull", "cancellous bone"}
#: Vessels stay blood in an organ above its median by at least this much, HU
_ABOVE_ORGAN_HU = 45.0
#: What organs are made of, whose contents do not vary; the least share to take them for this patient's
_MADE_OF = {"lung": ("lung or gas", (LUNG, AIR))} | dict.fromkeys(
    ("liver", "spleen", "kidney", "heart"), ("soft tissue", (SOFT, BLOOD))
)
_LEAST_IN_PLACE = 0.85


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
        """Share, volume, mean and standard deviation in HU of every label that occurs, one per line."""
        return label_table(self.labels, self.tissue_names, self.means, self.standard_deviations)


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

    Raises SimulationError for an image that is constant or not finite, a label map, an MRI, a window of a CT, an image
    without a patient, and organs that do not meet the CT.

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
    check_finite(ct, "CT", "by -1000, which is air")
    given, ct, mask = ct, ct.along(), None if mask is None else mask.along()
    offset, line = hounsfield_offset(ct)
    notes, warnings = [], [] if line is None else [line]
    require(
        mask is None or (mask.size_text == ct.size_text and np.allclose(mask.ijk_to_ras, ct.ijk_to_ras, atol=1e-2)),
        "the mask and the CT lie on different grids; resample one of them",
    )
    hu = np.rint(np.clip(ct.array - np.float32(offset), LOWEST_HU, HIGHEST_HU)).astype(np.int16)
    out_of_field = np.asarray(ct.array < FIELD_HU)
    if out_of_field.any():
        _extend_into(hu, out_of_field)
        notes.append(f"{out_of_field.mean():.0%} of the image is outside of the scanner's field of view, not labelled")
    slabs = _slabs(hu.shape)
    middle = hu[slabs[(len(slabs) - 1) // 2]].astype(np.float32)
    noise = left = estimate_noise(middle, (middle > -200.0) & (middle < 300.0))
    if settings.filter_radius:
        epsilon = (_EPSILON_PER_NOISE * noise) ** 2 if settings.filter_epsilon is None else settings.filter_epsilon
        hu = _filtered(hu, settings.filter_radius, epsilon, device, lambda share: report(0.05 + 0.45 * share))
        left = _NOISE_LEFT * noise
    sharp = sharpened(hu, left)
    report(0.6)
    body = find_body(sharp, ct) if mask is None else mask.array != 0
    body &= ~out_of_field
    millilitres = np.count_nonzero(body) * ct.voxel_ml
    require(
        millilitres >= _LEAST_ML,
        f"the patient in the CT has {millilitres:.3g} ml, expected at least {_LEAST_ML:g} ml denser than -250 HU and "
        "thicker than 1 cm; give the patient's mask (--mask), or check the voxel size",
    )
    notes.append(f"patient: {millilitres / 1000.0:.3g} litres, " + ("couch left out" if mask is None else "as given"))
    labels, names = classified(sharp, hu, left, body, ct, skin_mm), NAMES
    report(0.85)
    if not np.any(labels == BONE):
        warnings.append(f"no bone was found; the densest is {sharp[body].max()} HU, expected 700 or more in a whole CT")
    if noise > _NOISY_HU:
        warnings.append(f"noise is {noise:.0f} HU, expected less than {_NOISY_HU:.0f} to tell fat and muscle apart")
    if organs is None:
        notes.append("soft tissue is muscle, and blood where contrast agent brightens it; --organs tells organs apart")
    else:
        names, lines = _lay_over(labels, hu, organs, ct)
        warnings += lines
        notes.append(f"organs: {', '.join(names[len(NAMES) :]) or 'none'}; other soft tissue is muscle")
    present = [0, *(label for label in np.unique(labels) if label)]
    labels = np.searchsorted(present, np.arange(256)).astype(np.uint8)[labels]
    names = tuple(names[n - 1] for n in present[1:])
    of_label = [hu[labels == label] for label in range(1, len(names) + 1)]
    means, deviations = (np.array([f(values, dtype=np.float64) for values in of_label]) for f in (np.mean, np.std))
    for level, line in [(logging.INFO, line) for line in notes] + [(logging.WARNING, line) for line in warnings]:
        _log.log(level, "%s", line)
    report(1.0)
    labels, hu, sharp = (ct.with_array(array).along(given).array for array in (labels, hu, sharp))
    return CtSegmentation(
        given.with_array(labels), names, means, deviations, noise, tuple(notes), tuple(warnings), hu, sharp
    )


def _slabs(shape: tuple[int, ...], margin: int = 0) -> list[slice]:
    """Slices along k of about _AT_ONCE voxels."""
    count = max(_AT_ONCE // max(int(np.prod(shape[1:])), 1), 2 * margin + 1)
    return [slice(start, min(start + count, shape[0])) for start in range(0, shape[0], count)]


def _extend_into(hu: np.ndarray, out_of_field: np.ndarray) -> None:
    """Fill what is out of a round field of view in every slice with the nearest number in it: no surface is there."""
    for values, outside in zip(hu, out_of_field, strict=True):
        if outside.any() and not outside.all():
            indices: Any = ndimage.distance_transform_edt(outside, return_distances=False, return_indices=True)
            values[outside] = values[tuple(indices[:, outside])]


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


def _lay_over(
    classes: np.ndarray, hu: np.ndarray, organs: LabelledTissues, ct: Volume
) -> tuple[tuple[str, ...], list[str]]:
    """(names of the (k, j, i) classes and of the organs that become some, lines about what should be checked).

    Soft organs replace muscle and blood; vessels in them that stand out stay. Bones of the label map are cancellous
    where the numbers have soft tissue in them, one voxel below their surface.
    Raises SimulationError for organs that do not meet the CT.
    """
    volume = organs.labels
    to_organs = (volume.ras_to_ijk @ ct.ijk_to_ras)[[2, 1, 0, 3]][:, [2, 1, 0, 3]]
    on_ct: Any = ndimage.affine_transform(
        volume.array.astype(np.uint8), to_organs[:3, :3], to_organs[:3, 3].tolist(), ct.array.shape, order=0
    )
    require(on_ct.any(), "the label map of organs does not meet the CT, expected one of this patient in its frame")
    names, lines, of_ct = NAMES, [], classes.copy()
    for label, name in enumerate(organs.names, 1):
        where = on_ct == label
        if not where.any():
            continue
        what, made_of = _MADE_OF.get(name, ("tissue", range(1, len(NAMES) + 1)))
        share = float(np.isin(of_ct[where], made_of).mean())
        if share < _LEAST_IN_PLACE:
            lines.append(
                f"organs: {name}: {share:.0%} of it is {what} in the CT, expected {_LEAST_IN_PLACE:.0%} or more: is "
                "the label map of this CT, and in its frame?"
            )
        soft = where & ((of_ct == SOFT) | (of_ct == BLOOD))
        if name in _BONES:
            classes[smallest_around(where) & soft] = SPONGY
        elif name == "blood":
            classes[soft] = BLOOD
        elif name not in _BY_NUMBER and soft.any():
            names = names if name in names else (*names, name)
            is_vessel = (of_ct == BLOOD) & (hu > float(np.median(hu[soft])) + _ABOVE_ORGAN_HU)
            classes[soft & ~is_vessel] = names.index(name) + 1
    return names, lines


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
    forth, back = slice(None, -1), slice(1, None)
    for axis in range(3):
        label, number, other, most = (np.moveaxis(array, axis, 0) for array in (labels, sharp, second, step))
        for here, there in ((forth, back), (back, forth)):
            rise = number[there] - number[here]
            differs = (label[here] != label[there]) & (np.abs(rise) > _CLEAR * noise)
            larger = differs & (np.abs(rise) > np.abs(most[here]))
            np.copyto(most[here], rise, where=larger)
            np.copyto(other[here], label[there], where=larger)
    on_border = step != 0
    part = (filtered[on_border].astype(np.float32) - sharp[on_border]) / step[on_border]
    share[on_border] = np.clip((part - 0.5) / _INNER_RANGE + 0.5, 0.0, 0.5)
    return second, share
