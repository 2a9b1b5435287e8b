"""Reference images for comparison with simulated ones: checked once, kept on the device."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.fitting.image_similarity import PatchComparison, Similarity, SimilaritySettings
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid


def target_comparisons(
    device: Device,
    probe: Probe,
    grid: ImageGrid,
    references: Sequence[np.ndarray],
    masks: Sequence[np.ndarray] | None,
    poses: int,
    settings: SimilaritySettings,
) -> list[PatchComparison]:
    """One comparison per reference, (rows, columns) uint8 on `grid`; only pixels inside both fields count.

    Raises SimulationError where shapes or counts differ, fields do not overlap, or a reference is black.
    """
    seen = grid.field(probe)
    require(len(references) > 0, "no reference image, expected at least one")
    require(
        len(references) == poses,
        f"{len(references)} reference images and {poses} poses, expected equal numbers",
    )
    require(
        masks is None or len(masks) == len(references),
        f"{len(masks or ())} masks and {len(references)} reference images, expected equal numbers",
    )
    comparisons = []
    for number, reference in enumerate(references):
        reference = np.asarray(reference)
        require(
            reference.shape == (grid.rows, grid.columns),
            f"reference image {number} has shape {reference.shape}, expected that of the simulated images, "
            f"{(grid.rows, grid.columns)}",
        )
        inside = seen if masks is None else seen & np.asarray(masks[number], bool)
        require(
            bool(inside.any()),
            f"reference image {number}: its field and the probe's do not overlap; check the geometry",
        )
        require(int(reference[inside].max()) > 0, f"reference image {number} is black inside the field")
        comparisons.append(PatchComparison(device, reference, inside, grid.pixel_spacing_mm, settings))
    return comparisons


def mean_cost(similarities: Iterable[Similarity]) -> float:
    """The mean cost of several images."""
    return float(np.mean([one.total for one in similarities]))
