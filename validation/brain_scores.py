"""Scores of a segmentation against a phantom or scan whose tissues are known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from validation.brain_phantoms import TISSUES, BrainPhantom

#: What other names of a segmentation's tissues are in the truth
_SAME = {"leptomeninges": "csf", "tumour": "enhancing", "vessel": "enhancing", "blood vessel": "enhancing"}


def dice(found: np.ndarray, truth: np.ndarray) -> float:
    """Overlap 2 |A and B| / (|A| + |B|) of two masks; 1 if both are empty."""
    total = int(found.sum()) + int(truth.sum())
    return 2.0 * int((found & truth).sum()) / total if total else 1.0


def scores(labels: np.ndarray, names: Mapping[int, str], case: BrainPhantom) -> dict[str, float]:
    """Dice of every tissue that the truth contains and the names of labels can express, and "grey and white".

    Voxels of necrosis and oedema count for none of the others, since no intensity class is wrong there by name.
    """
    truth = case.truth.array
    judged = (truth > 0) & (truth <= 4)
    tissue_of = {label: _SAME.get(name, name) for label, name in names.items()}
    result = {}
    for number, tissue in enumerate(TISSUES[:4], start=1):
        mine = [label for label, name in tissue_of.items() if name == tissue]
        if (truth == number).any():
            result[tissue] = dice(np.isin(labels, mine) & judged, truth == number)
    result["grey and white"] = 0.5 * (result["grey matter"] + result["white matter"])
    return result


def calibration(
    posteriors: np.ndarray, names: Mapping[int, str], case: BrainPhantom, bins: int = 10
) -> Iterator[tuple[float, float, int]]:
    """(stated, right, voxels) for intervals of the largest posterior: its mean, and the share of voxels in which it is
    the truth. Equal for calibrated posteriors.

    posteriors : (classes, k, j, i), class n belongs to label n + 1.
    """
    truth = case.truth.array
    judged = (truth > 0) & (truth <= 4)
    number = {tissue: index for index, tissue in enumerate(TISSUES, start=1)}
    of_class = np.array([number.get(_SAME.get(names[n + 1], names[n + 1]), 0) for n in range(len(posteriors))])
    inside = posteriors[:, judged]
    stated, right = inside.max(axis=0), of_class[inside.argmax(axis=0)] == truth[judged]
    interval = np.clip((stated * bins).astype(int), 0, bins - 1)
    for index in range(bins):
        here = interval == index
        if here.any():
            yield float(stated[here].mean()), float(right[here].mean()), int(here.sum())
