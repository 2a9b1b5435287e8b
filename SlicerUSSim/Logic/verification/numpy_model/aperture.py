"""Beams from an aperture in soft tissue (kernels/aperture.cl): the aperture as a phase screen."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from SlicerUSSim.Logic.verification.numpy_model.beam import Beam
from SlicerUSSim.Logic.verification.numpy_model.elementary import LN10_OVER_20, affine_point, affine_vector, f32
from SlicerUSSim.Logic.verification.numpy_model.labels import Labels

# Gauss-Hermite rule for the power of the elevational beam, in its standard deviations
_ROWS, _WEIGHTS = np.sqrt(1.5) * np.array([-1.0, 0.0, 1.0]), np.array([1.0, 4.0, 1.0]) / 6.0
_BLOCKED = 2.0  # nepers one way per millimetre of strong tissue beside the axis
_SOFT_SPEED, _SOFT_REFLECTION = 0.105, 0.12  # largest contrasts of a soft border


def is_soft(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether the borders between layout.TISSUE records are soft: speeds of sound and impedances are similar."""
    speeds = first["speed_of_sound_m_s"], second["speed_of_sound_m_s"]
    impedances = first["impedance_mrayl"], second["impedance_mrayl"]
    return (np.abs(speeds[0] - speeds[1]) <= f32(0.5 * _SOFT_SPEED) * (speeds[0] + speeds[1])) & (
        np.abs(impedances[0] - impedances[1]) <= f32(_SOFT_REFLECTION) * (impedances[0] + impedances[1])
    )


