"""Beams from an aperture in soft tissue (kernels/aperture.cl): the aperture as a phase screen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tests.reference.beam import Beam
from tests.reference.elementary import LN10_OVER_20, affine_point, affine_vector, f32, ramp
from tests.reference.labels import Labels

# Gauss-Hermite rule for the power of a beam across, in its standard deviations
_ROWS, _WEIGHTS = np.sqrt(1.5) * np.array([-1.0, 0.0, 1.0]), np.array([1.0, 4.0, 1.0]) / 6.0
_BENT = 4.0  # nepers both ways per millimetre of strong tissue that bends what goes through
_EDGE_OF_BONE = 0.75  # part of a cell from which lines are lost in it by their length
_LEAST_OPEN = 0.05  # amplitude that is left by the part that bone covers
_LEAST = 1e-3  # nepers by which strong tissue differs from soft
_MOST_SPREAD = 3.0  # of a beam
_NO_END = 1e3  # mm: no strong tissue ends in front
_LEAST_UNEVEN, _MOST_UNEVEN = 0.02, 0.7  # nepers by which soft tissue takes more from one line than from another
_SOFT_SPEED, _SOFT_REFLECTION = 0.105, 0.12  # largest contrasts of a soft border
_LOSSY_PER_MM = 0.8  # nepers both ways
_STRAIGHT_SPEED = 0.2  # and of strong tissue in which paths go straight on


def as_beams_see(tissues: np.ndarray, acquisition: np.ndarray) -> np.ndarray:
    """The layout.TISSUE records with the speeds for is_soft and bends: negative where tissue is very lossy."""
    seen = tissues.copy()
    decay = tissues["attenuation_db_cm_mhz"] * f32(acquisition["frequency_mhz"]) * f32(0.2) * LN10_OVER_20
    seen["speed_of_sound_m_s"][decay > f32(_LOSSY_PER_MM)] *= f32(-1)
    return seen


def is_soft(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether the borders between layout.TISSUE records are soft: speeds of sound and impedances are similar."""
    speeds = first["speed_of_sound_m_s"], second["speed_of_sound_m_s"]
    impedances = first["impedance_mrayl"], second["impedance_mrayl"]
    return (np.abs(speeds[0] - speeds[1]) <= f32(0.5 * _SOFT_SPEED) * np.abs(speeds[0] + speeds[1])) & (
        np.abs(impedances[0] - impedances[1]) <= f32(_SOFT_REFLECTION) * (impedances[0] + impedances[1])
    )


