"""Vectorised look-up of borders in smoothed indicators of one scale (kernels/smoothed_borders.clh)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from tests.reference.elementary import dot, exp, f32, length, log, ramp, unit

# D = [before] - [behind], or where a third group lies behind one of them as a layer, the other one against all others:
# factors of both indicators, and what is added
OF_BOTH, _OF_BEFORE, _OF_BEHIND = (1.0, 1.0, 0.0), (2.0, 0.0, -65535.0), (0.0, 2.0, 65535.0)
TWO_GROUPS, _MOSTLY_TWO = 0.9999, 0.97  # sums of both indicators
_FARTHEST_DIFFERENCE = 0.75  # of D from 0
_FEW_ALIKE = 0.01  # share of others on the same side that bends no normals
# Nodes (i, j, k) of the stencil of D: a cell, and those beside it along each axis
_NODES = np.array(
    [
        (i, j, k)
        for i in (-1, 0, 1, 2)
        for j in (-1, 0, 1, 2)
        for k in (-1, 0, 1, 2)
        if sum(n in (-1, 2) for n in (i, j, k)) < 2
    ]
)
_NODE_AT = {(int(i), int(j), int(k)): n for n, (i, j, k) in enumerate(_NODES)}


@dataclass
class Borders:
    """Borders near n positions, in voxels of a grid: arrays of n values."""

    #: (n, 3) unit vectors to the side of `before`; zero if there is none
    towards: np.ndarray
    #: By which the position lies beyond the border
    overshoot: np.ndarray
    #: Mean curvature, positive where convex towards `before`
    curvature: np.ndarray
    #: 0..1
    confidence: np.ndarray
    #: Fraction of the Gaussian behind the position; NaN where there is a third group
    share: np.ndarray
    #: Of the Gaussian; 0 where there is a third group, or the border is too far for the rest
    sigma: np.ndarray
    #: |grad D| as that of a plane
    steepness: np.ndarray
    #: sigma^2 laplacian(D) / |grad D|
    bend: np.ndarray
    #: Voxels along the normal, to either side, in which the border of a layer was looked for
    beside: np.ndarray
    #: Whether it is that of a thin layer
    is_thin: np.ndarray
    #: Confidence as a bent border, if the nearest voxels agree on its place
    bent: np.ndarray
    #: Confidence of being as flat as the widest Gaussian, also where it is near an edge
    flat: np.ndarray
    #: How certain it is that it is near one
    edge: np.ndarray

    @classmethod
    def none(cls, count: int) -> Borders:
        """Without any border."""
        zero, share = np.zeros((10, count), np.float32), np.full(count, np.nan, np.float32)
        return cls(
            np.zeros((count, 3), np.float32), zero[0], zero[1], zero[2], share, zero[3], zero[4], zero[5], zero[6],
            np.zeros(count, bool), zero[7], zero[8], zero[9],
        )  # fmt: skip

    def at(self, index) -> Borders:
        """Those of some positions, copied."""
        return Borders(*(getattr(self, field.name)[index].copy() for field in fields(self)))

    def put(self, index, others: Borders) -> None:
        """Replace those of some positions."""
        for field in fields(self):
            getattr(self, field.name)[index] = getattr(others, field.name)

    def doubled(self) -> Borders:
        """The same, found at half the resolution, in voxels of the volume."""
        self.overshoot, self.curvature = f32(2) * self.overshoot, f32(0.5) * self.curvature
        self.beside = f32(2) * self.beside
        return self

    def refine(self, wider: Borders) -> None:
        """By a wider estimate where that is certain."""
        sure = wider.confidence
        self.overshoot = self.confidence * self.overshoot
        self.overshoot += sure * (wider.overshoot - self.overshoot)
        self.curvature = self.curvature + sure * (wider.curvature - self.curvature)
        self.towards = self.towards + sure[:, None] * (wider.towards - self.towards)
        self.confidence = np.ones_like(sure)


@dataclass
class Differences:
    """D at n positions and its derivatives, as in the kernel."""

    difference: np.ndarray
    both: np.ndarray
    towards: np.ndarray
    steepness: np.ndarray
    seen: np.ndarray
    bends: np.ndarray
    variance: np.ndarray


class SmoothGrid:
    """Indicators of acoustic groups, smoothed in advance: uint16 (groups, k, j, i), 65535 for 1.

    `variance` of the smoothing in squared voxels; `least` steepness, re that of a plane, that determines a border;
    `farthest` voxels at which it may be; `most_bent` mean curvature per sigma up to which bent borders count.
    """

    def __init__(
        self, smooth: np.ndarray, variance: float, least: float, farthest: float, most_bent: float = 0.0
    ) -> None:
        self.groups, shape = smooth.shape[0], smooth.shape[1:]
        self.dims, self.variance, self.least = np.array(shape[::-1], np.int64), f32(variance), least
        self.farthest, self.most_bent = f32(farthest), most_bent
        self.steps = np.array([1, self.dims[0], self.dims[0] * self.dims[1]])
        self.smooth = smooth.reshape(self.groups, -1)

    def border(self, voxel, before, behind, farthest: float | None = None, alike: np.ndarray | None = None) -> Borders:
        """Borders near (n, 3) positions; confidence 0: they do not determine it.

        `alike` (n, groups) are third groups that may be on the same side of a strong border as one of the two.
        """
        found = Borders.none(len(voxel))
        if self.dims.min() < 4:
            return found
        limit = self.farthest if farthest is None else f32(farthest)
        known = np.flatnonzero((before < self.groups) & (behind < self.groups))
        of_both, both = self._border(voxel[known], before[known], behind[known], OF_BOTH, limit)
        of_both.confidence[both < f32(_MOSTLY_TWO)] = 0
        found.put(known, of_both)
        third = both < f32(TWO_GROUPS)
        known, both = known[third], both[third]
        front, _ = self._border(voxel[known], before[known], behind[known], _OF_BEFORE, limit)
        back, _ = self._border(voxel[known], before[known], behind[known], _OF_BEHIND, limit)
        of_before, of_behind = front.steepness[:, None] * front.towards, back.steepness[:, None] * back.towards
        gradient, normal = f32(0.5) * (of_before - of_behind), of_before + of_behind
        along = dot(gradient, normal) / np.maximum(length(normal), f32(1e-9))
        steep = np.maximum(length(gradient), f32(1e-9))
        agree = dot(front.towards, back.towards)
        layer = back
        is_front = np.flatnonzero(along > 0)
        layer.put(is_front, front.at(is_front))
        layer.confidence *= ramp(0.4, 0.8, np.sqrt(self.variance) * steep / (f32(1) - both))
        layer.confidence *= ramp(0.9, 0.97, np.abs(along) / steep)
        if alike is not None:
            beside = self._share(voxel[known], alike[known]) > f32(_FEW_ALIKE)
            layer.confidence *= np.where(beside, ramp(0.98, 0.998, agree), f32(1))
        better = layer.confidence >= found.confidence[known]
        found.put(known[better], layer.at(better))
        found.sigma[known], found.share[known], found.bent[known] = 0, np.nan, 0
        return found

    def _share(self, voxel, groups: np.ndarray) -> np.ndarray:
        """(n,) share of some groups (n, groups) at the voxels nearest to positions."""
        at = np.clip((voxel + f32(0.5)).astype(np.int64), 0, self.dims - 1) @ self.steps
        shares = [np.where(groups[:, n], self.smooth[n, at].astype(np.float32), f32(0)) for n in range(self.groups)]
        return np.sum(shares, axis=0, dtype=np.float32) / f32(65535)

    def border_of(self, voxel, group) -> Borders:
        """Borders of one group, for each of (n, 3) positions, against all others."""
        if self.dims.min() < 4:
            return Borders.none(len(voxel))
        return self._border(voxel, group, group, _OF_BEFORE, self.farthest)[0]

    def _border(self, voxel, before, behind, way, farthest) -> tuple[Borders, np.ndarray]:
        """From D of one way, with the sum of both indicators."""
        found, seen = Borders.none(len(voxel)), self.differences(voxel, before, behind, way)
        found.share = f32(0.5) - f32(0.5) * seen.difference / (seen.both if way == OF_BOTH else f32(1))
        known = np.abs(seen.difference) <= f32(_FARTHEST_DIFFERENCE)
        sigma, bend = np.sqrt(seen.variance), seen.variance * seen.bends / seen.steepness
        place, curvature = border_place(sigma, found.share, bend)
        of_plane = f32(0.79788456) / sigma * exp(f32(-0.5) * place * place / seen.variance) * seen.seen
        near = np.abs(place) <= farthest
        with np.errstate(divide="ignore"):
            steep = seen.steepness / of_plane
        sure = ramp(self.least, 0.5 + 0.5 * self.least, steep) * near
        bent, place, curvature = self._bent(steep, place, curvature, sigma)
        for name, values in (
            ("towards", seen.towards), ("overshoot", place), ("curvature", curvature), ("confidence", sure),
            ("sigma", sigma), ("steepness", seen.steepness / seen.seen), ("bend", bend), ("bent", bent * near),
        ):  # fmt: skip
            getattr(found, name)[known] = values[known]
        return found, seen.both

    def _bent(self, steep, place, curvature, sigma):
        """(confidence, place, curvature) of a bent border, as between spheres and cylinders."""
        if self.most_bent == 0:
            return np.zeros_like(place), place, curvature
        bent = curvature * sigma
        square, known = bent * bent, np.abs(bent) < f32(self.most_bent)
        sure = ramp(self.least, 0.5 + 0.5 * self.least, steep * (f32(1) + f32(1.1) * square))
        sure *= f32(1) - ramp(0.9, 1.0, np.abs(bent) / f32(self.most_bent))
        nearer = f32(0.5) * square * bent * sigma / (f32(1) + f32(0.5) * square)
        return (
            np.where(known, sure, f32(0)),
            np.where(known, place - nearer, place),
            np.where(known, curvature / (f32(1) + square), curvature),
        )

    def differences(self, voxel, before, behind, way) -> Differences:
        """D at voxel positions, trilinear, and its differences; the outermost cells are extrapolated from the next."""
        voxel = np.clip(voxel, f32(0), f32(self.dims) - f32(1.001))
        base = np.clip(voxel.astype(np.int32), 1, self.dims - 3)
        here, f = base @ self.steps, voxel - f32(base)
        (fx, fy, fz), (gx, gy, gz) = f.T, (f32(1) - f).T
        of_before, of_behind, added = (f32(value) for value in way)

        # All nodes of the stencil at once: (nodes, n)
        at = here + (_NODES @ self.steps)[:, None]
        first, second = (self.smooth[group, at].astype(np.float32) for group in (before, behind))
        nodes = of_before * first - of_behind * second + added

        def row(j, k, shift=0):
            """D at the position's i + shift on a row of the stencil."""
            return gx * nodes[_NODE_AT[shift, j, k]] + fx * nodes[_NODE_AT[shift + 1, j, k]]

        rows = {(j, k): row(j, k) for k in (0, 1) for j in (0, 1)}
        wy, wz = (gy, fy), (gz, fz)
        difference = right = left = both = f32(0)
        for k in (0, 1):
            for j in (0, 1):
                weight = wy[j] * wz[k]
                difference = difference + weight * rows[j, k]
                right, left = right + weight * row(j, k, 1), left + weight * row(j, k, -1)
                near, far = (first[n] + second[n] for n in (_NODE_AT[0, j, k], _NODE_AT[1, j, k]))
                both = both + weight * (gx * near + fx * far)
        ahead = behind_ = above = below = f32(0)
        for n in (0, 1):
            ahead = ahead + wz[n] * (gy * rows[1, n] + fy * row(2, n))
            behind_ = behind_ + wz[n] * (gy * row(-1, n) + fy * rows[0, n])
            above = above + wy[n] * (gz * rows[n, 1] + fz * row(n, 2))
            below = below + wy[n] * (gz * row(n, -1) + fz * rows[n, 0])
        scale = f32(1.0 / 65535.0)
        up, down = np.stack([right, ahead, above], -1) * scale, np.stack([left, behind_, below], -1) * scale
        difference = difference * scale
        slope, bends = f32(0.5) * (up - down), up + down - (f32(2) * difference)[:, None]
        steepness = np.maximum(length(slope), f32(1e-6))
        normal = slope / steepness[:, None]
        # Linear interpolation adds f (1 - f) to the variance along each axis; a central difference sees 1/3 more.
        squares = normal * normal
        variance = self.variance + dot(squares, f * (f32(1) - f))
        with np.errstate(invalid="ignore"):  # no direction where D does not change
            towards = unit(normal * (f32(1) + squares / (f32(6) * variance[:, None])))
        seen = f32(1) - dot(squares, squares) / (f32(6) * variance)
        return Differences(
            difference, both * scale, towards, steepness, seen, bends[:, 0] + bends[:, 1] + bends[:, 2], variance
        )


def border_place(sigma, share, bend):
    """(distance, mean curvature): the mean of the two estimates and their difference."""
    share = np.clip(share, f32(0.01), f32(0.99))
    by_share = sigma / f32(1.5957691) * log(share / (f32(1) - share))
    return f32(0.5) * (by_share + bend), f32(0.5) * (bend - by_share) / (sigma * sigma)
