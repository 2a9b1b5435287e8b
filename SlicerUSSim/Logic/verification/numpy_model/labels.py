"""Vectorised look-up of label map, acoustic groups and borders of a medium (kernels/borders.clh)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.verification.numpy_model.elementary import (
    LOG2_E,
    dot,
    exp,
    exp2,
    f32,
    length,
    log,
    ramp,
    sum8,
    unit,
)
from SlicerUSSim.Logic.verification.numpy_model.medium import HostMedium

_CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)])  # (x, y, z) of the corners of a cell
_FINE_SIGMA = f32(1.5)
_FINE_REACH = f32(3.5)
_EIGHT = np.arange(8, dtype=np.float32)
# D = [before] - [behind], or where a third group lies behind one of them as a layer, the other one against all others:
# factors of both indicators, and what is added
_OF_BOTH, _OF_BEFORE, _OF_BEHIND = (1.0, 1.0, 0.0), (2.0, 0.0, -65535.0), (0.0, 2.0, 65535.0)
_TWO_GROUPS, _MOSTLY_TWO = 0.9999, 0.97  # sums of both indicators
_FARTHEST_DIFFERENCE = 0.75  # of D from 0
_DENSITY = f32(0.39894228)  # of the normal distribution at its centre
_TAIL = (1.330274429, -1.821255978, 1.781477937, -0.356563782, 0.31938153)  # Abramowitz and Stegun, 26.2.17


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
        self.wide = SmoothGrid(medium.smooth, 8.91, 0.955, 1.0)
        self.widest = SmoothGrid(medium.smoother, 18.29, 0.99, 0.5)
        self.distance = None if medium.distance is None else medium.distance.ravel()

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

    def borders(self, voxel, before, behind) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(towards (n, 3), overshoot (n,), curvature (n,)) of the border between groups near (n, 3) voxel positions."""
        halved = (voxel - f32(0.5)) / f32(2)
        towards, overshoot, curvature, confidence = self.widest.border(halved, before, behind)
        overshoot, curvature = f32(2) * overshoot, curvature / f32(2)
        less = np.flatnonzero(confidence < 1)
        voxel, before, behind = voxel[less], before[less], behind[less]
        layer = list(self.widest.layer(halved[less], before, behind))
        layer[1], layer[2] = f32(2) * layer[1], layer[2] / f32(2)
        wide = self.wide.border(voxel, before, behind)
        some = np.flatnonzero(wide[3] < 1)
        fine = self._fine(voxel[some], before[some], behind[some])
        for values, better in zip(wide[:3], _refined(fine, [values[some] for values in wide]), strict=True):
            values[some] = better
        wide[3][:] = 1
        # A layer among others, as in a fold, is not where the nearest voxels are.
        layer[3] = layer[3] * (f32(1) - ramp(0.4, 0.7, np.abs(layer[1] - wide[1])))
        layer[3] = layer[3] * ramp(0.96, 0.98, dot(layer[0], wide[0]) / np.maximum(length(wide[0]), f32(1e-6)))
        better = layer[3] > confidence[less]
        for result, values in zip((towards, overshoot, curvature, confidence), layer, strict=True):
            result[less[better]] = values[better]
        wider = [values[less] for values in (towards, overshoot, curvature, confidence)]
        for values, better in zip((towards, overshoot, curvature), _refined(wide, wider), strict=True):
            values[less] = better
        return towards, overshoot, curvature

    def _fine(self, voxel, before, behind):
        """From the labels within 3.5 voxels, smoothed here."""
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
                sign = f32(group == before[:, None]) - f32(group == behind[:, None])
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
        overshoot, curvature = _border_place(_FINE_SIGMA, share, (square - total_square / total * total_d) / steepness)
        return towards, overshoot, curvature, f32(np.abs(overshoot) < 0.5)


