"""Widths of the beam in float32 (kernels/common.clh)."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.verification.numpy_model.elementary import f32


class Beam:
    """Widths of the beam along the path (Probe.beam_sigma_mm)."""

    def __init__(self, acquisition: np.ndarray) -> None:
        self.acquisition = acquisition

    def elevation_sigma(self, s: np.ndarray) -> np.ndarray:
        b = (s - self.acquisition["elevation_focus"]) / self.acquisition["elevation_rayleigh"]
        return self.acquisition["elevation_sigma"] * np.sqrt(f32(1) + b * b)

    def lateral_sigma(self, s: np.ndarray) -> np.ndarray:
        acquisition = self.acquisition
        a = (s - acquisition["transmit_focus"]) / acquisition["transmit_rayleigh"]
        transmit2 = acquisition["transmit_sigma"] * acquisition["transmit_sigma"] * (f32(1) + a * a)
        receive = np.maximum(s * acquisition["receive_sigma_slope"], acquisition["receive_sigma_min"])
        receive2 = receive * receive
        return np.sqrt(transmit2 * receive2 / (transmit2 + receive2))

    def line_distance(self, s: np.ndarray) -> np.ndarray:
        step = self.acquisition["line_spacing"] / f32(self.acquisition["lateral_rays"])
        along = np.ones_like(s) if self.acquisition["linear"] else self.acquisition["apex_radius_mm"] + s
        return np.maximum(step * along, f32(1e-4))
