"""Widths of the beam in float32 (kernels/common.clh)."""

from __future__ import annotations

import numpy as np
from scipy import special

from tests.reference.elementary import f32

_WHOLE = f32(1)
_LEAST_FREQUENCY = 0.2


class Beam:
    """Widths of the beam along the path (Probe.beam_sigma_mm)."""

    def __init__(self, acquisition: np.ndarray) -> None:
        self.acquisition = acquisition

    def frequency_after(self, loss: np.ndarray | np.float32) -> np.ndarray:
        """The mean of the band's power after a loss in nepers both ways, re the frequency of the transmitted pulse.

        Of a Gaussian about 1 - w loss with the amplitude's variance w, from zero frequency on.
        """
        shift = float(self.acquisition["downshift"])
        if shift == 0.0:
            return np.ones_like(loss)
        sigma, centre = np.sqrt(shift), 1.0 - shift * np.maximum(np.asarray(loss, float), 0.0)
        # exp(-z^2) / erfc(-z) = 1 / erfcx(-z)
        mean = centre + sigma / np.sqrt(np.pi) / special.erfcx(np.minimum(-centre / sigma, 1e4))
        return f32(np.maximum(mean, _LEAST_FREQUENCY))

    def gain_of_band(self, loss: np.ndarray) -> np.ndarray:
        """The logarithm of the amplitude by which an echo exceeds that of its centre frequency."""
        shift = float(self.acquisition["downshift"])
        if shift == 0.0:
            return np.zeros_like(loss)
        # Of the power: w loss^2 + log erfc(-z), where log erfc(-z) = log erfcx(-z) - z^2, and w loss^2 - z^2 is
        # 2 loss - 1 / w
        lost = np.maximum(np.asarray(loss, float), 0.0)
        z = (1.0 - shift * lost) / np.sqrt(shift)
        near = 0.5 * shift * lost**2 + 0.5 * np.log(special.erfc(-np.maximum(z, 0.0)))
        far = lost - 0.5 / shift + 0.5 * np.log(special.erfcx(-np.minimum(z, 0.0)))
        return f32(np.where(z >= 0.0, near, far) - 0.5 * np.log(special.erfc(-1.0 / np.sqrt(shift))))

    def elevation_sigma(self, s: np.ndarray, frequency: np.ndarray | np.float32 = _WHOLE) -> np.ndarray:
        b = (s - self.acquisition["elevation_focus"]) / self.acquisition["elevation_rayleigh"]
        return self.acquisition["elevation_sigma"] * np.sqrt(frequency ** f32(-2) + b * b)

    def elevational_cycles(self, s: np.ndarray, frequency: np.ndarray | np.float32) -> np.ndarray:
        """Cycles per squared millimetre by which the phase of the two-way elevational beam is behind off its axis."""
        heights = self.acquisition["speckle_height_mm"]
        at = np.clip(s / self.acquisition["depth_mm"], 0.0, 1.0)
        height = np.interp(at, np.linspace(0.0, 1.0, len(heights)), heights) / frequency
        if not heights.any():
            return np.zeros_like(s)
        sigma = self.elevation_sigma(s, frequency)
        return f32(np.sqrt(np.maximum(height**-2.0 - sigma**-2.0, 0.0)) / sigma / (4.0 * np.pi))

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

    def one_way(self, s: np.ndarray, frequency: np.ndarray | np.float32 = _WHOLE) -> tuple[np.ndarray, np.ndarray]:
        """Variances of the lateral transmit and receive beams."""
        acquisition, stretch = self.acquisition, f32(1) / frequency
        if acquisition["transmit_zones"] == 0:
            least = acquisition["transmit_sigma"][0]
            transmit2 = (stretch * np.maximum(s * acquisition["transmit_sigma_slope"], least)) ** 2
        else:
            transmit2 = self._zones(s, stretch).min(axis=0)
        receive = stretch * np.maximum(s * acquisition["receive_sigma_slope"], acquisition["receive_sigma_min"])
        return transmit2, receive * receive

    def lateral_sigma(self, s: np.ndarray, frequency: np.ndarray | np.float32 = _WHOLE) -> np.ndarray:
        transmit2, receive2 = self.one_way(s, frequency)
        return np.sqrt(transmit2 * receive2 / (transmit2 + receive2))

    def lateral_curvature(self, s: np.ndarray, frequency: np.ndarray | np.float32 = _WHOLE) -> np.ndarray:
        """Radians per squared millimetre by which the phase of the two-way beam is bent."""
        if not self.acquisition["wavefront_curvature"]:
            return np.zeros_like(s)
        transmit2, receive2 = self.one_way(s, frequency)
        share = self.acquisition["wavefront_curvature"]
        return np.sqrt(np.maximum(share * (receive2 ** f32(-2) - transmit2 ** f32(-2)), f32(0)))

    def line_distance(self, s: np.ndarray) -> np.ndarray:
        """Between neighbouring traced lines at path length s plus where they begin (line_start)."""
        step = self.acquisition["line_spacing"] / f32(self.acquisition["lateral_rays"])
        along = np.ones_like(s) if self.acquisition["linear"] else self.acquisition["apex_radius_mm"] + s
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

    def traced_start(self, line: np.ndarray) -> np.ndarray:
        """The same of traced lines."""
        scan_line = f32(line - int(self.acquisition["guard_lines"])) / f32(self.acquisition["lateral_rays"])
        return f32(self.line_start(scan_line))
