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

    def lateral_sigma(self, s: np.ndarray, loss: np.ndarray | np.float32 = _NOTHING) -> np.ndarray:
        acquisition, stretch = self.acquisition, f32(1) / self.frequency_after(loss)
        a = (s - acquisition["transmit_focus"]) / acquisition["transmit_rayleigh"]
        transmit2 = acquisition["transmit_sigma"] * acquisition["transmit_sigma"] * (stretch * stretch + a * a)
        receive = stretch * np.maximum(s * acquisition["receive_sigma_slope"], acquisition["receive_sigma_min"])
        receive2 = receive * receive
        return np.sqrt(transmit2 * receive2 / (transmit2 + receive2))

    def line_distance(self, s: np.ndarray) -> np.ndarray:
        step = self.acquisition["line_spacing"] / f32(self.acquisition["lateral_rays"])
        along = np.ones_like(s) if self.acquisition["linear"] else self.acquisition["apex_radius_mm"] + s
        return np.maximum(step * along, f32(1e-4))
