"""What is reflected back to the probe's face, and by it once more (kernels/face_hits.cl)."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.opencl.layout import HIT
from tests.reference.beam import Beam
from tests.reference.drawn import segment_hit


def face_hits(
    acquisition: np.ndarray, quantiles: np.ndarray, segments: np.ndarray, lines: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(layout.HIT, traced lines) where reflected rays meet the face; quantiles as for drawn.sheet_hits."""
    matrix = acquisition["probe_to_ras"].reshape(3, 4).astype(float)
    turn, origin = matrix[:, :3], matrix[:, 3]
    radius = 0.0 if acquisition["flat_face"] else float(acquisition["apex_radius_mm"])
    centre, beam = np.array([0.0, -radius, 0.0]), Beam(acquisition)
    half = np.array([acquisition["face_half_mm"], np.inf, acquisition["face_half_height_mm"]])
    hits, hit_lines = [], []
    for segment, line in zip(segments, lines, strict=True):
        if segment["reflections"] == 0 or not acquisition["face_reflection"]:
            continue
        start, direction = (segment["start"] - origin) @ turn, segment["direction"] @ turn
        for quantile in quantiles[line]:
            aside, along = np.zeros(3), _length_to_face(start, direction, radius)
            for _ in range(2):
                if along >= 0.0:
                    sigma = beam.elevation_sigma(np.asarray(segment["path_mm"] + along, np.float32))
                    aside = quantile * float(sigma) * (segment["elevational"] @ turn)
                    along = _length_to_face(start + aside, direction, radius)
            at = start + aside + along * direction
            if not 0.0 <= along <= segment["length_mm"] or (np.abs(at) > half).any():
                continue
            normal = np.array([0.0, 1.0, 0.0]) if radius == 0.0 else (at - centre) * [1, 1, 0] / radius
            hits.append(
                segment_hit(
                    acquisition, beam, segment, quantile, np.float32(along), turn @ normal,
                    acquisition["face_reflection"],
                )
            )  # fmt: skip
            hit_lines.append(line)
    return np.array(hits, HIT), np.array(hit_lines, int)


def _length_to_face(start: np.ndarray, direction: np.ndarray, radius: float) -> float:
    """Length at which a ray in the probe frame meets a plane or a cylinder through the origin from in front, or -1."""
    if radius == 0.0:
        return -start[1] / direction[1] if direction[1] < -1e-4 else -1.0
    x, y = start[0], start[1] + radius
    roots = np.roots([
        direction[0] ** 2 + direction[1] ** 2, 2.0 * (x * direction[0] + y * direction[1]), x * x + y * y - radius**2
    ])  # fmt: skip
    if len(roots) < 2 or np.iscomplex(roots).any() or x * direction[0] + y * direction[1] >= 0.0:
        return -1.0
    return float(roots.real.min())
