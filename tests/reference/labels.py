"""Vectorised look-up of label map, acoustic groups and borders of a medium (kernels/borders.clh)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from tests.reference.elementary import (
    LOG2_E,
    dot,
    exp2,
    f32,
    length,
    ramp,
    sum8,
)
from tests.reference.flat_borders import MOST_TURNED, FlatBorders, borders_of_layers
from tests.reference.medium import HostMedium
from tests.reference.smoothed_borders import Borders, SmoothGrid, border_place

_CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)])  # (x, y, z) of the corners of a cell
_FINE_SIGMA = f32(1.5)
_FINE_REACH = f32(3.5)
_EIGHT = np.arange(8, dtype=np.float32)


class Labels:
    """A medium as flat arrays, for vectorised look-ups."""

    def __init__(self, medium: HostMedium) -> None:
        self.dims = medium.dims.astype(np.int64)
        self.steps = np.array([1, self.dims[0], self.dims[0] * self.dims[1]])
        self.corner_steps = _CORNERS @ self.steps
        self.label = medium.label.ravel()
        self.given = medium.label[1:-1, 1:-1, 1:-1]
        # Whether the eight voxels of the cell at (k, j, i) + {0, 1}^3 have one label
        lowest, highest = (f(medium.label, 2, origin=-1) for f in (ndimage.minimum_filter, ndimage.maximum_filter))
        self.one_label = (lowest == highest).ravel()
        # Rows of eight voxels are read at once, including the last one.
        self.groups = np.pad(medium.group.ravel(), (0, 8))
        self.smooth_groups = medium.smooth_groups
        # Smoothed indicators with the variance of the Gaussians that they resemble near their centre, in their voxels
        self.wide = SmoothGrid(medium.smooth, 8.91, 0.9, 1.0, 0.88)
        self.widest = SmoothGrid(medium.smoother, 18.29, 0.99, 0.5)
        self.flat = FlatBorders(self.widest, self.dims)
        self.distance = None if medium.distance is None else medium.distance.ravel()
        self.sheets = medium.sheets
        self.drawn = medium.drawn

    def cells(self, voxel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(index of the cell, fraction (..., 3) inside it) of (..., 3) voxel positions, clamped to the volume."""
        voxel = np.clip(voxel, f32(0), f32(self.dims) - f32(1.001))
        base = voxel.astype(np.int32)
        return base @ self.steps, voxel - base.astype(np.float32)

    def trilinear_weights(self, f: np.ndarray) -> np.ndarray:
        """(..., 8) weights of the corners at fraction f (..., 3)."""
        sides = np.stack([f32(1) - f, f], axis=-1)
        x, y, z = (sides[..., axis, _CORNERS[:, axis]] for axis in range(3))
        return x * y * z

    def at(self, voxel: np.ndarray) -> np.ndarray:
        """Labels at (..., 3) voxel positions: the group with the largest trilinear weight, in it the nearest corner."""
        here, f = self.cells(voxel)
        labels = self.label[here]
        several = ~self.one_label[here]
        if several.any():
            corners = here[several][:, None] + self.corner_steps
            weights, group = self.trilinear_weights(f[several]), self.groups[corners]
            votes = np.stack([sum8(np.where(group == g[:, None], weights, f32(0))) for g in group.T], axis=-1)
            best = np.take_along_axis(group, votes.argmax(axis=-1)[:, None], axis=-1)
            # The last one of equally near corners, and the first one where all are of one group
            nearest = 7 - np.where(group == best, weights, f32(-1))[:, ::-1].argmax(axis=-1)
            one_group = (group == best).all(axis=-1)
            nearest[one_group] = (f[several][one_group] > f32(0.5)) @ [1, 2, 4]
            chosen = np.take_along_axis(corners, nearest[:, None], axis=-1)[:, 0]
            labels[several] = self.label[chosen]
        return labels

    def borders(self, voxel, before, behind, soft) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(towards (n, 3), overshoot (n,), curvature (n,)) of the border between groups near (n, 3) voxel positions.

        `soft` (groups, groups) tells which groups have soft borders.
        """
        halved, numbers = f32(0.5) * voxel - f32(0.25), np.arange(len(soft))
        is_third = (numbers != before[:, None]) & (numbers != behind[:, None])
        alike = ~soft[before, behind][:, None] & (soft[before] ^ soft[behind]) & is_third
        found = self.widest.border(halved, before, behind, alike=alike)
        flat = found.confidence.copy()
        self.flat.beside_edges(halved, found, before, behind)
        edge = found.edge.copy()
        less = np.flatnonzero(found.confidence < 1)
        widest, places, sides = found.at(less), voxel[less], (before[less], behind[less])
        near = self.wide.border(places, *sides, alike=alike[less])
        some = np.flatnonzero(near.confidence < 1)
        fine = self._fine(places[some], before[less][some], behind[less][some], soft)
        wider = near.at(some)
        agrees = f32(1) - ramp(0.4, 0.55, np.abs(wider.overshoot - fine.overshoot))
        agrees *= ramp(0.9877, 0.9945, dot(wider.towards, fine.towards))
        wider.confidence = np.maximum(wider.confidence, wider.bent * agrees)
        fine.refine(wider)
        near.put(some, fine)
        towards = near.towards / np.maximum(length(near.towards), f32(1e-6))[:, None]
        layer = borders_of_layers(self.widest, halved[less], towards, widest, *sides)
        # In most folds the widest Gaussian sees another direction than the nearest voxels.
        is_fold = (widest.sigma * widest.steepness > f32(0.06)) & (dot(widest.towards, towards) < MOST_TURNED)
        layer.confidence[is_fold] = 0
        flat[less] = np.maximum(flat[less], layer.confidence)
        self.flat.beside_edges(halved[less], layer, *sides)
        edge[less] = np.maximum(edge[less], layer.edge)
        layer.doubled()
        # A layer among others, as in a fold, is not where the nearest voxels are. Those of a thin one know it less
        # well.
        off, turned = np.abs(layer.overshoot - near.overshoot), dot(layer.towards, towards)
        layer.confidence *= np.where(
            layer.is_thin,
            (f32(1) - ramp(0.7, 1.0, off)) * ramp(0.9, 0.94, turned),
            (f32(1) - ramp(0.4, 0.7, off)) * ramp(0.96, 0.98, turned),
        )
        widest.doubled()
        better = layer.confidence > widest.confidence
        widest.put(better, layer.at(better))
        near.refine(widest)
        near.confidence, near.beside = widest.confidence, widest.beside
        found.doubled().put(less, near)
        found.flat, found.edge = flat, edge
        self.flat.straighten(voxel, found, before, behind)
        return found.towards, found.overshoot, found.curvature

    def _fine(self, voxel, before, behind, soft) -> Borders:
        """From the labels within 3.5 voxels, smoothed here.

        At a strong border, groups that have a soft border with one of the two alone belong to its side.
        """
        rows, numbers = np.arange(len(voxel)), np.arange(len(soft))
        is_strong = ~soft[before, behind][:, None]
        first = (numbers == before[:, None]) | is_strong & soft[before] & ~soft[behind]
        side = f32(first) - f32((numbers == behind[:, None]) | is_strong & soft[behind] & ~soft[before])
        top = self.dims - 1
        inside = np.clip(voxel, f32(0), f32(top))
        low = np.maximum(np.ceil(inside - _FINE_REACH).astype(np.int64), 0)
        count = np.minimum(np.floor(inside + _FINE_REACH).astype(np.int64), top) - low + 1
        away = (low.astype(np.float32) - voxel)[..., None] + _EIGHT  # (n, 3, 8)
        narrow = f32(-0.5) * LOG2_E / (_FINE_SIGMA * _FINE_SIGMA)
        weight = np.maximum(exp2(np.maximum(narrow * away * away, f32(-100))) - f32(0.065730), f32(0))
        weight[count[..., None] <= _EIGHT] = 0
        wx, wy, wz = weight[:, 0], weight[:, 1], weight[:, 2]
        dx, dy, dz = away[:, 0], away[:, 1], away[:, 2]
        moments = np.zeros((5, len(voxel), 8), np.float32)  # of D over j and k: 1, y, z, y^2 + z^2; and of |D|
        for k in range(8):
            for j in range(8):
                yz, y, z = (wy[:, j] * wz[:, k])[:, None], dy[:, j : j + 1], dz[:, k : k + 1]
                # Outside the window the weight is 0.
                row = np.minimum((low + [0, j, k]) @ self.steps, len(self.groups) - 8)
                group = self.groups[row[:, None] + np.arange(8)]
                sign = side[rows[:, None], group]
                factors = (yz, yz * y, yz * z, yz * (y * y + z * z))
                for moment, factor in zip(moments, factors, strict=False):
                    moment += factor * sign
                moments[4] += yz * np.abs(sign)
        difference, by_y, by_z, by_square, either = moments
        total_d, square = sum8(wx * difference), sum8(wx * (dx * dx * difference + by_square))
        gradient = np.stack([sum8(wx * dx * difference), sum8(wx * by_y), sum8(wx * by_z)], axis=-1)
        sx, sy, sz = sum8(wx), sum8(wy), sum8(wz)
        total = sx * sy * sz + f32(1e-6)
        total_square = sum8(wx * dx * dx) * sy * sz + sx * sum8(wy * dy * dy) * sz + sx * sy * sum8(wz * dz * dz)
        steepness = np.maximum(length(gradient), f32(1e-9))
        towards = np.where((steepness < f32(1e-3) * total)[:, None], f32(0), gradient / steepness[:, None])
        share = f32(0.5) - f32(0.5) * total_d / (sum8(wx * either) + f32(1e-6))
        overshoot, curvature = border_place(_FINE_SIGMA, share, (square - total_square / total * total_d) / steepness)
        found = Borders.none(len(voxel))
        found.towards, found.overshoot, found.curvature = towards, overshoot, curvature
        found.confidence = f32(np.abs(overshoot) < 0.5)
        return found


def border_normals(ras_to_voxel: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """(n, 3) unit normals in RAS of directions in voxel indices; zero where there is none."""
    m = ras_to_voxel.reshape(3, 4)
    normal = np.stack([dot(m[:, axis], towards) for axis in range(3)], axis=-1)
    size = length(normal)
    return np.where((size < f32(1e-6))[:, None], f32(0), normal / np.maximum(size, f32(1e-30))[:, None])
