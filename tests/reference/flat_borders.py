"""Vectorised look-up of flat borders: layers, and planes near ends and along voxels (kernels/flat_borders.clh)."""

from __future__ import annotations

import numpy as np

from tests.reference.elementary import dot, exp, f32, length, log, ramp, unit
from tests.reference.smoothed_borders import OF_BOTH, TWO_GROUPS, Borders, SmoothGrid

_DENSITY = f32(0.39894228)  # of the normal distribution at its centre
_TAIL = (1.330274429, -1.821255978, 1.781477937, -0.356563782, 0.31938153)  # Abramowitz and Stegun, 26.2.17
_VIEW, _THIN_SHARE = f32(3.5), 0.35  # voxels from a thin layer to where it is looked at; its share at its walls
MOST_TURNED = f32(0.85)  # cosine of the angle between estimates of a layer's normal
_END_REACH = f32(28)  # voxels to the ends of the volume, along a plane
_SAMPLES_APART = f32(20)  # voxels
_END_SAMPLE = f32(5)  # voxels from the ends of the volume and its margin
# Normals of layers of voxels, by the size of their components, whose steps are suppressed
_LAYERS = ((0, 0, 1), (0, 1, 1), (1, 1, 1), (0, 1, 2), (1, 1, 2), (1, 2, 2))
_SAMPLES = 5  # along each of two axes
_FALLS = (0.0, 0.3, 0.65)  # of the weights of samples, by steps from their middle
_LEAST_SAMPLES = 0.2  # the part of them, by weight, from which they tell a plane


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


def layer_borders(isolated: Borders, farthest: float) -> Borders:
    """Borders in front of or behind a flat layer, from those found as if there was none."""
    found = isolated.at(slice(None))
    found.confidence[:] = 0
    some = np.flatnonzero(isolated.sigma > 0)
    of = isolated.at(some)
    gradient = f32(0.5) * of.sigma * of.steepness
    laplacian = -of.bend * gradient / of.sigma
    layers = [
        _flat_layer(*values) for values in ((of.share, gradient, laplacian), (f32(1) - of.share, gradient, -laplacian))
    ]
    is_behind = np.abs(layers[0][2]) < np.abs(layers[1][2])
    depth, thickness, bend = (np.where(is_behind, a, b) for a, b in zip(*layers, strict=True))
    side = np.where(is_behind, f32(1), f32(-1))
    of.overshoot, of.curvature = side * depth * of.sigma, -side * bend / of.sigma
    of.beside = thickness * of.sigma
    of.confidence = ramp(0.35, 0.55, thickness) * (f32(1) - ramp(0.06, 0.12, np.abs(bend)))
    of.confidence *= np.abs(of.overshoot) <= f32(farthest)
    found.put(some, of)
    return found


def _layer_ahead(share, gradient) -> tuple[np.ndarray, np.ndarray]:
    """(its middle ahead, thickness) in sigmas of a flat layer, from its share of the Gaussian and its gradient."""
    from_middle = -gradient / share
    thickness = np.maximum(share / _normal_distribution(from_middle)[1], f32(0.05))
    for _ in range(3):
        near, far = from_middle + f32(0.5) * thickness, from_middle - f32(0.5) * thickness
        (whole, p), (part, q) = _normal_distribution(near), _normal_distribution(far)
        off_share, off_gradient = whole - part - share, p - q - gradient
        a, b, c, d = p - q, f32(0.5) * (p + q), far * q - near * p, f32(-0.5) * (near * p + far * q)
        determinant = a * d - b * c
        determinant = np.where(np.abs(determinant) < 1e-6, f32(1e-6), determinant)
        steps = (d * off_share - b * off_gradient) / determinant, (a * off_gradient - c * off_share) / determinant
        from_middle = from_middle - np.clip(steps[0], f32(-0.4), f32(0.4))
        thickness = np.maximum(thickness - np.clip(steps[1], f32(-0.4), f32(0.4)), f32(0.02))
    return -from_middle, thickness