def _normal_distribution(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(cumulative, density) of the normal distribution."""
    density, t = _DENSITY * exp(f32(-0.5) * x * x), f32(1) / (f32(1) + f32(0.2316419) * np.abs(x))
    tail = f32(0)
    for factor in _TAIL:
        tail = t * (f32(factor) + tail)
    return np.where(x < 0, density * tail, f32(1) - density * tail), density


def _flat_layer(share, gradient, laplacian) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(depth, thickness, curvature) of a flat layer in sigmas, from its share of the Gaussian and its derivatives."""
    gradient = np.minimum(gradient, f32(0.3985))
    depth = np.zeros_like(share)
    thickness = np.sqrt(f32(-2) * log(np.clip(f32(1) - gradient / _DENSITY, f32(1e-4), f32(0.98))))
    (whole, near), (part, far) = _normal_distribution(depth), _normal_distribution(depth - thickness)
    for _ in range(4):
        off_share, off_gradient = whole - part - share, near - far - gradient
        a, b, c, d = near - far, far, (depth - thickness) * far - depth * near, (thickness - depth) * far
        determinant = a * d - b * c
        determinant = np.where(np.abs(determinant) < 1e-5, f32(1e-5), determinant)
        steps = (d * off_share - b * off_gradient) / determinant, (a * off_gradient - c * off_share) / determinant
        depth = depth - np.clip(steps[0], f32(-0.5), f32(0.5))
        thickness = np.maximum(thickness - np.clip(steps[1], f32(-0.7), f32(0.7)), f32(0.2))
        (whole, near), (part, far) = _normal_distribution(depth), _normal_distribution(depth - thickness)
    flat = (depth - thickness) * far - depth * near
    curvature = f32(0.5) * (laplacian - flat) / np.maximum(near - far, f32(1e-3))
    return depth - curvature, thickness, curvature


class SmoothGrid:
    """Indicators of acoustic groups, smoothed in advance: uint16 (groups, k, j, i), 65535 for 1.

    `variance` of the smoothing in squared voxels; `least` steepness, re that of a plane, that determines a border;
    `farthest` voxels at which it may be.
    """

    def __init__(self, smooth: np.ndarray, variance: float, least: float, farthest: float) -> None:
        self.groups, shape = smooth.shape[0], smooth.shape[1:]
        self.dims, self.variance, self.least = np.array(shape[::-1], np.int64), f32(variance), least
        self.farthest = f32(farthest)
        self.steps = np.array([1, self.dims[0], self.dims[0] * self.dims[1]])
        self.smooth = smooth.reshape(self.groups, -1)

    def border(self, voxel, before, behind) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(towards (n, 3), overshoot, curvature, confidence (n,)) in voxels; confidence 0: they do not determine it."""
        towards, overshoot, curvature, confidence = np.zeros_like(voxel), *np.zeros((3, len(voxel)), np.float32)
        if self.dims.min() < 4:
            return towards, overshoot, curvature, confidence
        known = np.flatnonzero((before < self.groups) & (behind < self.groups))
        both = self._both(voxel[known], before[known], behind[known])
        results = towards, overshoot, curvature, confidence
        *found, _ = self._border(voxel[known], before[known], behind[known], both, _OF_BOTH)
        found[3][both < f32(_MOSTLY_TWO)] = 0
        for result, values in zip(results, found, strict=True):
            result[known] = values
        near = both < f32(_TWO_GROUPS)
        known, both = known[near], both[near]
        *front, steep_front = self._border(voxel[known], before[known], behind[known], both, _OF_BEFORE)
        *back, steep_back = self._border(voxel[known], before[known], behind[known], both, _OF_BEHIND)
        of_before, of_behind = steep_front[:, None] * front[0], steep_back[:, None] * back[0]
        gradient, normal = f32(0.5) * (of_before - of_behind), of_before + of_behind
        along = dot(gradient, normal) / np.maximum(length(normal), f32(1e-9))
        steep = np.maximum(length(gradient), f32(1e-9))
        is_front = along > 0
        layer = [
            np.where(is_front[:, None] if a.ndim > 1 else is_front, a, b) for a, b in zip(front, back, strict=True)
        ]
        layer[3] = layer[3] * ramp(0.4, 0.8, np.sqrt(self.variance) * steep / (f32(1) - both))
        layer[3] = layer[3] * ramp(0.9, 0.97, np.abs(along) / steep)
        better = layer[3] >= confidence[known]
        for result, values in zip(results, layer, strict=True):
            result[known[better]] = values[better]
        return results

    def _border(self, voxel, before, behind, both, way):
        """The same and the steepness of D of one way: the factors of both indicators, and what is added."""
        towards = np.zeros_like(voxel)
        overshoot, curvature, confidence, steep = np.zeros((4, len(voxel)), np.float32)
        difference, up, down = self._stencil(voxel, before, behind, way)
        known = np.flatnonzero(np.abs(difference) <= f32(_FARTHEST_DIFFERENCE))
        difference, up, down = difference[known], up[known], down[known]
        slope, bends = f32(0.5) * (up - down), up + down - (f32(2) * difference)[:, None]
        steepness = np.maximum(length(slope), f32(1e-6))
        normal = slope / steepness[:, None]
        # Linear interpolation adds f (1 - f) to the variance along each axis; a central difference sees 1/3 more.
        squares, sigma = normal * normal, self._sigma(voxel[known], slope)
        variance = sigma * sigma
        share = f32(0.5) - f32(0.5) * difference / (both[known] if way == _OF_BOTH else f32(1))
        laplacian = bends[:, 0] + bends[:, 1] + bends[:, 2]
        distance, curvature[known] = _border_place(sigma, share, variance * laplacian / steepness)
        seen = f32(1) - dot(squares, squares) / (f32(6) * variance)
        of_plane = f32(0.79788456) / sigma * exp(f32(-0.5) * distance * distance / variance) * seen
        steep[known] = steepness / seen
        towards[known] = unit(normal * (f32(1) + squares / (f32(6) * variance[:, None])))
        overshoot[known] = distance
        with np.errstate(divide="ignore"):
            confidence[known] = ramp(self.least, 0.5 + 0.5 * self.least, steepness / of_plane)
        confidence[known] *= np.abs(distance) <= self.farthest
        return towards, overshoot, curvature, confidence, steep

    def layer(self, voxel, before, behind) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The same of a border in front of or behind a flat layer, where there is no third group."""
        towards, overshoot, curvature, confidence = np.zeros_like(voxel), *np.zeros((3, len(voxel)), np.float32)
        if self.dims.min() < 4:
            return towards, overshoot, curvature, confidence
        known = np.flatnonzero((before < self.groups) & (behind < self.groups))
        two = self._both(voxel[known], before[known], behind[known]) >= f32(_TWO_GROUPS)
        known = known[two]
        difference, up, down = self._stencil(voxel[known], before[known], behind[known], _OF_BOTH)
        inside = np.abs(difference) <= f32(_FARTHEST_DIFFERENCE)
        known, difference, up, down = known[inside], difference[inside], up[inside], down[inside]
        towards[known], _, _, _, steepness = (
            values
            for values in self._border(voxel[known], before[known], behind[known], f32(np.ones(len(known))), _OF_BOTH)
        )
        sigma = self._sigma(voxel[known], up - down)
        bends = (up + down - (f32(2) * difference)[:, None]).sum(axis=1, dtype=np.float32)
        seen = length(f32(0.5) * (up - down)) / steepness
        share, gradient = f32(0.5) - f32(0.5) * difference, f32(0.5) * sigma * steepness
        laplacian = f32(-0.5) * sigma * sigma * bends / seen
        layers = [
            _flat_layer(*values) for values in ((share, gradient, laplacian), (f32(1) - share, gradient, -laplacian))
        ]
        is_behind = np.abs(layers[0][2]) < np.abs(layers[1][2])
        depth, thickness, bend = (np.where(is_behind, a, b) for a, b in zip(*layers, strict=True))
        side = np.where(is_behind, f32(1), f32(-1))
        overshoot[known], curvature[known] = side * depth * sigma, -side * bend / sigma
        confidence[known] = ramp(0.35, 0.55, thickness) * (f32(1) - ramp(0.06, 0.12, np.abs(bend)))
        confidence[known] *= np.abs(overshoot[known]) <= self.farthest
        return towards, overshoot, curvature, confidence

    def _sigma(self, voxel, slope):
        """(n,) sigma of the Gaussian along the gradient, with what linear interpolation adds."""
        clipped = np.clip(voxel, f32(0), f32(self.dims) - f32(1.001))
        f = clipped - f32(np.clip(clipped.astype(np.int32), 1, self.dims - 3))
        normal = slope / np.maximum(length(slope), f32(1e-6))[:, None]
        return np.sqrt(self.variance + dot(normal * normal, f * (f32(1) - f)))

    def _place(self, voxel):
        """(index of the base voxel, fractions (x, y, z), 1 - fractions) of the stencil at (n, 3) voxel positions."""
        voxel = np.clip(voxel, f32(0), f32(self.dims) - f32(1.001))
        base = np.clip(voxel.astype(np.int32), 1, self.dims - 3)
        return base @ self.steps, (voxel - f32(base)).T, (f32(1) - (voxel - f32(base))).T

    def _both(self, voxel, before, behind):
        """(n,) sum of the two indicators; trilinear, the outermost cells are extrapolated from the next."""
        here, (fx, fy, fz), (gx, gy, gz) = self._place(voxel)
        both = f32(0)
        for k, wz in enumerate((gz, fz)):
            for j, wy in enumerate((gy, fy)):
                at = here + np.array([0, j, k]) @ self.steps
                near, far = (f32(self.smooth[before, n]) + f32(self.smooth[behind, n]) for n in (at, at + 1))
                both = both + wy * wz * (gx * near + fx * far)
        return both * f32(1.0 / 65535.0)

    def _stencil(self, voxel, before, behind, way):
        """D of the smoothed indicators at voxel positions, and D a voxel up and down each axis: (n,), (n, 3), (n, 3).

        Trilinear; the outermost cells are extrapolated from the next.
        """
        here, (fx, fy, fz), (gx, gy, gz) = self._place(voxel)
        of_before, of_behind, added = (f32(value) for value in way)

        def node(i, j, k):
            at = here + np.array([i, j, k]) @ self.steps
            return of_before * f32(self.smooth[before, at]) - of_behind * f32(self.smooth[behind, at]) + added

        def row(j, k, shift=0):
            """D at the position's i + shift on a row of the stencil."""
            return gx * node(shift, j, k) + fx * node(shift + 1, j, k)

        rows = {(j, k): row(j, k) for k in (0, 1) for j in (0, 1)}
        wy, wz = (gy, fy), (gz, fz)
        difference = right = left = f32(0)
        for k in (0, 1):
            for j in (0, 1):
                weight = wy[j] * wz[k]
                difference = difference + weight * rows[j, k]
                right, left = right + weight * row(j, k, 1), left + weight * row(j, k, -1)
        ahead = behind_ = above = below = f32(0)
        for n in (0, 1):
            ahead = ahead + wz[n] * (gy * rows[1, n] + fy * row(2, n))
            behind_ = behind_ + wz[n] * (gy * row(-1, n) + fy * rows[0, n])
            above = above + wy[n] * (gz * rows[n, 1] + fz * row(n, 2))
            below = below + wy[n] * (gz * row(n, -1) + fz * rows[n, 0])
        unit = f32(1.0 / 65535.0)
        up, down = np.stack([right, ahead, above], -1) * unit, np.stack([left, behind_, below], -1) * unit
        return difference * unit, up, down


def _refined(narrow, wider) -> list[np.ndarray]:
    """(towards, overshoot, curvature) from two scales, each with its confidence at the end."""
    towards, overshoot, curvature, sure = narrow
    return [
        start + wider[3].reshape((-1,) + (1,) * (start.ndim - 1)) * (end - start)
        for start, end in zip((towards, sure * overshoot, curvature), wider[:3], strict=True)
    ]


def _border_place(sigma, share, bend):
    """(distance, mean curvature): the mean of the two estimates and their difference."""
    share = np.clip(share, f32(0.01), f32(0.99))
    by_share = sigma / f32(1.5957691) * log(share / (f32(1) - share))
    return f32(0.5) * (by_share + bend), f32(0.5) * (bend - by_share) / (sigma * sigma)


def border_normals(ras_to_voxel: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """(n, 3) unit normals in RAS of directions in voxel indices; zero where there is none."""
    m = ras_to_voxel.reshape(3, 4)
    normal = np.stack([dot(m[:, axis], towards) for axis in range(3)], axis=-1)
    size = length(normal)
    return np.where((size < f32(1e-6))[:, None], f32(0), normal / np.maximum(size, f32(1e-30))[:, None])
