"""What a brain mask cuts off."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.coarse import resampled_to_ras
from SlicerUSSim.Logic.mri.refinement import brightness_near, on_grid, signed_distance

_SPACING_MM = 2.0
#: Depth from which a voxel is surely brain, to compare with
_CORE_MM = 8.0
#: Tissue as bright as the brain, relative to it nearby: darker is CSF or skull in T1, brighter CSF in T2 and fat
_TISSUE = (0.75, 1.25)
#: Depth below and height above the mask's border at which tissue is looked for, and the areas worth a word, cm2
_BELOW_MM, _ABOVE_MM, _WORTH_CM2, _WORTH_AT_BASE_CM2 = 3.0, 4.0, 6.0, 20.0
#: Voxels across the border are counted in a layer of _ABOVE_MM.
_CM2_OF_VOXEL = _SPACING_MM**3 / _ABOVE_MM / 100.0
#: Directions of a sector, by axis (k, j, i) and sign; from how many on it is said that the border is so all around
_SECTORS, _ALL_AROUND = (("bottom", "top"), ("back", "front"), ("left", "right")), 4
#: Share of voxels with the value of the first one, from which they are a background that was set
_STRIPPED = 0.15


@dataclass(frozen=True, eq=False)
class _Checked:
    """An image and its mask on a grid along the axes of the patient, arrays (k, j, i)."""

    mask: np.ndarray
    #: Relative to the brain nearby
    brightness: np.ndarray
    #: Depth below the mask's border, mm, negative outside
    depth: np.ndarray
    #: Whether the image shows the voxel
    is_shown: np.ndarray

    @classmethod
    def of(cls, mri: Volume, inside: np.ndarray) -> _Checked | None:
        """None for a slab of a brain, with nothing deep to compare with."""
        values = mri.array
        background = values == values[0, 0, 0]
        if float(background.mean()) > _STRIPPED:  # around z-scores of a brain it is 0, as bright as the brain
            values = np.where(background, values.min(), values)
        image, origin = resampled_to_ras(mri.with_array(values), _SPACING_MM)
        matrix = np.diag([_SPACING_MM] * 3 + [1.0])
        matrix[:3, 3] = origin
        grid = Volume(image, matrix)
        mask = on_grid(mri.with_array(inside), grid) > 0.5
        is_shown = on_grid(mri.with_array(np.ones(inside.shape, bool)), grid) > 0.99
        depth = _depth(mask)
        core = depth > _CORE_MM
        return cls(mask, brightness_near(image, core, _SPACING_MM), depth, is_shown) if core.any() else None


def _depth(mask: np.ndarray) -> np.ndarray:
    return -signed_distance(mask, np.full(3, _SPACING_MM), 2.0 * _ABOVE_MM)


def ends_at_edge(mri: Volume, inside: np.ndarray) -> tuple[str, ...]:
    """One line for each edge of the image that cuts the brain (k, j, i) off; at the bottom only over a larger area.

    A whole brain does not reach the edge but for the stem, however little of scalp and skull is shown.
    """
    lines = []
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        cm2 = float(np.linalg.norm(np.cross(*mri.ijk_to_ras[:3, others].T))) / 100.0
        for end in (0, -1):
            area = float(inside.take(end, 2 - axis).sum()) * cm2
            outwards = mri.ijk_to_ras[:3, axis] * (1 if end else -1)
            main = int(np.abs(outwards).argmax())
            name = _SECTORS[2 - main][int(outwards[main] > 0)]
            if area >= (_WORTH_AT_BASE_CM2 if name == "bottom" else _WORTH_CM2):
                lines.append(f"the brain reaches the {name} edge of the image over {area:.0f} cm2: it is cut off there")
    return tuple(lines)


def cut_off(mri: Volume, inside: np.ndarray) -> tuple[str, ...]:
    """One line if the mask's border runs through tissue as bright as the brain; nothing if it does not.

    Not at the edge of the image, and at the skull base, where nerves, vessels and the spinal cord leave, only over a
    larger area: whole masks of four heads had up to 5 cm2 there, without the lower 25 to 60 mm 25 to 155 cm2.
    """
    checked = _Checked.of(mri, inside)
    if checked is None:
        return ()
    depth, bright = checked.depth, checked.brightness
    tissue = (bright > _TISSUE[0]) & (bright < _TISSUE[1]) & checked.is_shown
    # The border is cut where tissue goes on without a gap from below it to well above it.
    above = (depth < 0.0) & (depth >= -_ABOVE_MM) & tissue
    below = (depth > 0.0) & (depth <= _BELOW_MM) & tissue
    solid = cast(np.ndarray, ndimage.binary_opening(tissue, np.ones((2, 2, 2))))
    across = cast(np.ndarray, ndimage.binary_dilation(below, iterations=2)) & above & solid
    points = np.argwhere(checked.mask)
    centre, extent = points.mean(axis=0), np.ptp(points, axis=0)
    base = int(centre[0] + 10.0 / _SPACING_MM)
    found = np.vstack(
        [_pieces(across, slice(base, None), _WORTH_CM2), _pieces(across, slice(base), _WORTH_AT_BASE_CM2)]
    )
    if len(found) == 0:
        return ()
    away = (found - centre) / extent
    axes = np.abs(away).argmax(axis=1)
    sectors = 2 * axes + (np.take_along_axis(away, axes[:, None], 1)[:, 0] > 0)
    areas = np.bincount(sectors, minlength=6) * _CM2_OF_VOXEL
    names = [name for pair in _SECTORS for name in pair]
    worth = [n for n in np.argsort(-areas) if areas[n] >= _WORTH_CM2] or [int(areas.argmax())]
    places = [names[n] for n in worth]
    where = "at the " + " and ".join([", ".join(places[:-1]), places[-1]] if len(places) > 1 else places)
    if len(places) >= _ALL_AROUND:
        where = "all around"
    return (
        f"the mask ends in tissue as bright as the brain over {areas.sum():.0f} cm2 {where}; check the cortex there",
    )


def _pieces(across: np.ndarray, slices: slice, worth_cm2: float) -> np.ndarray:
    """(voxels, 3) k, j, i of the connected pieces within these slices that are as large as `worth_cm2`."""
    parts, _ = cast(tuple[np.ndarray, int], ndimage.label(across[slices], np.ones((3, 3, 3))))
    sizes = np.bincount(parts.ravel()) * _CM2_OF_VOXEL
    sizes[0] = 0.0
    return np.argwhere((sizes >= worth_cm2)[parts]) + [slices.start or 0, 0, 0]


# ---- do labels and an MRI belong to one patient? Intensities then change where labels do -----------------------------

#: Labelled voxels that are looked at; the share of them that has to lie in the MRI
_SAMPLES, _LEAST_INSIDE = 40_000, 0.5
#: The labels are moved by so much along either direction of the three axes, for comparison
_MOVED_MM = 6.0
#: How many times as much of the variance of the intensities they explain in their place as in the best other place:
#: 3.5 to 28 of a patient's own (also those of another contrast: 4.3 and 10.6), at most 1.4 of another head's that was
#: registered to the same template
_LEAST_GAIN = 2.0


def follows(mri: Volume, labels: Volume) -> bool:
    """Whether the intensities of an MRI follow labels, as those of the same head in the same frame do.

    Measured by the share of the variance of the intensities that is between tissues (the correlation ratio of Roche et
    al., "The correlation ratio as a new similarity measure for multimodal image registration", MICCAI 1998), in the
    labels' place and 6 mm beside it. False also where nothing can be seen, as with labels of one tissue.

    Parameters
    ----------
    mri : (k, j, i) intensities.
    labels : (k, j, i) tissues, 0 is none; on any grid.
    """
    places = np.argwhere(labels.array > 0)
    if not len(places):
        return False
    places = places[np.random.default_rng(0).integers(len(places), size=_SAMPLES)]
    tissues = labels.array[tuple(places.T)]
    points = places[:, ::-1] @ labels.ijk_to_ras[:3, :3].T + labels.ijk_to_ras[:3, 3]
    steps = [np.eye(3)[axis] * way * _MOVED_MM for axis, way in itertools.product(range(3), (-1, 1))]
    beside = max(_explained(mri, points + step, tissues) for step in steps)
    return _explained(mri, points, tissues) > _LEAST_GAIN * beside


def _explained(mri: Volume, points: np.ndarray, tissues: np.ndarray) -> float:
    """Share of the variance of the intensities at points [mm RAS] that is between tissues; 0 outside the MRI."""
    index = points @ mri.ras_to_ijk[:3, :3].T + mri.ras_to_ijk[:3, 3]
    inside = ((index > -0.5) & (index < np.array(mri.array.shape[::-1]) - 0.5)).all(axis=1)
    if inside.mean() < _LEAST_INSIDE:
        return 0.0
    values = ndimage.map_coordinates(mri.array, index[inside, ::-1].T, np.float32, order=1, mode="nearest")
    values = np.clip(values, *np.percentile(values, [1.0, 99.0]))  # not led by a few bright vessels
    tissues = np.unique(tissues[inside], return_inverse=True)[1]
    counts = np.bincount(tissues)
    means = np.bincount(tissues, values) / counts
    total = float(((values - values.mean()) ** 2).sum())
    return float((counts * (means - values.mean()) ** 2).sum()) / total if total > 0.0 else 0.0