def _view(grid: SmoothGrid, voxel, before, behind, side, expected):
    """What is seen of a layer: (whether anything, direction ahead, voxels to its middle, thickness, curvature)."""
    found = grid.differences(voxel, before, behind, OF_BOTH)
    seen = ((voxel >= 0) & (voxel <= f32(grid.dims - 1))).all(axis=-1)
    seen &= (np.abs(found.difference) <= f32(0.99)) & (found.both >= f32(TWO_GROUPS))
    sigma, share = np.sqrt(found.variance), f32(0.5) - f32(0.5) * side * found.difference
    share = np.maximum(share, f32(0.004))
    gradient = f32(0.5) * sigma * found.steepness / found.seen
    laplacian = f32(-0.5) * side * found.variance * found.bends
    middle, thickness = _layer_ahead(share, gradient)
    near, far = f32(0.5) * thickness - middle, f32(-0.5) * thickness - middle
    flat = far * _normal_distribution(far)[1] - near * _normal_distribution(near)[1]
    curvature = f32(0.5) * (laplacian - flat) / np.maximum(gradient, f32(1e-3))
    ahead = -side[:, None] * found.towards
    seen &= dot(ahead, expected) >= MOST_TURNED
    return seen, ahead, (middle + curvature) * sigma, thickness * sigma, curvature / sigma


def _thin_layer_borders(grid: SmoothGrid, voxel, towards, isolated: Borders, before, behind, farthest) -> Borders:
    """Borders of thin layers, seen from before and from behind."""
    found = Borders.none(len(voxel))
    share = isolated.share
    turned = np.abs(dot(isolated.towards, towards)) < MOST_TURNED
    turned &= isolated.sigma * isolated.steepness > f32(0.06)
    some = np.flatnonzero((np.abs(share - f32(0.5)) >= f32(0.5 - _THIN_SHARE)) & ~turned)
    voxel, towards, share, before, behind = (part[some] for part in (voxel, towards, share, before, behind))
    side = np.where(share < 0.5, f32(1), f32(-1))
    sigma, ahead = float(np.sqrt(grid.variance)), -side[:, None] * towards
    seen, front, middle, thickness, curvature = _view(grid, voxel - _VIEW * ahead, before, behind, side, ahead)
    beyond = thickness + _VIEW
    sees, back, other_middle, other_thickness, other_curvature = _view(
        grid, voxel + np.minimum(beyond, f32(100))[:, None] * ahead, before, behind, side, -ahead
    )
    agreement = -dot(front, back)
    seen &= sees & (thickness <= 1.2 * sigma) & (agreement >= f32(0.98))
    from_front = (middle - f32(0.5) * thickness)[:, None] * front - _VIEW * ahead
    from_back = (other_middle + f32(0.5) * other_thickness)[:, None] * back + beyond[:, None] * ahead
    into = unit(front - back)
    depth, other_depth = -dot(from_front, into), -dot(from_back, into)
    overshoot = f32(0.5) * side * (depth + other_depth)
    bent = f32(sigma) * np.maximum(np.abs(curvature), np.abs(other_curvature))
    sure = (f32(1) - ramp(0.12, 0.25, np.abs(depth - other_depth))) * ramp(0.98, 0.99, agreement)
    sure *= f32(1) - ramp(0.08, 0.15, np.abs(thickness - other_thickness))
    sure *= (f32(1) - ramp(0.12, 0.2, bent)) * ramp(0.12 * sigma, 0.17 * sigma, thickness)
    sure *= (f32(1) - ramp(sigma, 1.2 * sigma, thickness)) * (np.abs(overshoot) <= f32(farthest))
    to = some[seen]
    found.towards[to], found.overshoot[to] = (-side[:, None] * into)[seen], overshoot[seen]
    found.curvature[to] = (f32(0.5) * side * (other_curvature - curvature))[seen]
    found.confidence[to], found.beside[to], found.is_thin[to] = sure[seen], beyond[seen], True
    return found


def borders_of_layers(grid: SmoothGrid, voxel, towards, isolated: Borders, before, behind, farthest=0.5) -> Borders:
    """Borders of layers, from those found as if there was none; `towards` is about normal to them."""
    found = Borders.none(len(voxel))
    some = np.flatnonzero(~np.isnan(isolated.share))
    with np.errstate(all="ignore"):  # a flat field has no layer
        best = _thin_layer_borders(
            grid, voxel[some], towards[some], isolated.at(some), before[some], behind[some], farthest
        )
        layer = layer_borders(isolated.at(some), farthest)
    better = (best.confidence < 1) & (layer.confidence > best.confidence)
    best.put(better, layer.at(better))
    found.put(some, best)
    return found