def bends(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether paths between layout.TISSUE records do not go straight on, however soft or strong the border."""
    speeds = np.abs(first["speed_of_sound_m_s"]), np.abs(second["speed_of_sound_m_s"])
    return np.abs(speeds[0] - speeds[1]) > f32(0.5 * _STRAIGHT_SPEED) * (speeds[0] + speeds[1])


def are_covering(seen: np.ndarray) -> np.ndarray:
    """(labels,) whether records of as_beams_see cover a face: strong tissue, as if behind a film of label 0."""
    lossy = (seen["speed_of_sound_m_s"] < 0) & (seen["speed_of_sound_m_s"][0] > 0)
    return lossy | bends(seen[:1], seen)


@dataclass
class Axis:
    """The axis of a line: where it leaves the face, its direction, across it (2,), and its place along the face."""

    origin: np.ndarray
    direction: np.ndarray
    across: np.ndarray
    centre: float


class Screens:
    """Beams of an acquisition; `run` gives what soft tissue does to them."""

    def __init__(self, acquisition: np.ndarray, labels: Labels, tissues: np.ndarray) -> None:
        self.acquisition, self.labels, self.tissues = acquisition, labels, tissues
        fields = {
            name: acquisition[name].item() for name in acquisition.dtype.names or () if acquisition[name].ndim == 0
        }
        self.fields = fields
        self.is_flat = bool(fields["flat_face"])
        self.along = fields["fan_first"] + fields["fan_pitch"] * np.arange(fields["fan_points"])
        self.normal = 0.0 * self.along if self.is_flat else self.along / fields["apex_radius_mm"]
        bent = fields["apex_radius_mm"] * np.stack([np.sin(self.normal), np.cos(self.normal) - 1.0], -1)
        #: (points, 2) in the image plane
        self.points = np.stack([self.along, 0.0 * self.along], -1) if self.is_flat else bent

    def run(self) -> tuple[np.ndarray, np.ndarray]:
        """((screen lines, depths, 8) float32 nepers lost both ways, extra path and two deflections in mm; widths).

        The last of the eight are the nepers of the first that strong tissue takes, those that it takes right behind its
        last end after the depth before, those that soft tissue has taken from what arrives, on the mean, and the
        distance from that end in mm, negative in strong tissue.
        Widths (screen lines, depths, 2) are those of the beam re an undisturbed one, and factors of its echoes.
        """
        fields = self.fields
        count, depths = fields["screen_lines"], fields["screen_depths"]
        if not fields["aperture_beams"]:
            return np.zeros((count, depths, 8), np.float32), np.ones((count, depths, 2), np.float32)
        sums = self._fans()
        traced = np.arange(count) * (fields["traced_lines"] - 1) / (count - 1) - fields["guard_lines"]
        position = fields["first_line"] + fields["line_spacing"] * traced / fields["lateral_rays"]
        paths = fields["screen_step"] * np.arange(1, depths + 1)
        axes = [self._axis(line) for line in position]
        found = np.zeros((count, depths, 9), np.float32)
        for n, axis in enumerate(axes):
            beside = [axis, *axes[n - 1 : n], *axes[n + 1 : n + 2]] if n else [axis, *axes[1:2]]
            for depth, path in enumerate(paths):
                found[n, depth] = self._beam(sums, axis, beside, path)
        factors = self._kept_levels(found[..., 0], found[..., 8], f32(paths))
        return found[..., :8], np.stack([found[..., 8], factors], -1)

    def _fans(self) -> np.ndarray:
        """(rows, points, angles, depths, 5) sums: extra path, nepers, by strong tissue, elevational deflection.

        The last says whether the step before a depth is in strong tissue.
        """
        fields, acquisition = self.fields, self.acquisition
        own = fields["fan_first_angle"] + fields["fan_angle_step"] * np.arange(fields["fan_angles"])
        angle = f32(self.normal[:, None] + own)
        zero = np.zeros_like(angle)
        direction = np.stack([np.sin(angle), np.cos(angle), zero], -1)
        origin = np.concatenate([self.points, np.zeros((len(self.points), 1))], -1).astype(np.float32)
        to_ras, to_voxel = acquisition["probe_to_ras"], acquisition["ras_to_voxel"]
        shape = (3, *angle.shape)
        start = affine_point(to_voxel, affine_point(to_ras, origin))[None, :, None]
        step = affine_vector(to_voxel, affine_vector(to_ras, direction))[None]
        aside = affine_vector(to_voxel, affine_vector(to_ras, np.array([0, 0, 1], np.float32)))
        aside = f32(_ROWS)[:, None, None, None] * aside
        length = f32(fields["fan_step"])
        self._start_rays(int(np.prod(shape)))
        stored = np.zeros((fields["fan_depths"], 5, self.total.shape[1]), np.float32)
        elevation_sigma = Beam(acquisition).elevation_sigma
        for n in range(fields["fan_depths"] - 1):
            path = (f32(n) + f32(0.5)) * length
            sigma = elevation_sigma(path)
            at = np.broadcast_to(start + path * step + sigma * aside, (*shape, 3))
            before = self.total[0].copy()
            self._look_up(at.reshape(-1, 3), length)
            stored[n + 1, :3] = self.total
            # The turn of a path by the gradient of delay between the outer rows, and how far aside it has come
            turned = (self.total[0] - before) / (f32(_ROWS[2] - _ROWS[0]) * sigma)
            stored[n + 1, 3] = stored[n, 3] + length * (self.lean + f32(0.5) * turned)
            self.lean += turned
            stored[n + 1, 4] = self.is_seen
        return np.moveaxis(stored.reshape(-1, 5, *shape), (0, 1), (-2, -1))

    def _start_rays(self, count: int) -> None:
        """Rates per millimetre by label, and for every ray the tissue in which it is and its sums."""
        tissues, fields = self.tissues, self.fields
        speed = np.maximum(tissues["speed_of_sound_m_s"], f32(1))
        self.rates = f32([
            np.where(tissues["speed_of_sound_m_s"] > 0, fields["reference_speed_m_s"] / speed - 1.0, 0.0),
            tissues["attenuation_db_cm_mhz"] * fields["frequency_mhz"] * 0.2 * LN10_OVER_20,
        ])  # fmt: skip
        seen = as_beams_see(tissues, self.acquisition)
        self.soft = is_soft(seen[:, None], seen[None])  # (label, label)
        self.bent = bends(seen[:, None], seen[None])
        impedance = tissues["impedance_mrayl"]
        sums = np.maximum(impedance[:, None] + impedance, 1e-9)  # labels without a tissue have none
        reflected = ((impedance[:, None] - impedance) / sums) ** 2
        self.border = -np.log(np.maximum(1.0 - reflected, 1e-6))
        self.covered_by = are_covering(seen)
        self.current = np.full(count, -1)  # the last soft tissue; -1 at the face
        self.last = np.zeros(count, int)  # the tissue of the last step, and whether it was strong
        self.was_strong = np.zeros(count, bool)
        self.leaving = np.zeros(count, bool)  # whether strong tissue was in this cell or the last ones
        self.is_seen = np.zeros(count, bool)  # whether it is, in the last step
        self.covered = np.zeros(count)  # the largest part of a cell that was bone
        self.total = np.zeros((3, count), np.float32)
        self.lean = np.zeros(count, np.float32)

    def _look_up(self, at: np.ndarray, length: np.ndarray) -> None:
        """Add a length of every ray at its voxel position (n, 3)."""
        here, f = self.labels.cells(at)
        one_label, nearest = self.labels.one_label[here], self.labels.label[here].astype(int)
        mixed = np.flatnonzero(~one_label)
        nearest[mixed] = self.labels.label[here[mixed] + (f[mixed] > f32(0.5)) @ self.labels.steps]
        begins = (self.current < 0) & ~self.covered_by[nearest]
        self.current = np.maximum(self.current, 0)  # the coupling medium
        soft = begins | self.soft[self.current, nearest]
        self.current = np.where(soft, nearest, self.current)
        bent = self.bent[self.current, nearest]
        rate = self.rates[:, self.current]
        rate[0] = np.where(bent, rate[0], self.rates[0, nearest])
        corners = self.labels.label[here[mixed][:, None] + self.labels.corner_steps].astype(int)
        current = self.current[mixed][:, None]
        weights = self.labels.trilinear_weights(f[mixed])
        for kind, stays in enumerate((self.bent[current, corners], ~self.soft[current, corners])):
            rate[kind, mixed] = (self.rates[kind, np.where(stays, current, corners)] * weights).sum(axis=-1)
        self.total[:2] += length * rate
        bone = bent.astype(float)
        bone[mixed] = (self.bent[current, corners] * weights).sum(axis=-1)
        taken = self.rates[1, corners] - self.rates[1, current]
        excess = np.where(soft | bent, 0.0, self.rates[1, nearest] - self.rates[1, self.current])
        straight = ~self.soft[current, corners] & ~self.bent[current, corners]
        excess[mixed] = (np.where(straight, taken, 0.0) * weights).sum(axis=-1)
        excess = np.where(~soft & ~bent & (np.abs(excess) < _LEAST), _LEAST, excess)
        in_bone = np.maximum(_BENT * ramp(_EDGE_OF_BONE, 1.0, bone), _LEAST)
        before = np.where(self.was_strong, self.last, self.current)
        at_border = np.where(~soft | self.was_strong, self.border[before, nearest], 0.0)
        self.total[2] += at_border + length * (excess + np.where(bent, in_bone, 0.0))
        self.is_seen = ~soft | (at_border != 0.0) | ((excess != 0.0) & ~self.leaving) | (bone > self.covered)
        self.leaving = ~soft | (self.leaving & (excess != 0.0))
        more = np.log((1.0 - self.covered) / np.maximum(1.0 - bone, _LEAST_OPEN))
        self.total[2] += np.where(bone > self.covered, 2.0 * more, 0.0)
        self.covered = np.maximum(self.covered, np.minimum(bone, 1.0 - _LEAST_OPEN))
        self.last, self.was_strong = nearest, ~soft

    def _places(self, used: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(rays, depths, lengths in mm) of the straight lines from points to a target (2,), within their fans."""
        fields = self.fields
        towards = target - self.points[used]
        away = np.hypot(*towards.T)
        turned = np.arctan2(towards[:, 0], towards[:, 1]) - self.normal[used] - fields["fan_first_angle"]
        place = np.clip(turned / fields["fan_angle_step"], 0.0, fields["fan_angles"] - 1.001)
        return place, np.clip(away / fields["fan_step"], 0.0, fields["fan_depths"] - 1.001), away

    def _sums_at(self, sums: np.ndarray, used: np.ndarray, target: np.ndarray, path: float) -> np.ndarray:
        """(4, rows, used points) sums on the straight lines to a point; the amplitude that passes strong tissue."""
        place, far, away = self._places(used, target)
        ray, depth = place.astype(int), far.astype(int)
        result = 0.0
        for next_ray, of_ray in ((0, 1.0 - place + ray), (1, place - ray)):
            on_ray = 0.0
            for next_depth, of_depth in ((0, 1.0 - far + depth), (1, far - depth)):
                on_ray += sums[:, used, ray + next_ray, depth + next_depth, :4] * of_depth[:, None]
            on_ray[..., 2] = np.exp(-0.5 * np.maximum(on_ray[..., 2], -4))
            result += on_ray * of_ray[:, None]
        result[..., [0, 1, 3]] *= (path / away)[:, None]
        return np.moveaxis(result, -1, 0)

    def _axis(self, position: float) -> Axis:
        """The axis of a line at this position (radians or millimetres)."""
        fields = self.fields
        angle = np.arcsin(fields["steering_sin"]) if fields["linear"] else position
        direction, across = np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])
        centre = position / np.cos(angle) if fields["linear"] else fields["apex_radius_mm"] * position
        if fields["steered"] and not fields["linear"]:
            centre = fields["apex_radius_mm"] * np.tan(position)
        flat = np.array([centre, 0.0])
        origin = flat if self.is_flat else fields["apex_radius_mm"] * (direction - [0.0, 1.0])
        return Axis(origin, direction, across, float(centre))

    def _shares(self, sums: np.ndarray, axis: Axis, path: float) -> tuple[np.ndarray, int, np.ndarray]:
        """((steps,) how much of the axis is in strong tissue, the step at `path`, (depths,) nepers of one ray)."""
        fields, count = self.fields, self.fields["fan_points"]
        at = float(np.clip((axis.centre - fields["fan_first"]) / fields["fan_pitch"], 0.0, count - 1.0))
        points = np.minimum(int(at) + np.arange(2), count - 1)
        place, far, _ = self._places(points, axis.origin + path * axis.direction)
        ray, aside = place.astype(int), place - place.astype(int)
        shares = np.outer([1.0 - at + int(at), at - int(at)], [1.0, 1.0]) * np.stack([1.0 - aside, aside], -1)
        strong = sums[1, points[:, None], ray[:, None] + np.arange(2), 1:, 4]
        share = (shares[..., None] * strong).sum(axis=(0, 1))
        return share, int(far[1]), sums[1, points[0], int(place[0] + 0.5), :, 2]

    def _depth_outside(self, sums: np.ndarray, axis: Axis, path: float) -> float:
        """The depth on the axis at which a beam is as at `path`: not in strong tissue or shortly before it."""
        step = self.fields["fan_step"]
        share, own, _ = self._shares(sums, axis, path)
        own = int(np.clip(own, 2, self.fields["fan_depths"] - 6))
        in_front = share[own - 2 : own].sum()
        ahead = share[own : own + 5]
        if ahead.max() <= 0.5 or (share[own] <= 0.5 and ahead.sum() <= 2.0 * in_front):
            return path
        for ends in (own, own + 1):
            if share[own] > 0.5 >= share[ends + 1]:
                return max(path, (ends + 1.5) * step)
        while own > 4 and share[own] > 0.0:
            if share[own] <= 0.5 and share[own - 1] > share[own]:  # other strong tissue, in front of this one
                return min(own * step, path)
            own -= 1
        return min(max(own - 3.0, 1.0) * step, path)

    def _end_between(self, sums: np.ndarray, axis: Axis, start: float, end: float) -> float:
        """The path on an axis behind the last step between two in which strong tissue ends; 0 if there is none."""
        step = self.fields["fan_step"]
        share, at, nearest = self._shares(sums, axis, end)
        last = min(at + 1, self.fields["fan_depths"] - 3)
        first = max(at - int(np.ceil((end - start) / step)) - 1, 0)
        if nearest[last + 1] == nearest[first]:
            return 0.0
        ends = [depth for depth in range(first, last + 1) if share[depth] > 0.5 >= share[depth + 1]]
        return (ends[-1] + 1.5) * step if ends else 0.0

    def _kept_levels(self, nepers: np.ndarray, widths: np.ndarray, paths: np.ndarray) -> np.ndarray:
        """(screen lines, depths) factors that leave every line its mean power, whatever the width of its beam."""
        lines, beam = np.arange(len(nepers)), Beam(self.acquisition)
        traced = (self.fields["traced_lines"] - 1) / (len(nepers) - 1)
        starts = beam.traced_start(lines * traced)
        sigma = beam.lateral_sigma(paths) / (beam.line_distance(paths + starts[:, None]) * traced)

        def passed(width: np.ndarray) -> np.ndarray:
            places = [lines[:, None] + row * width for row in _ROWS]
            at = [[np.interp(place[:, n], lines, nepers[:, n]) for n in range(len(paths))] for place in places]
            return np.einsum("r,rnl->ln", _WEIGHTS, np.exp(2.0 * (nepers.T - np.array(at))))

        return np.sqrt(passed(sigma) / passed(sigma * widths)).astype(np.float32)

    def _beam(self, sums: np.ndarray, axis: Axis, beside: list[Axis], path: float) -> tuple[float, ...]:
        """The nine values of one depth of one line; `beside` are the axes on which strong tissue may end before it."""
        fields = self.fields
        mean_x, mean_delay, slope, rise, lost = self._means(sums, axis, path)
        depth = self._depth_outside(sums, axis, path)
        if depth < path:
            _, _, slope, rise, _ = self._means(sums, axis, depth)
            rise *= path / depth
        more, shade, width, near = self._level(sums, axis, depth, lost if depth == path else None)
        end_shade, away = shade, _NO_END
        ends = (self._end_between(sums, each, path - fields["screen_step"], path) for each in beside)
        end = next((end for end in ends if end), 0.0)
        if end:
            end_shade, away = self._level(sums, axis, end, None)[3], max(path - end, 0.0)
            far = min(away * fields["cycles_per_mm"] / (8.0 * fields["receive_f_number"] ** 2), 1.0)
            shade = near + far * (shade - near)
        if depth < path:
            away = -max(away, 1e-3)
        delays = mean_delay - slope * mean_x, slope * path, rise
        return lost + more + shade, *delays, shade, end_shade, lost, away, width

    def _means(self, sums: np.ndarray, axis: Axis, path: float) -> tuple[float, ...]:
        """Means by power of the points' positions and of the extra path; its slope; elevational deflection; nepers."""
        x, open_, delay, loss, kept, passed, lift = self._lines(sums, axis, path)
        power = _WEIGHTS[:, None] * (open_ * ((kept * passed) ** 2 + 0.01) + 1e-6)
        arrives = _WEIGHTS[:, None] * kept**2 * (open_ * (passed**2 + 0.01) + 1e-6)
        share = power / power.sum()
        mean_x, mean_delay = (share * x).sum(), (share * delay).sum()
        spread, common = (share * x**2).sum() - mean_x**2, (share * x * delay).sum() - mean_x * mean_delay
        slope = np.clip(common / (spread + 0.02 * self.fields["fan_pitch"] ** 2), -0.1, 0.1)
        row_lift = (power * lift).sum(axis=1) / power.sum(axis=1)
        rise = np.clip(row_lift[2] - row_lift[0], -0.1 * path, 0.1 * path)
        return mean_x, mean_delay, slope, rise, (arrives * loss).sum() / max(arrives.sum(), 1e-6)

    def _lines(self, sums: np.ndarray, axis: Axis, depth: float) -> tuple[np.ndarray, ...]:
        """Lateral positions and weights (points,) of the lines to a depth of an axis; (rows, points) sums along them.

        These are extra path, nepers, amplitudes that soft and that strong tissue leaves, elevational deflection.
        """
        fields, pitch = self.fields, self.fields["fan_pitch"]
        reach = 0.5 * min(fields["aperture_mm"], depth / fields["receive_f_number"])
        away = np.abs(self.along - axis.centre)
        used = np.flatnonzero(away <= reach + 0.5 * pitch * (1.0 + 1e-6))
        open_ = np.clip((reach - away[used]) / pitch + 0.5, 0.0, 1.0)
        delay, loss, passed, lift = self._sums_at(sums, used, axis.origin + depth * axis.direction, depth)
        kept = np.exp(-0.5 * (loss - loss.min())) if np.ptp(loss) >= _LEAST_UNEVEN else np.ones_like(loss)
        return (self.points[used] - axis.origin) @ axis.across, open_, delay, loss, kept, passed, lift

    def _level(self, sums: np.ndarray, axis: Axis, depth: float, lost: float | None) -> tuple[float, ...]:
        """Nepers that soft tissue takes beyond `lost` (None: the mean) and strong tissue; width; those right behind."""
        x, open_, delay, loss, kept, passed, _ = self._lines(sums, axis, depth)
        if lost is None:
            lost = float(np.average(loss, weights=_WEIGHTS[:, None] * open_ * kept**2))
        cycles = 0.5 * self.fields["cycles_per_mm"]
        focus = np.exp(1j * np.pi * cycles * (1.0 / depth - 1.0 / Beam(self.acquisition).transmit_focus(depth)) * x**2)
        wave = open_ * np.exp(2j * np.pi * cycles * (delay - delay.mean()))
        waves = open_[None], wave, wave * kept, wave * kept * passed
        still, bent, soft, stopped = (_two_way(each, focus) for each in waves)
        by_soft = max(soft.sum() / still.sum(), 1e-7)
        level = max(stopped.sum() / still.sum(), 1e-7 * by_soft) if (passed != 1.0).any() else by_soft
        own = loss.min() if np.ptp(loss) >= _LEAST_UNEVEN else lost  # of a line that is `kept`
        width = _width(soft if np.ptp(loss) < _MOST_UNEVEN else bent)
        spread = np.clip(width / _width(still), 1.0, _MOST_SPREAD)
        lit = np.average(passed**4, weights=_WEIGHTS[:, None] * open_)
        near = -0.5 * np.log(max(float(lit), 1e-7)) if (passed != 1.0).any() else 0.0
        return own - lost - 0.5 * np.log(by_soft), 0.5 * np.log(by_soft / level), spread, near


