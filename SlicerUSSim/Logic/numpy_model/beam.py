"""Widths of the beam in float32 (kernels/common.clh)."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.numpy_model.elementary import f32


class Beam:
    """Widths of the beam along the path (Probe.beam_sigma_mm)."""

    def __init__(self, scene: np.ndarray) -> None:
        self.scene = scene

    def elevation_sigma(self, s: np.ndarray) -> np.ndarray:
        b = (s - self.scene["elevation_focus"]) / self.scene["elevation_rayleigh"]
        return self.scene["elevation_sigma"] * np.sqrt(f32(1) + b * b)

    def lateral_sigma(self, s: np.ndarray) -> np.ndarray:
        scene = self.scene
        a = (s - scene["transmit_focus"]) / scene["transmit_rayleigh"]
        transmit2 = scene["transmit_sigma"] * scene["transmit_sigma"] * (f32(1) + a * a)
        receive = np.maximum(s * scene["receive_sigma_slope"], scene["receive_sigma_min"])
        receive2 = receive * receive
        return np.sqrt(transmit2 * receive2 / (transmit2 + receive2))

    def line_distance(self, s: np.ndarray) -> np.ndarray:
        step = self.scene["line_spacing"] / f32(self.scene["lateral_rays"])
        along = np.ones_like(s) if self.scene["linear"] else self.scene["apex_radius_mm"] + s
        return np.maximum(step * along, f32(1e-4))