def _away_from_ends(dims, voxel, planes: Borders) -> tuple[np.ndarray, np.ndarray]:
    """(displacement (n, 3) along planes to where the ends do not bend them, distance (n,) to those then) in voxels."""
    normal, first, last, at = planes.towards, f32(0.5), f32(dims) - f32(1.5), voxel.copy()
    sine = np.sqrt(np.maximum(f32(1) - normal * normal, f32(1e-6)))
    margin = _END_REACH * sine + np.minimum(planes.beside[:, None] * np.abs(normal), f32(24) * sine)
    for _ in range(2):
        for axis in range(3):
            middle = f32(0.5) * (first + last[axis])
            low = np.minimum(first + margin[:, axis], middle)
            high = np.maximum(last[axis] - margin[:, axis], middle)
            along = (np.clip(at[:, axis], low, high) - at[:, axis]) / (sine[:, axis] * sine[:, axis])
            at = at - (along * normal[:, axis])[:, None] * normal
            at[:, axis] += along
    nearer = np.minimum(at - first, last - at)
    room = np.minimum(_END_REACH, (_END_REACH + (nearer - margin) / sine).min(axis=-1))
    return at - voxel, room


def _beyond_plane(voxel, on, towards) -> np.ndarray:
    return dot(on - voxel, towards)


def _along_layers(normal) -> np.ndarray:
    """How far planes of (n, 3) unit normals lie along layers of voxels: at right angles to an axis or a diagonal."""
    size = np.sort(np.abs(normal), axis=-1)
    found = np.zeros(len(normal), np.float32)
    for across in _LAYERS:
        apart = 1.0 / np.linalg.norm(across)
        first, last = (np.cos(np.radians(angle * apart)) for angle in (5.0, 4.0))
        found = np.maximum(found, ramp(first, last, size @ f32(np.multiply(across, apart))))
    return found


def _goes_on(grid: SmoothGrid, voxel, towards, before, behind) -> np.ndarray:
    """How certain it is that borders go on to all sides as at (n, 3) positions: beside them it is as steep."""

    def steepness(at: np.ndarray) -> np.ndarray:
        found = grid.differences(at, before, behind, OF_BOTH)
        return found.steepness / found.seen * np.sqrt(found.variance)

    sigma = f32(np.sqrt(grid.variance))
    axes = np.eye(3, dtype=np.float32)[np.abs(towards).argmin(axis=-1)]
    along = unit(np.cross(towards, axes).astype(np.float32))
    across = np.cross(towards, along).astype(np.float32)
    beside = [steepness(voxel + sign * sigma * way) for way in (along, across) for sign in (f32(-1), f32(1))]
    least = np.minimum(np.min(beside, axis=0) / steepness(voxel), f32(1))
    return ramp(0.96, 0.98, least)


