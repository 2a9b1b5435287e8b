"""What a user gives with an MRI: brain masks, what is refused and to be checked; and whether labels belong to it."""

from __future__ import annotations

import itertools

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require, require_kind
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.masks import several_segments
from SlicerUSSim.Logic.mri.recognition import POSSIBLE_ML, USUAL_ML
from SlicerUSSim.Logic.probe.poses import sample

#: Labels of a segmentation count as inside too; an image has more values
_MOST_MASK_VALUES = 128
#: What a filter leaves beyond 0 and 1
_ROUNDING = 1e-3


def checked_mask(mask: Volume, mri: Volume) -> np.ndarray:
    """(k, j, i) True in the mask. Raises SimulationError as brain.given_brain."""
    require_kind("mask", mask, Volume, "Volume.read reads a file")
    name = f"mask {mask.name}" if mask.name else "mask"
    mask = mask.along(mri)
    require(
        mask.array.shape == mri.array.shape,
        f"{name} has {mask.size_text} voxels and the MRI {mri.size_text}, expected the same grid; resample the mask",
    )
    corners = np.array([[0, 0, 0, 1], [*(np.array(mri.array.shape[::-1]) - 1), 1]]).T
    apart = float(np.linalg.norm((mask.ijk_to_ras - mri.ijk_to_ras) @ corners, axis=0).max())
    require(
        np.allclose(mask.ijk_to_ras, mri.ijk_to_ras, atol=1e-3),
        f"{name} lies up to {apart:.1f} mm from the MRI's voxels, expected the same origin, spacing and directions; "
        "resample the mask",
    )
    if np.issubdtype(mask.array.dtype, np.floating) and float(mask.array.max()) <= 1.0 + _ROUNDING:
        mask = mask.with_array(mask.array > 0.5)  # probabilities
    values = np.unique(mask.array[:: max(mask.array.shape[0] // 16, 1)])
    require(
        len(values) <= _MOST_MASK_VALUES,
        f"{name} has {len(values)} or more different values, expected 0 outside and one value inside: is it an image?",
    )
    inside = mask.array > 0
    require(bool(inside.any()), f"{name} is empty, expected at least one voxel inside")
    millilitres = float(inside.sum() * mri.voxel_ml)
    require(
        millilitres <= POSSIBLE_ML[1],
        f"{name} has {millilitres:.0f} ml, expected a brain ({USUAL_ML[0]:.0f} to {USUAL_ML[1]:.0f} ml) or a part of "
        f"one; it covers {inside.mean():.0%} of the image: for all of that, give --skull-strip none and no mask",
    )
    return inside


def label_doubts(mask: Volume) -> tuple[str, ...]:
    """A warning about a mask that is a label map, all of whose labels are taken."""
    values = np.unique(mask.array[mask.array > 0])
    if len(values) < 2 or (values < 1).any():
        return ()
    listed = several_segments(mask) or ", ".join(f"{value:g}" for value in values)
    return (
        f"the mask holds the labels {listed}, expected one; the brain is taken where any of them is: if some are not "
        "brain, export the brain alone",
    )


def volume_doubts(millilitres: float) -> tuple[str, ...]:
    """A warning about a brain that is smaller or larger than an adult's."""
    if USUAL_ML[0] <= millilitres <= USUAL_ML[1]:
        return ()
    return (
        f"the brain has {millilitres:.0f} ml, expected {USUAL_ML[0]:.0f} to {USUAL_ML[1]:.0f} ml of an adult; check "
        "the mask: the space outside it has no tissue (a lesion is added with --add tumour=FILE)",
    )


# ---- do labels and an MRI belong to one patient? Intensities then change where labels do -----------------------------

#: Labelled voxels that are looked at; the share of them that has to lie in the MRI
_SAMPLES, _LEAST_INSIDE = 40_000, 0.5
#: The labels are moved this far along either direction of the three axes, for comparison; by the first of these with
#: which they no longer explain more than this share of intensities that are exactly theirs. A direction in which they
#: do so still, such as a cylinder's axis, is ignored.
_MOVED_MM, _MOST_ALIKE = (6.0, 12.0, 24.0), 0.35
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
    labels : (k, j, i) tissues, 0 without one; on any grid.
    """
    places = np.argwhere(labels.array > 0)
    if not len(places):
        return False
    places = places[np.random.default_rng(0).integers(len(places), size=_SAMPLES)]
    tissues = labels.array[tuple(places.T)]
    points = places[:, ::-1] @ labels.ijk_to_ras[:3, :3].T + labels.ijk_to_ras[:3, 3]
    # An image in which every tissue has its mean intensity, and all else the least
    lookup, values = np.full(int(tissues.max()) + 1, mri.array.min(), np.float32), sample(mri, points)
    lookup[tissues] = (np.bincount(tissues, values) / np.maximum(np.bincount(tissues), 1))[tissues]
    exact = labels.with_array(lookup[np.minimum(labels.array, len(lookup) - 1)])
    for moved_mm in _MOVED_MM:
        steps = [np.eye(3)[axis] * way * moved_mm for axis, way in itertools.product(range(3), (-1, 1))]
        telling = [step for step in steps if _explained(exact, points + step, tissues) < _MOST_ALIKE]
        if telling:
            beside = max(_explained(mri, points + step, tissues) for step in telling)
            return _explained(mri, points, tissues) > _LEAST_GAIN * beside
    return False


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