class Screens:
    """Beams of an acquisition; `run` gives what soft tissue does to them."""

    def __init__(self, acquisition: np.ndarray, labels: Labels, tissues: np.ndarray) -> None:
        self.acquisition, self.labels, self.tissues = acquisition, labels, tissues
        fields = {
            name: acquisition[name].item() for name in acquisition.dtype.names or () if acquisition[name].ndim == 0
        }
        self.fields = fields
        self.is_flat = bool(fields["linear"]) or fields["apex_radius_mm"] <= 0.0
        self.along = fields["fan_first"] + fields["fan_pitch"] * np.arange(fields["fan_points"])
        self.normal = 0.0 * self.along if self.is_flat else self.along / fields["apex_radius_mm"]
        bent = fields["apex_radius_mm"] * np.stack([np.sin(self.normal), np.cos(self.normal) - 1.0], -1)
        #: (points, 2) in the image plane
        self.points = np.stack([self.along, 0.0 * self.along], -1) if self.is_flat else bent

    def run(self) -> np.ndarray:
        """(screen lines, depths, 4) float32: nepers lost both ways, extra path and two deflections in mm."""
        fields = self.fields
        count, depths = fields["screen_lines"], fields["screen_depths"]
        if not fields["aperture_beams"]:
            return np.zeros((count, depths, 4), np.float32)
        sums = self._fans()
        traced = np.arange(count) * (fields["traced_lines"] - 1) / (count - 1) - fields["guard_lines"]
        position = fields["first_line"] + fields["line_spacing"] * traced / fields["lateral_rays"]
        paths = fields["screen_step"] * np.arange(1, depths + 1)
        screens = [[self._beam(sums, line, path) for path in paths] for line in position]
        return np.array(screens, np.float32)

    def _fans(self) -> np.ndarray:
        """(rows, points, angles, depths, 4) running sums: extra path, nepers, strong tissue, elevational deflection."""
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
        stored = np.zeros((fields["fan_depths"], 4, self.total.shape[1]), np.float32)
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
        return np.moveaxis(stored.reshape(-1, 4, *shape), (0, 1), (-2, -1))

    def _start_rays(self, count: int) -> None:
        """Rates per millimetre by label, and for every ray the tissue in which it is and its sums."""
        tissues, fields = self.tissues, self.fields
        speed = np.maximum(tissues["speed_of_sound_m_s"], f32(1))
        self.rates = f32([
            np.where(tissues["speed_of_sound_m_s"] > 0, fields["reference_speed_m_s"] / speed - 1.0, 0.0),
            tissues["attenuation_db_cm_mhz"] * fields["frequency_mhz"] * 0.2 * LN10_OVER_20,
        ])  # fmt: skip
        self.soft = is_soft(tissues[:, None], tissues[None])  # (label, label)
        self.current = np.full(count, -1)
        self.total = np.zeros((3, count), np.float32)
        self.lean = np.zeros(count, np.float32)

    def _look_up(self, at: np.ndarray, length: np.ndarray) -> None:
        """Add a length of every ray at its voxel position (n, 3)."""
        here, f = self.labels.cells(at)
        one_label, nearest = self.labels.one_label[here], self.labels.label[here].astype(int)
        mixed = np.flatnonzero(~one_label)
        nearest[mixed] = self.labels.label[here[mixed] + (f[mixed] > f32(0.5)) @ self.labels.steps]
        soft = (self.current < 0) | self.soft[self.current, nearest]
        self.current = np.where(soft, nearest, self.current)
        rate = self.rates[:, self.current]
        corners = self.labels.label[here[mixed][:, None] + self.labels.corner_steps].astype(int)
        current = self.current[mixed][:, None]
        corners = np.where(self.soft[current, corners], corners, current)
        rate[:, mixed] = (self.rates[:, corners] * self.labels.trilinear_weights(f[mixed])).sum(axis=-1)
        self.total[:2] += length * rate
        self.total[2] += length * ~soft

    def _sums_at(self, sums: np.ndarray, used: np.ndarray, target: np.ndarray) -> np.ndarray:
        """(4, rows, used points) sums on the straight lines to a point (2,), per length of its axis."""
        fields = self.fields
        towards = target - self.points[used]
        away = np.hypot(*towards.T)
        turned = np.arctan2(towards[:, 0], towards[:, 1]) - self.normal[used] - fields["fan_first_angle"]
        place = np.clip(turned / fields["fan_angle_step"], 0.0, fields["fan_angles"] - 1.001)
        far = np.clip(away / fields["fan_step"], 0.0, fields["fan_depths"] - 1.001)
        ray, depth = place.astype(int), far.astype(int)
        result = 0.0
        for next_ray, of_ray in ((0, 1.0 - place + ray), (1, place - ray)):
            for next_depth, of_depth in ((0, 1.0 - far + depth), (1, far - depth)):
                result += sums[:, used, ray + next_ray, depth + next_depth] * (of_ray * of_depth / away)[:, None]
        return np.moveaxis(result, -1, 0)

    def _beam(self, sums: np.ndarray, position: float, path: float) -> tuple[float, float, float, float]:
        """Nepers lost both ways, extra path, lateral and elevational deflection at one depth of one line."""
        fields = self.fields
        angle = 0.0 if fields["linear"] else position
        direction, across = np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])
        centre = position if fields["linear"] else fields["apex_radius_mm"] * position
        origin = [position, 0.0] if fields["linear"] else fields["apex_radius_mm"] * (direction - [0.0, 1.0])
        pitch, reach = fields["fan_pitch"], 0.5 * min(fields["aperture_mm"], path / fields["receive_f_number"])
        away = np.abs(self.along - centre)
        used = np.flatnonzero(away <= reach + 0.5 * pitch * (1.0 + 1e-6))
        open_ = np.clip((reach - away[used]) / pitch + 0.5, 0.0, 1.0)
        on_axis = np.maximum(1.0 - away[used] / pitch, 0.0)
        x = (self.points[used] - origin) @ across
        delay, loss, strong, lift = self._sums_at(sums, used, origin + path * direction) * path

        own = (on_axis * strong[1]).sum() / max(on_axis.sum(), 1e-6)
        passed = np.exp(-_BLOCKED * np.maximum(strong - 2.0 * own - fields["fan_step"], 0.0))
        power = _WEIGHTS[:, None] * (open_ * passed**2 + 1e-4 * on_axis)
        share = power / power.sum()
        mean_x, mean_delay = (share * x).sum(), (share * delay).sum()
        spread, common = (share * x**2).sum() - mean_x**2, (share * x * delay).sum() - mean_x * mean_delay
        slope = np.clip(common / (spread + 0.02 * pitch**2), -0.1, 0.1)
        row_lift = (power * lift).sum(axis=1) / power.sum(axis=1)
        rise = np.clip(row_lift[2] - row_lift[0], -0.1 * path, 0.1 * path)

        cycles = 0.5 * fields["cycles_per_mm"]
        focus = np.exp(1j * np.pi * cycles * (1.0 / path - 1.0 / fields["transmit_focus"]) * x**2)
        wave = open_ * passed * np.exp(2j * np.pi * cycles * (delay - mean_delay))
        power = _common_power(_WEIGHTS @ _intensity(each) for each in (wave, wave * focus))
        still = _common_power(_intensity(each) for each in (open_, open_ * focus))
        level = 0.5 * np.log(max(power / still, 1e-4))
        return (share * loss).sum() - level, mean_delay - slope * mean_x, slope * path, rise


def _intensity(wave: np.ndarray) -> np.ndarray:
    """Intensity (..., directions) across the beam of waves (..., points) from the aperture."""
    return np.abs(np.fft.fft(wave, 64)) ** 2  # more than twice the points, as its spectrum needs


def _common_power(intensities: Iterable[np.ndarray]) -> float:
    """The power of speckle for a transmitted and a received beam: the integral of the product of their intensities."""
    return float(np.prod(list(intensities), axis=0).sum())