class FlatBorders:
    """What the indicators at half the resolution know of a volume of `dims` voxels."""

    def __init__(self, halved: SmoothGrid, dims: np.ndarray) -> None:
        self.halved, self.dims = halved, dims

    def widest(self, voxel, towards, before, behind, farthest: float) -> Borders:
        """Isolated borders, or those of layers, in voxels of the volume."""
        at, limit = f32(0.5) * voxel - f32(0.25), 0.5 * farthest
        found = self.halved.border(at, before, behind, limit)
        less = np.flatnonzero(found.confidence < 1)
        layer = borders_of_layers(
            self.halved, at[less], towards[less], found.at(less), before[less], behind[less], limit
        )
        better = layer.confidence > found.confidence[less]
        found.put(less[better], layer.at(better))
        return found.doubled()

    def beside_edges(self, at, found: Borders, before, behind) -> None:
        """Lowers the confidence of borders found at (n, 3) positions at half the resolution where they have an edge."""
        some = np.flatnonzero((found.confidence > 0) & ~found.is_thin)
        shift, _ = _away_from_ends(self.dims, f32(2) * at[some] + f32(0.5), found.at(some))
        some = some[dot(shift, shift) <= f32(0.25)]
        goes_on = _goes_on(self.halved, at[some], found.towards[some], before[some], behind[some])
        found.edge[some] = f32(1) - goes_on
        found.confidence[some] *= f32(1) - found.edge[some]

    def _inside(self, plane: Borders, on, before, behind) -> np.ndarray:
        """Moves planes along themselves to where the ends do not bend them. Returns places on them there."""
        start, at, room = on, on.copy(), np.zeros(len(on), np.float32)
        step, active = np.ones(len(on), np.float32), np.ones(len(on), bool)
        for n in range(4):
            some = np.flatnonzero(active)
            now = plane.at(some)
            at[some] += step[some, None] * _away_from_ends(self.dims, at[some], now)[0]
            found = self.widest(at[some], now.towards, before[some], behind[some], 1.0 if n == 3 else 6.0)
            known = found.confidence > 0
            lost = some[~known]
            if n > 0:
                plane.confidence[lost], active[lost] = 0, False
            else:
                step[lost], at[lost] = 0.5, start[lost]
            some, found = some[known], found.at(known)
            step[some] = 1
            at[some] += found.overshoot[:, None] * found.towards
            plane.put(some, found)
            rest, room[some] = _away_from_ends(self.dims, at[some], found)
            if n > 0:
                active[some[(np.abs(found.overshoot) < 0.5) & (dot(rest, rest) < 1)]] = False
        plane.confidence *= ramp(16.0, 22.0, room)
        return at

    def _whole(self, voxel, plane: Borders, on, before, behind) -> tuple[Borders, np.ndarray]:
        """Planes nearly along layers of voxels from samples over their steps, and places on them."""
        count = len(voxel)
        found, normal = plane.at(slice(None)), plane.towards
        size = np.abs(normal)
        upright = size.argmax(axis=-1)
        middle, across, falls, certainty = self._axial(voxel, normal, on, upright)
        axial, oblique = (np.flatnonzero(is_so) for is_so in (size.max(axis=-1) > 0.9, size.max(axis=-1) <= 0.9))
        if len(oblique):
            parts = self._diagonal(normal[oblique], on[oblique], upright[oblique])
            middle[oblique], across[:, oblique], certainty[oblique] = parts
            falls[:, oblique] = 1
        places, normals = np.zeros((2, _SAMPLES**2, count, 3), np.float32)
        weights, whole = np.zeros((_SAMPLES**2, count), np.float32), np.zeros(count, np.float32)
        for sample in range(len(places)):
            steps = sample % _SAMPLES - 2, sample // _SAMPLES - 2
            weight = np.ones(count, np.float32)
            for fall, step in zip(falls, steps, strict=True):
                weight *= f32(1) - fall * f32(_FALLS[abs(step)])
            whole += weight
            at = middle + f32(steps[0]) * across[0] + f32(steps[1]) * across[1]
            border = self.widest(at, normal, before, behind, 4.0)
            weight *= border.confidence
            known = np.flatnonzero(weight > 0)
            weight[known] *= _goes_on(
                self.halved, f32(0.5) * at[known] - f32(0.25), border.towards[known], before[known], behind[known]
            )
            weights[sample] = weight
            normals[sample], places[sample] = border.towards, at + border.overshoot[:, None] * border.towards
            straight = axial[weight[axial] > 0]
            normals[sample, straight], inwards = self._without_ends(
                at[straight], border.towards[straight], upright[straight]
            )
            places[sample, straight] += inwards
        total = weights.sum(axis=0)
        part = total / whole
        some = np.flatnonzero((part >= _LEAST_SAMPLES) & (certainty > 0))
        found.confidence[:], found.curvature[:] = 0, 0
        parts = weights[:, some, None]
        found.towards[some] = unit((parts * normals[:, some]).sum(axis=0))
        on = on.copy()
        on[some] = (parts * places[:, some]).sum(axis=0) / total[some, None]
        away = np.abs(_beyond_plane(places[:, some], on[some], found.towards[some]))
        off = (weights[:, some] * ramp(0.7, 1.0, away)).sum(axis=0) / total[some]
        found.confidence[some] = certainty[some] * (f32(1) - ramp(0.04, 0.08, off))
        found.confidence[some] *= ramp(_LEAST_SAMPLES, 1.5 * _LEAST_SAMPLES, part[some])
        return found, on

    def _axial(self, voxel, normal, on, upright) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(middle (n, 3), steps across (2, n, 3), fall of weights (2, n), certainty (n,)) of samples along an axis."""
        rows, half_way = np.arange(len(voxel)), f32(0.5) * f32(self.dims) - f32(0.5)
        low = np.minimum(_END_SAMPLE, half_way)
        high = np.maximum(f32(self.dims) - f32(1) - _END_SAMPLE, half_way)
        margin = np.minimum(f32(2) * _SAMPLES_APART, f32(0.5) * (high - low))
        clipped = np.clip(voxel, low + margin, high - margin)
        apart = np.minimum(_SAMPLES_APART, f32(0.5) * np.minimum(clipped - low, high - clipped))
        middle, across = on.copy(), np.zeros((2, len(voxel), 3), np.float32)
        rise, falls = np.zeros(len(voxel), np.float32), np.zeros((2, len(voxel)), np.float32)
        steepest = normal[rows, upright]
        for side in range(2):
            axis = (upright + 1 + side) % 3
            middle[rows, axis] = clipped[rows, axis]
            rise += normal[rows, axis] * (clipped[rows, axis] - on[rows, axis])
            across[side, rows, axis] = apart[rows, axis]
            falls[side] = ramp(12.0, float(_SAMPLES_APART), apart[rows, axis])
            across[side, rows, upright] = -apart[rows, axis] * normal[rows, axis] / steepest
        middle[rows, upright] -= rise / steepest
        return middle, across, falls, np.ones(len(voxel), np.float32)

    def _without_ends(self, at, normal, upright) -> tuple[np.ndarray, np.ndarray]:
        """(normals (n, 3), displacements (n, 3) of their places) of planes along an axis as if there were no ends."""
        rows, sigma = np.arange(len(at)), f32(2.0 * np.sqrt(self.halved.variance))
        sizes, inwards = f32(self.dims), np.zeros_like(at)
        normal = normal.copy()
        for side in (1, 2):
            axis = (upright + side) % 3
            near, far = (at[rows, axis] - f32(1)) / sigma, (sizes[axis] - f32(2) - at[rows, axis]) / sigma
            (first, density), (last, other_density) = _normal_distribution(near), _normal_distribution(far)
            normal[rows, axis] /= np.maximum(first + last - f32(1), f32(0.1))
            inwards[rows, axis] = sigma * (
                f32(0.5) * (density - other_density) - near * (f32(1) - first) + far * (f32(1) - last)
            )
        return unit(normal), inwards

    def _diagonal(self, normal, on, upright) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(middle, steps across, certainty) of those of planes along diagonals."""
        up = np.eye(3, dtype=np.float32)[upright]
        first = unit(up - dot(up, normal)[:, None] * normal)
        across = np.stack([first, np.cross(normal, first)]).astype(np.float32)
        extent = np.abs(across).sum(axis=0)
        reach = _END_REACH * np.sqrt(np.maximum(f32(1) - normal * normal, f32(0)))
        low, high = f32(0.5) + reach, f32(self.dims) - f32(1.5) - reach
        half_way, margin = f32(0.5) * (low + high), f32(16) * extent
        inside = np.clip(on, np.minimum(low + margin, half_way), np.maximum(high - margin, half_way))
        middle = inside - dot(inside - on, normal)[:, None] * normal
        room = (np.minimum(middle - low, high - middle) / (f32(2) * extent)).min(axis=-1)
        apart = np.clip(room, f32(0), _SAMPLES_APART)
        return middle, across * apart[:, None], ramp(3.0, 6.0, apart)

    def straighten(self, voxel, borders: Borders, before, behind) -> None:
        """Planes near an end as they are farther inside, and those nearly along the voxels as they are on the whole.

        The confidence of borders near (n, 3) positions is that of being as flat as the widest Gaussian.
        """
        size = length(borders.towards)
        normal = borders.towards / np.maximum(size, f32(1e-6))[:, None]
        planes = borders.at(slice(None))
        planes.towards = normal
        shift, _ = _away_from_ends(self.dims, voxel, planes)
        near_end = dot(shift, shift) > f32(0.25)
        is_about_axial = np.abs(normal).max(axis=-1) > f32(0.98)
        alignment = np.maximum(_along_layers(normal), np.where(is_about_axial, borders.edge, f32(0)))
        some = np.flatnonzero((size >= 1e-6) & (near_end | (alignment * borders.flat > 0)))
        if len(some) == 0:
            return
        voxel, before, behind, normal, alignment = (part[some] for part in (voxel, before, behind, normal, alignment))
        now, plane = planes.at(some), planes.at(some)
        plane.confidence = plane.flat.copy()
        on = voxel + now.overshoot[:, None] * normal
        ends = np.flatnonzero(near_end[some])
        moved = plane.at(ends)
        on[ends] = self._inside(moved, on[ends], before[ends], behind[ends])
        plane.put(ends, moved)
        known = np.where(near_end[some], f32(1), f32(1) - alignment * now.edge)
        plane.confidence *= f32(1) - known * ramp(0.003, 0.006, np.abs(plane.curvature))
        plane.overshoot = _beyond_plane(voxel, on, plane.towards)
        along = np.flatnonzero((alignment > 0) & (plane.confidence > 0))
        whole, middle = self._whole(voxel[along], plane.at(along), on[along], before[along], behind[along])
        turned = np.minimum(alignment[along], _along_layers(whole.towards))
        part = np.where(now.edge[along] > 0, turned, alignment[along]) * whole.confidence
        beyond = _beyond_plane(voxel[along], middle, whole.towards)
        plane.overshoot[along] += part * (beyond - plane.overshoot[along])
        plane.towards[along] += part[:, None] * (whole.towards - plane.towards[along])
        plane.curvature[along] *= f32(1) - part
        plane.confidence *= f32(1) - ramp(0.5, 1.0, np.abs(plane.overshoot - now.overshoot))
        plane.confidence *= ramp(0.5, 0.7, dot(plane.towards, normal))
        now.confidence[:] = 1
        now.refine(plane)
        borders.put(some, now)
