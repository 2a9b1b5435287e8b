"""Tissues added on top of a segmentation: tumour, oedema, cyst and others, from masks on any grid.

Segmentations by intensity cannot tell a tumour from grey matter; a mask drawn by hand, by a network or published with
the images can.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError, either, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.coarse import with_thin_slices
from SlicerUSSim.Logic.mri.masks import Masks, read_masks, resampled
from SlicerUSSim.Logic.tissue.names import labels_of, same_name, similar_tissues, tissue_named
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import MAX_LABEL, TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture, tissue_deviation

_log = logging.getLogger(__name__)

#: Tissues that are usually added, for choices; "brats" is a map of several.
LESIONS = ("tumour", "oedema", "necrosis", "cyst", "haematoma", "cavity", "enhancing", "blood", "brats")
#: Of the lesions that are there, a probe looks at those of the first of these groups. What enhances belongs to the
#: first beside others of it; alone it is veins, a class of a T1 with contrast agent
LESION_GROUPS = (("tumour", "enhancing", "necrosis", "cyst", "haematoma"), ("cavity",), ("oedema",))
ENHANCING = "enhancing"
#: A mask of more than this share of the patient is not a lesion.
_LARGEST_SHARE = 0.6
#: A mask without a voxel in the patient may lie this far from it: a meningioma that brain extraction has cut off, bone.
_FARTHEST_MM = 5.0
#: Shares below these are not mentioned.
_LEAST_LEFT_OUT, _LEAST_OVER = 0.02, 0.01


@dataclass(frozen=True, eq=False)
class Added:
    """A label map with one or several tissues on top, and what was done."""

    labels: Volume
    #: Name of label 1, 2, ...; "" for a label that is not in use
    tissue_names: tuple[str, ...]
    #: A line for each tissue: "tumour: 799 voxels, 0.8 ml, added over grey matter 60 %, white matter 38 %"
    messages: tuple[str, ...] = ()
    #: A line for each thing that a user should check
    warnings: tuple[str, ...] = ()

    def centre_ras(self, before: Volume) -> np.ndarray | None:
        """(3,) RAS mm of the innermost voxel of the largest region that differs from `before`; None without any.

        Of lesions among what differs only those of the first group of LESION_GROUPS: a tumour before its oedema.
        """
        differs = self.labels.array != before.array
        for group in LESION_GROUPS:
            lesion = differs & np.isin(self.labels.array, labels_of(self.tissue_names, group))
            if lesion.any():
                differs = lesion
                break
        parts, count = ndimage.label(differs)  # type: ignore[misc]
        if not count:
            return None
        largest = np.bincount(parts.ravel())[1:].argmax()
        box = ndimage.find_objects(parts)[largest]
        return innermost_ras(parts[box] == largest + 1, self.labels, [part.start for part in box])

    def table(self, tissues: TissueTable) -> TissueTable:
        """The tissue table of the labels before, with the tissues of new labels from the presets."""
        mine = {tissue.name: tissue for tissue in tissues.all_tissues()[::-1]}
        new = {label: name for label, name in enumerate(self.tissue_names, 1) if name and label not in tissues}
        table = {**tissues, **{label: mine.get(name) or tissue_named(name) for label, name in new.items()}}
        return tissues.with_labels(table)


def innermost_ras(where: np.ndarray, grid: Volume, first: Sequence[int] = (0, 0, 0)) -> np.ndarray:
    """(3,) RAS mm of the innermost voxel of a region on the grid of a volume.

    `where` (k, j, i) bool, not empty, is a part of the grid that begins at its voxel `first`.
    """
    depth = np.asarray(ndimage.distance_transform_edt(np.pad(where, 1)))
    place = np.add(np.unravel_index(int(np.argmax(depth)), depth.shape), first) - 1
    return grid.ijk_to_ras[:3] @ np.append(place[::-1], 1.0)


def tissue_to_add(name: str, tissue_names: Iterable[str] = ()) -> str:
    """The tissue that `name` means: one of `tissue_names` or of the presets.

    Raises SimulationError that lists the tissues for an unknown one.

    >>> from SlicerUSSim.Logic.mri.pathology import tissue_to_add
    >>> tissue_to_add("Edema")
    'oedema'
    """
    tissue_names = tuple(tissue_names)
    known = next((mine for mine in tissue_names if mine and same_name(mine, name)), None)
    if known is not None:
        return known
    try:
        return tissue_named(name).name
    except SimulationError:
        similar = similar_tissues(name, tissue_names)
        mine = [own for own in dict.fromkeys(tissue_names) if own and own not in TISSUES]
        expected = f"one of: {', '.join([*mine, *TISSUES])}"
        if similar:
            expected = either(similar)
        raise SimulationError(f"no tissue is called {name!r}, expected {expected}") from None


def add_tissue(
    labels: Volume,
    tissue_names: Sequence[str],
    mask: Volume,
    tissue: str,
    *,
    source: str = "the mask",
    has_brain_mask: bool = False,
) -> Added:
    """Lay a tissue over a label map, where a mask on any grid is inside.

    Parameters
    ----------
    labels : (k, j, i) whole numbers, 0 outside the patient.
    tissue_names : of labels 1, 2, ...
    mask : not zero inside; or probabilities from 0 to 1, inside above 0.5. It is interpolated linearly at the voxels of
        `labels`, or averaged over them where they are larger.
    tissue : a name of `tissue_names` or of the presets: "tumour", "oedema", "necrosis", "cyst", "haematoma", "cavity";
        "brats" adds every label by its name in `mask.label_names`, or as a BraTS map: 1 necrosis, 2 oedema,
        3 enhancing, 4 cavity (4 enhancing without 3; "brats-2022" and "brats-2023" say which).
    source : of the mask, for messages.
    has_brain_mask : whether the labels are a segmentation within a brain mask, which may have cut a lesion off.

    Voxels outside the patient are labelled too, with a warning. Raises SimulationError for an unknown tissue, a mask
    that is empty or no mask, one that does not meet the patient (other patient, other frame), and one that covers more
    than 60 % of it.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic import Volume
    >>> from SlicerUSSim.Logic.mri import add_tissue
    >>> labels = Volume(np.ones((40, 40, 40), np.uint8), np.eye(4))
    >>> cube = np.zeros((40, 40, 40), np.uint8)
    >>> cube[10:20, 10:20, 10:20] = 1
    >>> added = add_tissue(labels, ["white matter"], Volume(cube, np.eye(4)), "tumor")
    >>> added.messages
    ('tumour: 1000 voxels, 1.0 ml, added over white matter 100 %',)
    >>> added.tissue_names
    ('white matter', 'tumour')
    """
    return _added(labels, tissue_names, read_masks(mask, mask_tissue(tissue, tissue_names), source), has_brain_mask)


def add_tissues(
    labels: Volume,
    tissue_names: Sequence[str],
    masks: Iterable[tuple[str, Volume, str]],
    *,
    also: Iterable[str] = (),
    has_brain_mask: bool = False,
) -> Added:
    """Lay several tissues over a label map, the last on top; each is (tissue, mask, source) as in add_tissue.

    `also` are names of tissues besides those of the labels and the presets; `has_brain_mask` as in add_tissue.
    """
    result = Added(labels, tuple(tissue_names))
    for name, mask, source in masks:
        tissue = mask_tissue(name, (*result.tissue_names, *also))
        more = _added(result.labels, result.tissue_names, read_masks(mask, tissue, source), has_brain_mask)
        result = replace(more, messages=result.messages + more.messages, warnings=result.warnings + more.warnings)
    return result


def mask_tissue(name: str, tissue_names: Iterable[str] = ()) -> str:
    """As tissue_to_add; "brats" is itself, and with a year "brats-2022" (until then) or "brats-2023" (since)."""
    brats = re.fullmatch(r"brats\W*(20\d\d)?", name.strip().lower())
    if brats is None:
        return tissue_to_add(name, tissue_names)
    return "brats" if not brats[1] else "brats-2022" if int(brats[1]) <= 2022 else "brats-2023"


def texture_below(texture: Texture, mri: Volume, before: Volume, after: Volume) -> Texture:
    """The texture of an MRI's segmentation `before`, with tissues added on top in `after`: their labels are certain.

    All are on one grid, but the MRI may have the thick slices that were divided.
    """
    mri = with_thin_slices(mri)
    changed = after.array != before.array
    region = np.where(changed, after.array, 0)
    deviation = tissue_deviation(np.where(changed, mri.array, 0).astype(np.float32), region)
    return Texture(
        texture.second_label,
        np.where(changed, np.float32(0), texture.second_share),
        np.where(changed, deviation, texture.deviation).astype(np.float32),
        None if texture.volume_share is None else np.where(changed, np.float32(0), texture.volume_share),
    )


def _added(labels: Volume, names: Sequence[str], masks: Masks, has_brain_mask: bool) -> Added:
    array, names = labels.array, tuple(names)
    require(
        bool(np.issubdtype(array.dtype, np.integer)), f"the labels hold {array.dtype} numbers, expected whole numbers"
    )
    patient = int((array > 0).sum())
    require(patient > 0, "the labels are all 0, expected a patient to add to")
    where, numbers, lost = resampled(masks, labels)
    below = array[where]
    covered = below[numbers > 0]
    met = int((covered > 0).sum())
    voxel_mm3 = 1000.0 * labels.voxel_ml
    require(
        covered.size > 0 or lost == 1.0,
        f"{masks.source}: {masks.volume_ml * 1000:.2g} mm³ are too small for the voxels of the labels, "
        f"{voxel_mm3:.2g} mm³; nothing would be added",
    )
    if not met:
        apart_mm = _mm_outside(array > 0, labels, masks)
        require(
            apart_mm <= _FARTHEST_MM,
            f"{masks.source}: lies {apart_mm:.0f} mm outside the patient, expected a mask in the frame of the MRI or "
            "labels; is it of another patient, or not registered?",
        )
    require(
        met <= _LARGEST_SHARE * patient,
        f"{masks.source}: covers {met / patient:.0%} of the patient, expected a lesion in it; is it the mask of the "
        "brain (--mask)?",
    )
    result, messages = array.astype(np.promote_types(array.dtype, np.uint8)), []
    for number, tissue in enumerate(masks.tissues, 1):
        over = below[numbers == number]
        if over.size:
            label, names = _label_of(tissue, array, names)
            result[where][numbers == number] = label
            messages.append(_message(tissue, over, names, voxel_mm3))
    warnings = (*masks.warnings, *_warnings(masks, covered, lost, has_brain_mask))
    for line in messages:
        _log.info("%s", line)
    for line in warnings:
        _log.warning("%s", line)
    return Added(labels.with_array(result), names, tuple(messages), warnings)


def _label_of(tissue: str, array: np.ndarray, names: Sequence[str]) -> tuple[int, tuple[str, ...]]:
    """The label of a tissue, a free one if it has none, and the names with it."""
    if tissue in names:
        return list(names).index(tissue) + 1, tuple(names)
    used = np.bincount(array.ravel(), minlength=MAX_LABEL + 1) > 0
    named = [*(bool(name) for name in names), *[False] * MAX_LABEL]
    free = [label for label in range(1, MAX_LABEL + 1) if not used[label] and not named[label - 1]]
    require(bool(free), f"the labels 1 to {MAX_LABEL} are all in use, expected a free one for {tissue}")
    longer = [*names, *[""] * (free[0] - len(names))]
    longer[free[0] - 1] = tissue
    return free[0], tuple(longer)


def _mm_outside(patient: np.ndarray, grid: Volume, masks: Masks) -> float:
    """Least distance of the voxels in the masks from the patient, bool (k, j, i) on a grid."""
    from scipy.spatial import KDTree  # not needed for an image without masks

    points = masks.union.ijk_to_ras[:3, :3] @ np.argwhere(masks.inside)[:, ::-1].T + masks.union.ijk_to_ras[:3, 3:]
    surface = np.argwhere(patient & ~ndimage.binary_erosion(patient))  # type: ignore[operator]
    places = surface[:, ::-1] @ grid.ijk_to_ras[:3, :3].T + grid.ijk_to_ras[:3, 3]
    return float(KDTree(places).query(points.T)[0].min())


def box_ras(inside: np.ndarray, volume: Volume) -> tuple[np.ndarray, np.ndarray]:
    """((3,) lowest, (3,) highest) RAS mm of the voxels of a (k, j, i) mask that is not empty."""
    ends = [np.flatnonzero(inside.any(axis=tuple({0, 1, 2} - {axis})))[[0, -1]] for axis in (2, 1, 0)]
    corners = np.array(np.meshgrid(*ends, indexing="ij")).reshape(3, -1)
    points = (volume.ijk_to_ras @ np.vstack([corners, np.ones(corners.shape[1])]))[:3]
    return points.min(axis=1), points.max(axis=1)


def _message(tissue: str, before: np.ndarray, names: Sequence[str], voxel_mm3: float) -> str:
    counts = np.bincount(before)
    over = []
    for label in np.argsort(-counts, kind="stable"):
        share = counts[label] / before.size
        name = names[label - 1] if 0 < label <= len(names) and names[label - 1] else f"label {label}"
        if share >= _LEAST_OVER:
            over.append(f"{name if label else 'voxels outside'} {100 * share:.0f} %")
    cubic_mm = before.size * voxel_mm3
    volume = f"{cubic_mm / 1000:.1f} ml" if cubic_mm >= 50.0 else f"{cubic_mm:.2g} mm³"
    return f"{tissue}: {before.size} voxel{'s' * (before.size > 1)}, {volume}, added over {', '.join(over)}"


def _warnings(masks: Masks, covered: np.ndarray, lost: float, has_brain_mask: bool) -> Iterable[str]:
    left_out = float((covered == 0).mean())
    if left_out >= _LEAST_LEFT_OUT:
        where = f"the brain mask leaves out {left_out * 100:.0f} % of {masks.source}"
        if not has_brain_mask:
            where = f"{left_out * 100:.0f} % of {masks.source} lie where the labels have no tissue"
        yield f"{where}; those voxels are added"
    if lost >= _LEAST_LEFT_OUT:
        yield f"{lost * 100:.0f} % of {masks.source} lie outside the volume of the labels and are not added"
