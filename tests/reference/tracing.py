"""The ray trees of all lines, vectorised by tree level (kernels/raytracing.cl)."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field

import numpy as np

from SlicerUSSim.Logic.opencl.layout import HIT, SEGMENT
from tests.reference.aperture import Lit, are_covering, as_beams_see, bends, is_soft
from tests.reference.beam import Beam
from tests.reference.elementary import (
    LN10_OVER_20,
    affine_point,
    affine_vector,
    dot,
    exp,
    exp2,
    f32,
    length,
    log,
    log2,
    ramp,
    unit,
)  # fmt: skip
from tests.reference.labels import Labels, border_normals

# What a beam goes through: strong tissue that does not bend it, or tissue that does, of which nothing is written
_NOT_STRONG, _THROUGH, _UNDER = range(3)
_DARKEST = 7.0  # nepers lost to strong tissue: behind it nothing is left of a beam
_MOST_COURSES = 16
_CURVATURE_REACH = 3.0  # voxels to either side from which the curvature of a mirror is found
_MOST_GATHERED, _LEAST_GATHERED = 64, f32(0.4)  # lines with scatterers in common, and the least part of their power
_MOST_BEFORE_STRONG = f32(0.35)  # nepers by which a piece of a beam in front of bone may differ from its ray
_MOST_LOSS = 1.0  # nepers by which strong tissue may change the frequency of what has passed it
_LEAST_GIVEN = f32(0.2)  # nepers lost to a layer which are given back behind it, not along the whole piece
_NO_END = f32(1e3)  # mm: no strong tissue ends in front, as in aperture.Screens
_NO_DECAY = f32(1e9)  # in front of a piece: what it starts in lies in front of nothing


@dataclass
class Rays:
    """Active rays, one row each: the fields of raytracing.cl's Ray, their position in the output, and their node."""

    line: np.ndarray
    ray: np.ndarray  # 0 on the axis
    quantile: np.ndarray
    axis: np.ndarray
    direction: np.ndarray
    lateral: np.ndarray
    elevational: np.ndarray
    tube: np.ndarray
    path: np.ndarray
    depth: np.ndarray
    log_attenuation: np.ndarray
    loss: np.ndarray  # of attenuation by tissues alone, in nepers
    weight: np.ndarray
    blind_until: np.ndarray
    reflections: np.ndarray
    label: np.ndarray
    piece: np.ndarray  # of the beam, from path piece x screen_step on; -1 where the line is a ray
    since_path: np.ndarray  # path from which the piece is corrected
    course: np.ndarray  # how often the piece was begun again behind strong tissue
    shade: np.ndarray  # nepers lost to strong tissue there, or where the beam entered such tissue
    strong: np.ndarray  # what the beam goes through, since the soft tissue `front`
    front: np.ndarray
    front_weight: np.ndarray
    excess: np.ndarray  # nepers by which strong tissue has attenuated more
    taken: np.ndarray  # the part of the loss that is of soft tissue
    given_from: np.ndarray  # path from which losses are given back, ...
    given: np.ndarray  # ... and the nepers lost to that layer
    decay_before: np.ndarray  # in front of the tissue that the ray is in
    # The node, set by Tracer._begin: course in voxels, its end, state since its start
    start: np.ndarray = field(init=False)
    step: np.ndarray = field(init=False)
    aside: np.ndarray = field(init=False)
    depth_per_mm: np.ndarray = field(init=False)
    to_depth: np.ndarray = field(init=False)
    to_piece: np.ndarray = field(init=False)
    leave: np.ndarray = field(init=False)
    inside: np.ndarray = field(init=False)
    since: np.ndarray = field(init=False)
    spent: np.ndarray = field(init=False)
    open: np.ndarray = field(init=False)
    spent_open: np.ndarray = field(init=False)

    def __len__(self) -> int:
        return len(self.line)

    def of(self, which: np.ndarray) -> Rays:
        """A copy of some rows."""
        return self._with({name: rows[which] for name, rows in vars(self).items()})

    @staticmethod
    def joined(parts: list[Rays]) -> Rays:
        """All rows of several sets of rays; either all or none of them are at nodes."""
        return parts[0]._with({name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])})

    def _with(self, values: dict[str, np.ndarray]) -> Rays:
        made = copy(self)
        vars(made).update(values)
        return made


