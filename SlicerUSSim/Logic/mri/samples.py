"""Sample MRIs: the MNI152 brain, and a synthetic head."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import mni152


def demo_mri() -> tuple[Volume, str]:
    """(MRI, source): the skull-stripped MNI152 T1 (see atlas.mni152)."""
    return mni152().t1, "MNI152 2009a T1"


def head_mri(spacing_mm: float = 1.0, seed: int = 0) -> Volume:
    """A skull-stripped T1-like brain: folded cortex with sulci, white matter, lateral and third ventricles, midline.

    (k, j, i) float32, air 0, with noise. It replaces a real MRI and is not anatomically accurate.
    """
    half = np.array([74.0, 88.0, 68.0])
    counts = (2 * (half + 6) / spacing_mm).astype(int)
    origin = -0.5 * (counts - 1) * spacing_mm
    axes = [(np.arange(n) * spacing_mm + start).astype(np.float32) for n, start in zip(counts, origin, strict=True)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    # Distance from the surface of an ellipsoid, in millimetres (positive inside), and angles around the centre.
    radius = np.sqrt((x / half[0]) ** 2 + (y / half[1]) ** 2 + (z / half[2]) ** 2) + 1e-6
    depth = (1.0 - radius) * 75.0
    azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))

    def folds(frequency: float, phase: float) -> np.ndarray:
        bend = 1.4 * np.sin(3.0 * elevation + 2.0 * azimuth + phase)
        return np.sin(frequency * azimuth * np.cos(elevation) + bend) * np.cos(frequency * elevation + bend)

    # Sulci are the zero lines of a smooth pattern, up to 16 mm deep and narrower with depth; the cortex follows them.
    pattern = np.abs(folds(9.0, 0.3))
    sulcus = (pattern < 0.07 - 0.003 * depth) & (depth < 16.0)
    cortex = (depth < 3.5) | ((pattern < 0.34 - 0.006 * depth) & (depth < 20.0))
    midline = (np.abs(x) < 0.8) & (z > 8.0) & (depth < 40.0)
    near_midline = (np.abs(x) < 4.0) & (z > 6.0) & (depth < 43.0)
    side = np.abs(x) - 11.0
    ventricles = (side / 6.0) ** 2 + ((y + 2.0) / 32.0) ** 2 + ((z - 4.0 + 0.25 * side) / 8.0) ** 2 < 1.0
    ventricles |= (np.abs(x) < 2.0) & (np.abs(y) < 14.0) & (z < 0.0) & (z > -18.0)
    nuclei = ((np.abs(x) - 17.0) / 10.0) ** 2 + (y / 20.0) ** 2 + ((z + 9.0) / 11.0) ** 2 < 1.0

    image = np.where(depth > 0, 110.0, 0.0)  # white matter
    image[(cortex | near_midline | nuclei) & (depth > 0)] = 85.0
    image[(sulcus | midline | ventricles) & (depth > 0)] = 40.0
    noise = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    image = np.where(depth > 0, image + noise, 0.0).astype(np.float32)
    matrix = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
    matrix[:3, 3] = origin
    return Volume(image, matrix)
