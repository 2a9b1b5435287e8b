"""Widths of the beam in float32 (kernels/common.clh)."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.verification.numpy_model.elementary import f32

_NOTHING = f32(0)


class Beam:
    """Widths of the beam along the path (Probe.beam_sigma_mm)."""

    def __init__(self, acquisition: np.ndarray) -> None:
        self.acquisition = acquisition

    def frequency_after(self, loss: np.ndarray | np.float32) -> np.ndarray:
        """The centre frequency after a loss in nepers both ways, re that of the transmitted pulse."""
        return np.maximum(f32(1) - self.acquisition["downshift"] * np.maximum(loss, f32(0)), f32(0.5))

    def gain_of_band(self, loss: np.ndarray) -> np.ndarray:
        """The logarithm of the amplitude by which an echo exceeds that of its centre frequency."""
        shift = self.acquisition["downshift"]
        return f32(0.5) * shift * np.clip(loss, f32(0), f32(0.5) / np.maximum(shift, f32(1e-6))) ** 2

    def elevation_sigma(self, s: np.ndarray, loss: np.ndarray | np.float32 = _NOTHING) -> np.ndarray:
        b = (s - self.acquisition["elevation_focus"]) / self.acquisition["elevation_rayleigh"]
        return self.acquisition["elevation_sigma"] * np.sqrt(self.frequency_after(loss) ** f32(-2) + b * b)

    def transmit_focus(self, s: float) -> float:
        """The focus of the zone that is narrowest at path length s; s itself if every depth is in focus."""
        zones = int(self.acquisition["transmit_zones"])
        if zones == 0:
            return s
        return float(self.acquisition["transmit_focus"][int(self._zones(np.array(s), f32(1)).argmin(axis=0))])

    def _zones(self, s: np.ndarray, stretch: np.ndarray | np.float32) -> np.ndarray:
        """(zones, ...) variances of the transmit beam."""
        fields = [
            self.acquisition[f"transmit_{name}"][: self.acquisition["transmit_zones"]]
            for name in ("sigma", "focus", "rayleigh")
        ]
        return np.stack(
            [
                sigma * sigma * (stretch * stretch + ((s - focus) / length) ** 2)
                for sigma, focus, length in zip(*fields, strict=True)
            ]
        )

    def one_way(self, s: np.ndarray, loss: np.ndarray | np.float32 = _NOTHING) -> tuple[np.ndarray, np.ndarray]:
        """Variances of the lateral transmit and receive beams."""
        acquisition, stretch = self.acquisition, f32(1) / self.frequency_after(loss)
        if acquisition["transmit_zones"] == 0:
            least = acquisition["transmit_sigma"][0]
            transmit2 = (stretch * np.maximum(s * acquisition["transmit_sigma_slope"], least)) ** 2
        else:
            transmit2 = self._zones(s, stretch).min(axis=0)
        receive = stretch * np.maximum(s * acquisition["receive_sigma_slope"], acquisition["receive_sigma_min"])
        return transmit2, receive * receive

    def lateral_sigma(self, s: np.ndarray, loss: np.ndarray | np.float32 = _NOTHING) -> np.ndarray:
        transmit2, receive2 = self.one_way(s, loss)
        return np.sqrt(transmit2 * receive2 / (transmit2 + receive2))

    def lateral_curvature(self, s: np.ndarray, loss: np.ndarray | np.float32 = _NOTHING) -> np.ndarray:
        """Radians per squared millimetre by which the phase of the two-way beam is bent."""
        if not self.acquisition["wavefront_curvature"]:
            return np.zeros_like(s)
        transmit2, receive2 = self.one_way(s, loss)
        share = self.acquisition["wavefront_curvature"]
        return np.sqrt(np.maximum(share * (receive2 ** f32(-2) - transmit2 ** f32(-2)), f32(0)))

    def line_distance(self, s: np.ndarray) -> np.ndarray:
        step = self.acquisition["line_spacing"] / f32(self.acquisition["lateral_rays"])
        along = np.ones_like(s) if self.acquisition["linear"] else self.acquisition["spread_radius_mm"] + s
        return np.maximum(step * along, f32(1e-4))

    def line_start(self, line: np.ndarray | int) -> np.ndarray:
        """Displayed depth at which lines leave the face; `line` in scan lines from the first."""
        acquisition = self.acquisition
        position = acquisition["first_line"] + acquisition["line_spacing"] * f32(line)
        if not acquisition["steered"]:
            return f32(0) * position
        if acquisition["linear"]:
            return acquisition["start_mm"] + position * acquisition["steering_sin"] / acquisition["steering_cos"]
        return acquisition["apex_radius_mm"] * (f32(1) / np.cos(position) - f32(1))