class Tracer:
    """Traces an acquisition; `segments` and `hits` are layout records, with arrays of their lines and rays."""

    def __init__(self, acquisition: np.ndarray, labels: Labels, tissues: np.ndarray, screens: np.ndarray) -> None:
        self.acquisition, self.labels, self.tissues, self.screens = acquisition, labels, tissues, screens
        self.elevation_sigma = Beam(acquisition).elevation_sigma
        self.to_voxel = acquisition["ras_to_voxel"]
        self.voxel_mm = acquisition["voxel_mm"]
        self._lit = Lit(acquisition, screens)
        self.seen = as_beams_see(tissues, acquisition)
        of_group = tissues["label_of_group"]
        self.soft = is_soft(self.seen[of_group][:, None], self.seen[of_group][None])
        self.soft &= (of_group >= 0) & (of_group >= 0)[:, None]
        self.decay = tissues["attenuation_db_cm_mhz"] * acquisition["frequency_mhz"] * f32(0.2) * LN10_OVER_20

    def run(self, roots: np.ndarray, quantiles: np.ndarray):
        """(segments, their lines, hits, their lines) for roots (lines, 4) and quantiles (lines, rays)."""
        self._segments, self._segment_lines, self._hits, self._hit_lines = [], [], [], []
        self._segment_pieces, self._hit_pieces, self._corrections = [], [], []
        self._root = self._roots(roots, quantiles)
        rays = self._uncovered(self._begin(self._start_pieces(self._root, self._root.piece)))
        while len(rays):
            rays = self._advance(rays)
        self._correct()
        order = np.argsort(np.concatenate(self._segment_lines), kind="stable")
        lines = np.concatenate(self._segment_lines)[order]
        hits = np.concatenate(self._hits) if self._hits else np.zeros(0, HIT)
        hit_lines = np.concatenate(self._hit_lines) if self._hits else np.zeros(0, int)
        return np.concatenate(self._segments)[order], lines, hits, hit_lines

    def _roots(self, roots: np.ndarray, quantiles: np.ndarray) -> Rays:
        lines, each = len(roots), quantiles.shape[1] + 1
        m, count = self.acquisition["probe_to_ras"], lines * each
        line, ray = np.divmod(np.arange(count), each)
        x, y, dx, dy = roots[line].T
        zero, one = np.zeros(count, np.float32), np.ones(count, np.float32)
        return Rays(
            line=line, ray=ray, quantile=np.pad(quantiles, ((0, 0), (1, 0))).ravel(),
            axis=affine_point(m, np.stack([x, y, zero], -1)),
            direction=unit(affine_vector(m, np.stack([dx, dy, zero], -1))),
            lateral=unit(affine_vector(m, np.stack([dy, -dx, zero], -1))),
            elevational=unit(affine_vector(m, np.stack([zero, zero, one], -1))),
            tube=np.stack([one, zero, one, zero], -1), path=zero, depth=self._starts(line),
            log_attenuation=zero, loss=zero,
            weight=one, blind_until=-one, reflections=np.zeros(count, int), label=np.full(count, -1),
            piece=np.full(count, 0 if self.acquisition["aperture_beams"] else -1),
            since_path=zero, course=np.zeros(count, int), shade=zero, strong=np.zeros(count, int),
            front=np.zeros(count, int), front_weight=one, excess=zero,
            taken=zero, given_from=zero, given=zero, decay_before=zero,
        )  # fmt: skip

    def _starts(self, line: np.ndarray) -> np.ndarray:
        """Displayed depths at which traced lines leave the face."""
        return Beam(self.acquisition).traced_start(line)

    # ---- pieces of a beam ------------------------------------------------------------------------------------------

    def _beams_at(self, line: np.ndarray, number: np.ndarray) -> np.ndarray:
        """(n, 8) beams of traced lines at the ends `number` of pieces, as in aperture.Screens."""
        acquisition, count = self.acquisition, len(self.screens)
        per_line = f32(count - 1) / f32(acquisition["traced_lines"] - 1)
        place = line.astype(np.float32) * per_line
        before = np.minimum(place.astype(int), count - 2)
        left, right = (self.screens[before + n, np.maximum(number - 1, 0)] for n in (0, 1))
        beam = left + (place - before.astype(np.float32))[:, None] * (right - left)
        path, per_strip = f32(np.maximum(number, 1)) * acquisition["screen_step"], (right - left) * per_line
        apart = Beam(acquisition).line_distance(path + self._starts(line))
        turns = acquisition["cycles_per_mm"] * (per_strip[:, 1] - (apart + per_strip[:, 2]) * (beam[:, 2] / path))
        shades = self._lit.shades(place, np.maximum(number - 1, 0), apart)
        beam[:, 0] += shades[:, 0] - beam[:, 4]
        beam[:, 4:6] = shades
        inside, endless = (left[:, 7] < 0) & (right[:, 7] < 0), (left[:, 7] == -_NO_END) & (right[:, 7] == -_NO_END)
        beam[:, 7] = np.where(~inside, 1, np.where(endless, -2, -1))
        beam[:, 0] += f32(0.5) * log(self._gathered_power(path, apart, f32(1) + per_strip[:, 2] / apart, turns))
        return np.where(number[:, None] == 0, f32(0), beam)

    def _gathered_power(self, path: np.ndarray, apart: np.ndarray, ratio: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """How power would change where axes `apart` mm come together to the part `ratio` of that; `turns` per line."""
        beam, width = Beam(self.acquisition), f32(1.3341168) * self.acquisition["fractional_bandwidth"]
        decay = (f32(0.5) * apart / beam.lateral_sigma(path)) ** 2 + (width * turns) ** 2
        n = np.arange(1, _MOST_GATHERED, dtype=np.float32)[:, None]
        common, weight = np.maximum(f32(1) - n * np.abs(ratio), f32(0)), np.exp(-decay * n * n)
        terms = common * np.where(weight < 1e-3, f32(0), weight) * np.cos(f32(2 * np.pi) * n * turns)
        return np.maximum(f32(1) + f32(2) * terms.sum(axis=0), _LEAST_GATHERED)

    def _uncovered(self, rays: Rays) -> Rays:
        """Rays that start in bone by themselves, and beside them what other parts of the aperture see."""
        covered = (rays.piece >= 0) & are_covering(self.seen)[rays.label]
        below = rays.of(covered & ~self._are_dark(rays))
        below.strong[:] = _UNDER  # of label 0
        rays.piece = np.where(covered, -1, rays.piece)
        return Rays.joined([self._begin(rays), self._begin(below)])

    def _start_pieces(self, rays: Rays, number: np.ndarray) -> Rays:
        """The rays at the start of the pieces `number` of their lines; behind the last one they go straight on."""
        rays = rays.of(np.arange(len(rays)))
        at = np.flatnonzero(number >= 0)
        if not len(at):
            return rays
        step, depths = self.acquisition["screen_step"], self.screens.shape[1]
        root = self._root.of(rays.line[at] * (1 + int(self.acquisition["elevational_rays"])) + rays.ray[at])
        number = number[at]
        beam = self._beams_at(rays.line[at], number)
        path = f32(number) * step
        rays.axis[at] = (
            root.axis + path[:, None] * root.direction + beam[:, 2:3] * root.lateral + beam[:, 3:4] * root.elevational
        )
        rays.piece[at] = np.where(number < depths, number, -1)
        rays.since_path[at], rays.course[at] = path, 0
        follows = (rays.strong[at] == _NOT_STRONG) & ((beam[:, 7] >= 0) | (rays.shade[at] < beam[:, 4]))
        rays.shade[at] = np.where(follows, beam[:, 4], rays.shade[at])
        rays.given[at], rays.given_from[at], rays.decay_before[at] = 0, path, _NO_DECAY
        has_next = number < depths
        at, root, beam = at[has_next], root.of(has_next), beam[has_next]
        turn = self._beams_at(rays.line[at], number[has_next] + 1) - beam
        direction = unit(step * root.direction + turn[:, 2:3] * root.lateral + turn[:, 3:4] * root.elevational)
        rays.direction[at] = direction
        rays.lateral[at] = _carried(root.lateral, root.direction, direction)
        rays.elevational[at] = _carried(root.elevational, root.direction, direction)
        return rays

    def _correction(self, rays: Rays, path, depth, log_attenuation, depth_per_mm, more) -> np.ndarray:
        """(n, 4) by which rays agree with their beams at a piece's end, where they have lost `more` nepers.

        Changes per mm of depth since the start of the piece, and of log amplitude and loss since the path that is the
        fourth; 0 where a line is a ray.
        """
        beam = self._beams_at(rays.line, np.maximum(rays.piece + 1, 0))
        end = f32(rays.piece + 1) * self.acquisition["screen_step"]
        rest, last = end - path, np.maximum(end, path)
        decay = self.decay[self._front(rays)]
        depth_left = self._starts(rays.line) + end + beam[:, 1] - (depth + rest * depth_per_mm)
        log_left = -beam[:, 0] - more - (log_attenuation - rest * decay)
        spared = rays.taken + rest * decay - beam[:, 6]
        since = np.where((log_left > 0) | (spared > 0), np.maximum(rays.since_path, rays.given_from), rays.since_path)
        along, of_piece = (np.maximum(last - start, f32(1e-3)) for start in (since, rays.since_path))
        found = np.stack([depth_left / of_piece, log_left / along, -spared / along, since], -1)
        return np.where((rays.piece >= 0)[:, None], found, f32(0))

    def _keep_correction(self, rays: Rays, correction: np.ndarray) -> None:
        """Keep a correction for what was written in the piece."""
        written = rays.strong != _UNDER
        kept = np.concatenate([correction, rays.since_path[:, None]], axis=1)
        self._corrections.append((self._piece_keys(rays)[written], kept[written]))

    @staticmethod
    def _corrections_at(rays: Rays, path: np.ndarray, correction: np.ndarray) -> tuple[np.ndarray, ...]:
        """(n,) changes of depth, log amplitude and loss of rays at a path."""
        along = _corrected_length(path, correction[:, 3])
        depth = correction[:, 0] * _corrected_length(path, rays.since_path)
        return depth, correction[:, 1] * along, correction[:, 2] * along

    @staticmethod
    def _give_back(rays: Rays, which: np.ndarray, lost: np.ndarray, path: np.ndarray) -> np.ndarray:
        """Which of these rays give back losses from `path` on: of the layer in which most is lost. Noted in rays."""
        gives = which & (rays.piece >= 0) & (rays.strong == _NOT_STRONG)
        gives &= lost > np.maximum(rays.given, _LEAST_GIVEN)
        rays.given = np.where(gives, lost, rays.given)
        rays.given_from = np.where(gives, path, rays.given_from)
        return gives

    @staticmethod
    def _front(rays: Rays) -> np.ndarray:
        """Labels of the soft tissue that rays are in, or that lies in front of strong tissue."""
        return np.where(rays.strong == _NOT_STRONG, rays.label, rays.front)

    def _next_shade(self, rays: Rays, kind: int = 4) -> np.ndarray:
        """Nepers lost to strong tissue at the ends of pieces, or (kind 5) behind its last end in them."""
        return np.where(rays.piece >= 0, self._beams_at(rays.line, np.maximum(rays.piece + 1, 0))[:, kind], f32(0))

    def _taken_from_rays(self, rays: Rays) -> np.ndarray:
        """Nepers that strong tissue has taken from rays and not from their beams at the ends of pieces."""
        lacks = rays.shade - self._next_shade(rays)
        held = (rays.strong == _NOT_STRONG) & (self._next_shade(rays, 7) < 0) & (lacks > 0)
        return np.where((rays.strong != _NOT_STRONG) | held, lacks, f32(0))

    def _shade_behind(self, rays: Rays) -> np.ndarray:
        """Nepers lost to strong tissue behind it, in these pieces, or where beams leave it in a later one."""
        shade, found = self._next_shade(rays, 5), self._next_shade(rays, 7) > f32(-1.5)
        for number in range(2, self.screens.shape[1] + 1):
            beam = self._beams_at(rays.line, np.minimum(rays.piece + number, self.screens.shape[1]))
            leaves = ~found & (rays.piece >= 0) & (rays.piece + number <= self.screens.shape[1]) & (beam[:, 7] > 0)
            shade, found = np.where(leaves, np.maximum(shade, beam[:, 4]), shade), found | leaves
        return shade

    def _are_dark(self, rays: Rays) -> np.ndarray:
        """Whether strong tissue leaves nothing of beams from their piece on."""
        dark = np.ones(len(rays), bool)
        for number in range(1, self.screens.shape[1] + 1):
            shade = self._beams_at(rays.line, np.full(len(rays), number))[:, 4]
            dark &= (number <= rays.piece) | (shade >= f32(_DARKEST))
        return dark

    def _piece_keys(self, rays: Rays) -> np.ndarray:
        """Numbers of line, ray, piece and course; -1 where a line is a ray."""
        ray = rays.line * (1 + int(self.acquisition["elevational_rays"])) + rays.ray
        return np.where(rays.piece >= 0, (ray * self.screens.shape[1] + rays.piece) * _MOST_COURSES + rays.course, -1)

    def _correct(self) -> None:
        """Apply the corrections to the segments and hits of the pieces."""
        if not self.acquisition["aperture_beams"]:
            return
        keys, kept = (np.concatenate(parts) for parts in zip(*self._corrections, strict=True))
        courses = len(self._root) * self.screens.shape[1] * _MOST_COURSES
        table = np.zeros((courses + 1, 5), np.float32)
        table[keys[keys >= 0]] = kept[keys >= 0]
        for records, pieces in ((self._segments, self._segment_pieces), (self._hits, self._hit_pieces)):
            for record, key in zip(records, pieces, strict=True):
                depth, log_amplitude, loss, since, start = table[key].T
                along = _corrected_length(record["path_mm"], since)
                factor = exp(log_amplitude * along)
                record["depth_mm"] += depth * _corrected_length(record["path_mm"], start)
                record["attenuation"] *= factor
                record["loss"] += loss * along
                if "echo" in (record.dtype.names or ()):
                    record["echo"] *= factor
                else:  # segments end where losses are given back
                    behind = record["path_mm"] + f32(0.5) * record["length_mm"] >= since
                    record["depth_per_mm"] += depth
                    record["decay_per_mm"] -= np.where(behind, log_amplitude, f32(0))
                    record["loss_per_mm"] += np.where(behind, loss, f32(0))

    # ---- nodes -----------------------------------------------------------------------------------------------------

    def _begin(self, rays: Rays) -> Rays:
        """Set every ray to the start of a node."""
        acquisition = self.acquisition
        rays.start = affine_point(self.to_voxel, rays.axis)
        rays.step = affine_vector(self.to_voxel, rays.direction)
        rays.aside = affine_vector(self.to_voxel, rays.elevational) * rays.quantile[:, None]
        zero = np.zeros(len(rays), np.float32)
        unknown = rays.label < 0
        if unknown.any():
            some = rays.of(unknown)
            rays.label[unknown] = self.labels.at(self._place(some, zero[unknown]))
        medium = np.where(rays.strong == _UNDER, rays.front, rays.label)
        rays.depth_per_mm = acquisition["reference_speed_m_s"] / self.tissues["speed_of_sound_m_s"][medium]
        rays.to_depth = (acquisition["traced_mm"] - rays.depth) / rays.depth_per_mm
        to_piece = f32(rays.piece) * acquisition["screen_step"] + acquisition["screen_step"] - rays.path
        rays.to_piece = np.where(rays.piece < 0, f32(np.inf), to_piece)
        margin = f32(3) + np.abs(rays.quantile) * f32(4) / self.voxel_mm
        enter, leave = zero, rays.to_depth
        for a in range(3):
            step = rays.step[:, a]
            inverse = f32(1) / np.where(np.abs(step) < f32(1e-7), f32(1e-7), step)
            t0 = (-margin - rays.start[:, a]) * inverse
            t1 = (acquisition["dims"][a] - f32(1) + margin - rays.start[:, a]) * inverse
            enter, leave = np.maximum(enter, np.minimum(t0, t1)), np.minimum(leave, np.maximum(t0, t1))
        rays.inside, rays.leave = np.minimum(enter, rays.to_depth), leave
        rays.since = rays.spent = rays.open = rays.spent_open = zero
        return rays

    def _place(self, rays: Rays, at: np.ndarray) -> np.ndarray:
        """(n, [m,] 3) voxel positions at lengths (n, [m]) of the nodes."""
        shape = (len(rays),) + (1,) * (at.ndim - 1)
        sigma = self.elevation_sigma(rays.path.reshape(shape) + at)[..., None]
        start, step, aside = (v.reshape(*shape, 3) for v in (rays.start, rays.step, rays.aside))
        return start + at[..., None] * step + sigma * aside

    def _next_border(self, rays: Rays, last: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(last length before, first behind, label behind) of each ray's next change of label; -1 if none to `last`."""
        inside, beyond, other = rays.inside.copy(), np.full(len(rays), -1, np.float32), rays.label.copy()
        stride = f32(0.5) * self.voxel_mm
        left = np.flatnonzero(inside < last)
        while len(left):
            some = rays.of(left)
            ahead = np.minimum(
                inside[left, None] + stride * np.arange(1, 9, dtype=np.float32), last[left, None] + f32(1e-4)
            )
            labels = self.labels.at(self._place(some, ahead))
            counts = (labels != some.label[:, None]) & (some.path[:, None] + ahead > some.blind_until[:, None])
            found, first = counts.any(axis=1), counts.argmax(axis=1)
            row = np.arange(len(left))
            before = np.where(first > 0, ahead[row, first - 1], inside[left])
            inside[left] = np.where(found, before, ahead[:, -1])
            beyond[left] = np.where(found, ahead[row, first], beyond[left])
            other[left] = np.where(found, labels[row, first], labels[:, -1])
            left = left[~found & (inside[left] < last[left])]
        found = np.flatnonzero(beyond >= 0)
        self._bisect(rays, found, 3, inside, beyond, other)
        group = self.tissues["group"]
        found = found[group[other[found]] != group[rays.label[found]]]
        self._bisect(rays, found, 2, inside, beyond, other)
        return inside, beyond, other

    def _bisect(self, rays: Rays, which: np.ndarray, times: int, inside, beyond, other) -> None:
        """Bisect the interval between `inside` and `beyond` of some rays, in place."""
        some = rays.of(which)
        for _ in range(times if len(which) else 0):
            middle = f32(0.5) * (inside[which] + beyond[which])
            found = self.labels.at(self._place(some, middle))
            same = found == some.label
            inside[which] = np.where(same, middle, inside[which])
            beyond[which] = np.where(same, beyond[which], middle)
            other[which] = np.where(same, other[which], found)

    def _advance(self, rays: Rays) -> Rays:
        """Advance every ray to its next change of tissue; returns the rays that continue."""
        acquisition, group = self.acquisition, self.tissues["group"]
        decay = self.decay[np.where(rays.strong == _UNDER, rays.front, rays.label)]
        reserve = log(rays.weight / acquisition["intensity_threshold"]) + rays.log_attenuation - rays.spent
        to_silence = rays.since + np.maximum(reserve, f32(0)) / np.maximum(decay, f32(1e-9))
        longest = np.minimum(np.minimum(rays.to_depth, to_silence), rays.to_piece)
        rays.inside, border, other = self._next_border(rays, np.minimum(rays.leave, longest))
        until = np.where(border < 0, longest, border)
        spent_until = rays.spent + decay * (until - rays.since)
        ends = (border < 0) | (group[other] != group[rays.label])
        lost = (decay - self.decay[other]) * (until - rays.since)
        gives = self._give_back(rays, ~ends, lost, rays.path + until)
        written = self._write_segments(rays, decay, until, spent_until, ends, gives)

        on = rays.of(~ends)
        on.since = until[~ends]
        on.spent, on.label, on.inside = spent_until[~ends], other[~ends], border[~ends]
        on.decay_before = decay[~ends]
        met = ends & (border >= 0)
        rays.spent = spent_until
        branches = self._branch(rays.of(met), border[met], other[met], written[met])
        left = ends & (border < 0) & (rays.piece >= 0)
        goes_dark = (rays.strong == _THROUGH) & (to_silence < rays.to_depth) & (longest != rays.to_piece)
        ended = rays.of(left), until[left], goes_dark[left]
        return Rays.joined([on, *branches, *self._next_pieces(*ended)])

    def _next_pieces(self, rays: Rays, until: np.ndarray, goes_dark: np.ndarray) -> list[Rays]:
        """End the pieces of rays that met no more border; returns those that go on, at the next piece or below."""
        path, depth = rays.path + until, rays.depth + until * rays.depth_per_mm
        lost = (self.decay[self._front(rays)] - rays.decay_before) * (until - rays.since)
        self._give_back(rays, np.ones(len(rays), bool), lost, rays.path + rays.since)
        rays.excess, rays.taken = self._excess(rays, until), self._taken(rays, until)
        more = rays.excess + self._taken_from_rays(rays)
        by = self._correction(rays, path, depth, rays.log_attenuation - rays.spent, rays.depth_per_mm, more)
        self._keep_correction(rays, by)
        deeper, louder, less = self._corrections_at(rays, path, by)
        rays.depth, rays.log_attenuation = depth + deeper, rays.log_attenuation - rays.spent + louder
        rays.path, rays.loss, rays.taken = path, rays.loss + rays.spent + less, rays.taken + less

        below = rays.of(goes_dark)  # the beam may go on behind this tissue
        below.axis = below.axis + until[goes_dark][:, None] * below.direction
        below.tube = _tube_after(below.tube, until[goes_dark])
        below.strong[:], below.weight = _UNDER, below.front_weight
        below.log_attenuation, below.loss = below.log_attenuation + below.excess, below.loss - below.excess
        below.excess, below.since_path, below.blind_until = 0.0 * below.excess, below.path, below.path
        below.given_from = below.path

        on = rays.of((until == rays.to_piece) & ~goes_dark)
        on = self._start_pieces(on, on.piece + 1)
        on = on.of((on.piece >= 0) | (on.strong == _NOT_STRONG))
        return [self._begin(below), self._begin(on)]

    def _excess(self, rays: Rays, until: np.ndarray) -> np.ndarray:
        """The nepers by which strong tissue has attenuated more, at lengths of the nodes."""
        more = rays.spent - until * self.decay[self._front(rays)]
        return np.where(rays.strong == _THROUGH, rays.excess + more, rays.excess)

    def _taken(self, rays: Rays, until: np.ndarray) -> np.ndarray:
        """The nepers that soft tissue has taken, at lengths of the nodes."""
        own = np.where(rays.strong == _THROUGH, until * self.decay[self._front(rays)], rays.spent)
        return rays.taken + own

    def _write_segments(self, rays: Rays, decay, until, spent_until, ends, gives) -> np.ndarray:
        """Write the segments of the axis rays; returns the index of each ray's last segment (-1: none)."""
        earlier = rays.since - rays.open
        with np.errstate(divide="ignore", invalid="ignore"):
            mean_decay = np.where(earlier > 0, (rays.spent - rays.spent_open) / earlier, decay)
        on_axis = (rays.ray == 0) & (rays.strong != _UNDER)
        closes = on_axis & (np.abs(decay - mean_decay) * np.minimum(earlier, until - rays.since) > f32(0.02))
        self._segment_of(rays, closes, rays.open, rays.since, rays.spent_open, rays.spent)
        rays.open = np.where(closes, rays.since, rays.open)
        rays.spent_open = np.where(closes, rays.spent, rays.spent_open)
        last = on_axis & (ends | gives) & (until > rays.open)
        self._segment_of(rays, last, rays.open, until, rays.spent_open, spent_until)
        written = np.full(len(rays), -1)
        written[last] = np.arange(last.sum())  # in the last written block
        rays.open = np.where(last, until, rays.open)
        rays.spent_open = np.where(last, spent_until, rays.spent_open)
        return written

    def _segment_of(self, rays: Rays, which, begin, end, spent_begin, spent_end) -> None:
        some, begin, end = rays.of(which), begin[which], end[which]
        spent_begin, spent_end = spent_begin[which], spent_end[which]
        segment = np.zeros(len(some), SEGMENT)
        segment["start"] = some.axis + begin[:, None] * some.direction
        segment["direction"], segment["lateral"] = some.direction, some.lateral
        segment["elevational"], segment["tube"] = some.elevational, _tube_after(some.tube, begin)
        segment["path_mm"], segment["length_mm"] = some.path + begin, end - begin
        segment["depth_mm"] = some.depth + begin * some.depth_per_mm
        segment["depth_per_mm"], segment["weight"] = some.depth_per_mm, some.weight
        segment["attenuation"] = exp(some.log_attenuation - spent_begin)
        segment["decay_per_mm"] = segment["loss_per_mm"] = (spent_end - spent_begin) / (end - begin)
        segment["loss"] = some.loss + spent_begin
        segment["reflections"], segment["label"] = some.reflections, some.label
        self._segments.append(segment)
        self._segment_pieces.append(self._piece_keys(some))
        self._segment_lines.append(some.line)

    def _branch(self, rays: Rays, border, other, written) -> list[Rays]:
        """Write the hits at the borders; returns the reflected and the refracted children."""
        acquisition, tissues = self.acquisition, self.tissues
        before, behind = tissues["group"][rays.label], tissues["group"][other]
        normal, overshoot, curvature = self._normals(rays, border, before, behind)
        continued = (rays.piece > 0) & (rays.since == 0)
        overshoot = np.minimum(overshoot, border - rays.since + np.where(continued, self.voxel_mm, f32(0)))
        beyond = border.copy()
        self._bisect(rays, np.flatnonzero(overshoot == 0), 3, rays.inside, beyond, other)
        back = np.where(overshoot == 0, border - beyond, overshoot)
        border = border - back
        rays.spent = rays.spent - back * self.decay[np.where(rays.strong == _UNDER, rays.front, rays.label)]
        shortened = written >= 0
        lengths = self._segments[-1]["length_mm"]
        lengths[written[shortened]] = np.maximum(lengths[written[shortened]] - back[shortened], f32(0))
        keep = rays.depth + border * rays.depth_per_mm < acquisition["traced_mm"]
        seen = self.seen
        strong_border = ~(is_soft(seen[rays.label], seen[other]) & bool(acquisition["aperture_beams"]))
        front = seen[self._front(rays)]
        strong = np.where(rays.strong == _NOT_STRONG, strong_border, ~is_soft(front, seen[other]))
        under, beam = rays.strong == _UNDER, rays.piece >= 0
        bent = ~under & strong & ~(beam & ~bends(front, seen[other]))
        path, depth = rays.path + border, rays.depth + border * rays.depth_per_mm
        lost = (self.decay[rays.label] - self.decay[other]) * (border - rays.since)
        self._give_back(rays, ~strong_border, lost, path)
        rays.excess, rays.taken = self._excess(rays, border), self._taken(rays, border)
        leaves, next_shade, end_shade = ~keep, self._next_shade(rays), self._shade_behind(rays)
        behind_rate = acquisition["reference_speed_m_s"] / tissues["speed_of_sound_m_s"][other]
        rate = np.where(bent | under | leaves, rays.depth_per_mm, behind_rate)
        more = rays.excess + np.where(leaves, f32(0), rays.shade - next_shade)
        by = self._correction(rays, path, depth, rays.log_attenuation - rays.spent, rate, more)
        most = np.where(bent, _MOST_BEFORE_STRONG / acquisition["screen_step"], f32(np.inf))[:, None]
        by[:, 1:3] = np.clip(by[:, 1:3], -most, most)
        corrected = np.stack(self._corrections_at(rays, path, by), -1)
        # A beam ends where it is bent, and where it leaves the field; below strong tissue it begins again.
        ends = np.flatnonzero(beam & (leaves | bent | ((rays.strong != _NOT_STRONG) & ~strong)))
        self._keep_correction(rays.of(ends), by[ends])
        rays.depth[ends] += corrected[ends, 0]
        rays.log_attenuation[ends] += corrected[ends, 1]
        rays.loss[ends] += corrected[ends, 2]
        corrected[ends] = 0.0
        settled = np.isin(np.arange(len(rays)), ends)  # what is written here is corrected
        below = rays.of(keep)  # where the beam goes on below strong tissue
        ended = rays.of(bent)
        ended.piece[:], ended.strong[:] = -1, _NOT_STRONG
        for name, values in vars(ended).items():
            vars(rays)[name][bent] = values
        under, beam, bent, strong = under[keep], beam[keep], bent[keep], strong[keep]
        strong_border, corrected, end_shade = strong_border[keep], corrected[keep], end_shade[keep]
        settled = settled[keep]
        rays, border, other, normal, overshoot = rays.of(keep), border[keep], other[keep], normal[keep], overshoot[keep]
        before, behind, curvature = before[keep], behind[keep], curvature[keep]

        path, depth = rays.path + border, rays.depth + border * rays.depth_per_mm
        log_attenuation = rays.log_attenuation - rays.spent
        rays.loss = rays.loss + rays.spent
        attenuation = exp(log_attenuation)
        aside = (rays.quantile * self.elevation_sigma(path))[:, None] * rays.elevational
        point = rays.axis + border[:, None] * rays.direction + aside
        tube = _tube_after(rays.tube, border)
        cos_in = np.clip(-dot(rays.direction, normal), f32(0.01), f32(1))
        ratio = tissues["speed_of_sound_m_s"][other] / tissues["speed_of_sound_m_s"][rays.label]
        sin2_out = ratio * ratio * (f32(1) - cos_in * cos_in)
        is_total = sin2_out >= 1
        cos_out = np.sqrt(np.maximum(f32(0), f32(1) - sin2_out))
        z_in, z_out = tissues["impedance_mrayl"][rays.label] * cos_out, tissues["impedance_mrayl"][other] * cos_in
        pressure = np.where(is_total, f32(1), (z_out - z_in) / (z_out + z_in))
        reflectance = pressure * pressure
        self._write_hits(
            rays, other, point, normal, path, depth, attenuation, cos_in, pressure, tube, curvature, settled
        )

        reflected_weight, refracted_weight = rays.weight * reflectance, rays.weight * (f32(1) - reflectance)
        reflects = np.flatnonzero(
            (rays.reflections < acquisition["max_ray_depth"])
            & (reflected_weight >= acquisition["reflection_threshold"])
            & (reflected_weight * attenuation >= acquisition["intensity_threshold"])
            & strong_border
            & ~under
        )
        refracts = np.flatnonzero(
            ~is_total & bent & (refracted_weight * attenuation >= acquisition["intensity_threshold"])
        )
        child = rays.of(reflects)
        if acquisition["reflection_spreading"]:
            spread = (tube[reflects], child, point[reflects], normal[reflects], before[reflects], behind[reflects])
            child.tube = self._tube_reflected(*spread)
        n = normal[reflects]
        child.direction = unit(_mirror(child.direction, n))
        child.lateral, child.elevational = _mirror(child.lateral, n), _mirror(child.elevational, n)
        child.axis = point[reflects] - _mirror(aside[reflects], n)
        child.weight, child.blind_until = reflected_weight[reflects], path[reflects] + self.voxel_mm
        child.reflections = child.reflections + 1
        child.path, child.depth = path[reflects], depth[reflects] + corrected[reflects, 0]
        child.log_attenuation = log_attenuation[reflects] + corrected[reflects, 1]
        child.loss = child.loss + corrected[reflects, 2]
        child.piece[:], child.strong[:] = -1, _NOT_STRONG

        bent_rays = rays.of(refracts)
        path_of_all = path
        n, ratio, path = normal[refracts], ratio[refracts], path[refracts]
        towards = unit(
            ratio[:, None] * bent_rays.direction + (ratio * cos_in[refracts] - cos_out[refracts])[:, None] * n
        )
        bent_rays.lateral = _carried(bent_rays.lateral, bent_rays.direction, towards)
        bent_rays.elevational = _carried(bent_rays.elevational, bent_rays.direction, towards)
        bent_rays.direction = towards
        bent_rays.axis = (
            point[refracts] - (bent_rays.quantile * self.elevation_sigma(path))[:, None] * bent_rays.elevational
        )
        bent_rays.tube, bent_rays.path, bent_rays.depth = tube[refracts], path, depth[refracts]
        bent_rays.log_attenuation, bent_rays.weight = log_attenuation[refracts], refracted_weight[refracts]
        bent_rays.label = other[refracts]
        over = overshoot[refracts]
        bent_rays.blind_until = np.where(over > 0, path + over + f32(0.5) * self.voxel_mm, path)

        z_in, z_out = (tissues["impedance_mrayl"][label] for label in (rays.label, other))
        lost = np.where(under, f32(0), rays.weight * ((z_out - z_in) / (z_out + z_in)) ** 2)
        blind_until = np.where(overshoot > 0, path_of_all + overshoot + f32(0.5) * self.voxel_mm, path_of_all)
        goes_below = np.flatnonzero(bent & beam)
        below = below.of(goes_below)
        new = below.strong == _NOT_STRONG
        below.front, below.front_weight = self._front(below), np.where(new, below.weight, below.front_weight)
        below.weight, below.log_attenuation = below.front_weight, log_attenuation[goes_below] + below.excess
        below.loss, below.since_path = rays.loss[goes_below] - below.excess, path_of_all[goes_below]
        below.strong[:], below.excess = _UNDER, 0.0 * below.excess
        below.given_from = below.since_path

        ahead = np.flatnonzero(~bent)
        on = rays.of(ahead)
        enters = strong[ahead] & (on.strong == _NOT_STRONG)
        on.front, on.front_weight = np.where(enters, on.label, on.front), np.where(enters, on.weight, on.front_weight)
        on.strong = np.where(enters, _THROUGH, on.strong)
        on.weight, on.log_attenuation = on.weight - lost[ahead], log_attenuation[ahead]
        on.decay_before = self.decay[np.where(under[ahead], on.front, on.label)]
        for course, some in ((on, ahead), (below, goes_below)):
            course.axis, course.tube, course.path = point[some] - aside[some], tube[some], path_of_all[some]
            course.depth, course.label, course.blind_until = depth[some], other[some], blind_until[some]
        below = below.of(~self._are_dark(below))
        return [
            self._begin(child),
            self._begin(bent_rays),
            self._begin(below),
            self._begin(self._left(on, strong[ahead], end_shade[ahead])),
        ]

    def _left(self, rays: Rays, strong: np.ndarray, end_shade: np.ndarray) -> Rays:
        """Rays behind borders, without the dark ones: those out of strong tissue have again the level of their beam."""
        out = ~strong & (rays.strong != _NOT_STRONG)
        taken = end_shade - rays.shade
        kept = np.clip(taken, np.minimum(rays.excess, f32(0)), np.clip(rays.excess, f32(0), f32(_MOST_LOSS)))
        rays.log_attenuation = np.where(out, rays.log_attenuation + rays.excess - taken, rays.log_attenuation)
        rays.loss = np.where(out, rays.loss - rays.excess + kept, rays.loss)
        rays.weight = np.where(out, rays.front_weight, rays.weight)
        rays.shade, rays.excess = np.where(out, end_shade, rays.shade), np.where(out, f32(0), rays.excess)
        rays.since_path = np.where(out, rays.path, rays.since_path)
        rays.given_from = np.where(out, rays.path, rays.given_from)
        rays.course, rays.strong = rays.course + out, np.where(out, _NOT_STRONG, rays.strong)
        return rays.of(~(out & self._are_dark(rays)))

    def _normals(self, rays: Rays, border, before, behind) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(unit normals in RAS against the rays, lengths that the rays are beyond the border, curvatures in 1/mm)."""
        towards, overshoot, curvature = self.labels.borders(self._place(rays, border), before, behind, self.soft)
        across = -dot(rays.step, towards)
        with np.errstate(divide="ignore", invalid="ignore"):
            overshoot = np.where(across * self.voxel_mm > f32(0.2), overshoot / across, f32(0))
        normal = border_normals(self.to_voxel, towards)
        normal = np.where((dot(normal, rays.direction) > 0)[:, None], -normal, normal)
        nowhere = dot(normal, normal) == 0
        return np.where(nowhere[:, None], -rays.direction, normal), overshoot, curvature / self.voxel_mm

    def _tube_reflected(self, tube, rays: Rays, point, normal, before, behind) -> np.ndarray:
        tube = tube.copy()
        towards_ray = np.minimum(dot(normal, rays.direction), f32(-0.2))
        for width, offset in ((0, rays.lateral), (2, rays.elevational)):
            along = offset - (dot(normal, offset) / towards_ray)[:, None] * rays.direction
            longer = np.maximum(length(along), f32(1e-3))
            tangent = along / longer[:, None]
            curvature = np.full(len(point), np.inf, np.float32)
            for reach in f32([-_CURVATURE_REACH, _CURVATURE_REACH]) * self.voxel_mm:
                place = affine_point(self.to_voxel, point + reach * tangent)
                turned = border_normals(self.to_voxel, self.labels.borders(place, before, behind, self.soft)[0])
                curvature = np.minimum(curvature, dot(turned - normal, tangent) / reach)
            curvature = np.maximum(curvature, f32(0)) * ramp(0.004, 0.008, curvature * self.voxel_mm)
            tube[:, width + 1] += f32(2) * curvature * longer * tube[:, width]
        return tube

    def _write_hits(
        self, rays, other, point, normal, path, depth, attenuation, cos_in, pressure, tube, curvature, settled
    ) -> None:
        acquisition, beside = self.acquisition, (rays.ray > 0) & (rays.strong != _UNDER)
        count = acquisition["elevational_rays"].astype(np.float32)
        towards_ray = np.minimum(dot(normal, rays.direction), f32(-0.05))
        coherence = np.ones(len(rays), np.float32)
        if acquisition["membrane_reach"] >= 0:
            fluid, rough = self.tissues["is_fluid"], acquisition["membrane_phase"] * cos_in
            coherence = np.where(fluid[rays.label] != fluid[other], exp(f32(-0.5) * rough * rough), coherence)
        specular = exp2(np.maximum(acquisition["specular_exponent"] * log2(cos_in), f32(-100)))
        strength = pressure * pressure if acquisition["interface_is_energy"] else pressure
        hit = np.zeros(len(rays), HIT)
        hit["position"], hit["normal"], hit["path_mm"], hit["depth_mm"] = point, normal, path, depth
        hit["weight"], hit["attenuation"], hit["cos_incidence"] = rays.weight, attenuation, cos_in
        hit["loss"] = rays.loss
        hit["reflectance"], hit["reflections"] = pressure * pressure, rays.reflections
        hit["label_before"], hit["label_behind"] = rays.label, other
        for name, width, offset in (("lateral", 0, rays.lateral), ("elevational", 2, rays.elevational)):
            hit[f"{name}_slope"] = -rays.depth_per_mm * tube[:, width] * dot(normal, offset) / towards_ray
        hit["curvature"] = curvature
        hit["elevational_mm"] = rays.quantile * self.elevation_sigma(path)
        gain = acquisition["interface_gain"] / (count * tube[:, 0] * tube[:, 2])
        hit["echo"] = rays.weight * attenuation * strength * specular * gain * coherence
        self._hits.append(hit[beside])
        self._hit_pieces.append(np.where(settled, -1, self._piece_keys(rays))[beside])
        self._hit_lines.append(rays.line[beside])


def _corrected_length(path: np.ndarray, since: np.ndarray) -> np.ndarray:
    """Lengths over which rays are corrected: none where strong tissue ends a little beyond its piece."""
    return np.maximum(path - since, f32(0))


def _tube_after(tube: np.ndarray, along: np.ndarray) -> np.ndarray:
    after = tube.copy()
    after[:, 0] += tube[:, 1] * along
    after[:, 2] += tube[:, 3] * along
    return after


def _mirror(v: np.ndarray, normal: np.ndarray) -> np.ndarray:
    return v - (f32(2) * dot(v, normal))[:, None] * normal


def _carried(v: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    return v - (dot(v, end) / (f32(1) + dot(start, end)))[:, None] * (start + end)