class Lit:
    """What strong tissue lets through between screen lines, averaged over the width of the transmitted beam."""

    def __init__(self, acquisition: np.ndarray, screens: np.ndarray) -> None:
        self.acquisition, self.screens, self.beam = acquisition, screens, Beam(acquisition)

    def shades(self, place: np.ndarray, depth: np.ndarray, apart: np.ndarray) -> np.ndarray:
        """(n, 2) nepers at places among the screen lines and at depths (n,), and behind the last end before them.

        Traced lines are `apart` mm (n,).
        """
        acquisition = self.acquisition
        path = f32(depth + 1) * acquisition["screen_step"]
        per_line = f32(len(self.screens) - 1) / f32(acquisition["traced_lines"] - 1)
        per_mm = per_line / apart
        extra = self._extra_variance(path)
        nearest = [self._between(place + row * np.sqrt(2.0) * np.sqrt(extra) * per_mm, depth) for row in _ROWS]
        away = np.min([np.abs(pair[..., 7]) for left, right, _ in nearest for pair in (left, right)], axis=0)
        cone = away / acquisition["receive_f_number"]
        sigma = np.sqrt(np.maximum(extra - cone * cone / 12.0, 0.0)) * per_mm
        behind = np.sqrt(self._extra_variance(np.maximum(path - away, 0.0))) * per_mm
        ends = away < _NO_END
        lit = self._mean(place, depth, 4, np.where(ends, sigma, 0.0))
        return -np.log(np.stack([lit, np.where(ends, self._mean(place, depth, 5, behind), lit)], -1)).astype(np.float32)

    def _extra_variance(self, path: np.ndarray) -> np.ndarray:
        transmitted, received = self.beam.one_way(path)
        return 0.5 * np.maximum(transmitted - received, 0.0)

    def _between(self, place: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values of the screen lines before and behind places, and their parts."""
        inside = np.clip(place, 0.0, len(self.screens) - 1.001)
        left = inside.astype(int)
        return self.screens[left, depth], self.screens[left + 1, depth], inside - left

    def _mean(self, place: np.ndarray, depth: np.ndarray, kind: int, sigma: np.ndarray) -> np.ndarray:
        left, right, between = self._between(place, depth)
        inside = [each[..., 7] < 0.0 for each in (left, right)]
        between = np.where(inside[0] ^ inside[1], inside[0], between)
        lit = [np.exp(-each[..., kind]) for each in (left, right)]
        own = np.where(inside[0] & inside[1], np.minimum(*lit), lit[0] + between * (lit[1] - lit[0]))
        total = _WEIGHTS[1] * own
        for row, weight in zip(_ROWS[::2] * np.sqrt(2.0), _WEIGHTS[::2], strict=True):
            left, right, between = self._between(place + row * sigma, depth)
            most = [np.where(each[..., 7] < 0.0, own, np.inf) for each in (left, right)]
            lit = [np.minimum(np.exp(-each[..., kind]), limit) for each, limit in zip((left, right), most, strict=True)]
            total = total + weight * (lit[0] + between * (lit[1] - lit[0]))
        return np.maximum(total, own)


def _intensity(wave: np.ndarray) -> np.ndarray:
    """Intensity (..., directions) across the beam of waves (..., points) from the aperture."""
    return np.abs(np.fft.fft(wave, 64)) ** 2  # more than twice the points, as its spectrum needs


def _two_way(wave: np.ndarray, focus: np.ndarray) -> np.ndarray:
    """(directions,) product of the received and the transmitted intensity of waves (rows, points) or (1, points)."""
    weights = _WEIGHTS if len(wave) > 1 else np.ones(1)
    return (weights @ _intensity(wave)) * (weights @ _intensity(wave * focus))


def _width(intensity: np.ndarray) -> float:
    """The equivalent width of a beam, in directions."""
    return float(intensity.sum() ** 2 / (intensity**2).sum())
