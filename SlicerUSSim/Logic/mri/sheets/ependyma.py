"""The walls of the ventricles: where the fluid in them ends, between voxels."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.mri.distances import distance_to
from SlicerUSSim.Logic.mri.refinement import closed
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.surfels import Surfels

_SIGMA_MM = 0.5
#: Gaps by which choroid plexus and septa part the fluid, closed before the fluid around is looked at, mm
_CLOSED_MM = 2.0
#: From the wall into the tissue and into the fluid, where both have to be met, mm
_OUTSIDE_MM, _INSIDE_MM = 1.5, 1.2
#: One layer of cells with the glia below
_THICKNESS_MM = 0.1


def ependyma(head: Head, ventricles: np.ndarray) -> Surfels:
    """Surfels where the intensity is midway between CSF and the tissue around the `ventricles` (k, j, i).

    Without those at foramina, where fluid goes on outside, and at the choroid plexus, which enhances.
    """
    from skimage.measure import marching_cubes

    if not ventricles.any():
        return Surfels.joined([])
    head, ventricles = head.around(ventricles, _CLOSED_MM + _OUTSIDE_MM + 3.0)
    tissue = 0.5 * (head.grey + head.white)
    fluid = np.clip((tissue - head.smoothed(_SIGMA_MM)) / (tissue - head.csf), 0.0, 1.0).astype(np.float32)
    inside = closed(ventricles, _CLOSED_MM / float(head.spacing.mean()))
    if head.is_enhanced:
        fluid[inside & (head.image.array > head.white + 2.0 * head.noise)] = 1.0
    field = np.where(distance_to(inside, head.image.spacing_mm) <= _OUTSIDE_MM, fluid, 0.0).astype(np.float32)
    corners, triangles, outwards, _ = marching_cubes(field, 0.5, spacing=(1.0, 1.0, 1.0), gradient_direction="descent")
    place = head.to_ras(corners)
    # Normals of marching cubes are gradients in voxels, which point from fluid into tissue.
    normal = outwards[:, ::-1] / head.image.spacing_mm
    normal = normal @ (head.image.ijk_to_ras[:3, :3] / head.image.spacing_mm).T
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    sides = place[triangles]
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1)
    areas = np.bincount(triangles.ravel(), np.repeat(area / 3.0, 3), len(place))
    within, beyond = head.at(place - _INSIDE_MM * normal, fluid), head.at(place + _OUTSIDE_MM * normal, fluid)
    confidence = np.clip(within - beyond, 0.0, 1.0)
    kept = (beyond < 0.5) & (confidence > 0.1)
    return Surfels.of("ependyma", place[kept], normal[kept], _THICKNESS_MM, confidence[kept], areas[kept])
