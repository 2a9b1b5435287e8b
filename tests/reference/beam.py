"""Widths of the beam by a record of layout.ACQUISITION (docs/physics.md#4-beam-and-pulse)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, special

from SlicerUSSim.Logic.probe.lens import LensBeam


class Beam:
    """The beam of one frame. Path lengths are millimetres, frequencies relative to that of the transmitted pulse."""

    def __init__(self, record: np.ndarray) -> None:
        names = [name for name in record.dtype.names or () if record.dtype[name].base != np.uint32]
        #: The fields as Python floats or arrays of them
        self.of = {name: record[name].astype(float)[()] for name in names}

    def frequency_after(self, loss: np.ndarray) -> np.ndarray:
        """The mean of the band's power after a loss in nepers both ways.

        Of a Gaussian about 1 - w loss with the amplitude's variance w, from zero frequency on.
        """
        shift = self.of["downshift"]
        if shift == 0.0:
            return np.ones_like(loss)
        centre = 1.0 - shift * np.maximum(loss, 0.0)
        # exp(-z^2) / erfc(-z) = 1 / erfcx(-z)
        mean = centre + np.sqrt(shift / np.pi) / special.erfcx(np.minimum(-centre / np.sqrt(shift), 1e4))
        return np.maximum(mean, 0.2)

    def gain_of_band(self, loss: np.ndarray) -> np.ndarray:
        """The logarithm of the amplitude by which an echo exceeds that of its centre frequency."""
        shift = self.of["downshift"]
        if shift == 0.0:
            return np.zeros_like(loss)
        z, lost = (1.0 - shift * loss) / np.sqrt(shift), np.maximum(loss, 0.0)
        parts = special.log_ndtr(np.sqrt(2.0) * z) - special.log_ndtr(np.sqrt(2.0 / shift))
        return 0.5 * (shift * lost**2 + parts)

    def elevation(
        self, lens: LensBeam, s: np.ndarray, height: np.ndarray, frequency: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(root of the power per mm, cycles behind the axis) of the two-way beam at `height` from the axis."""
        away = (s - self.of["elevation_focus"]) / self.of["elevation_rayleigh"]
        wider = np.hypot(1.0 / frequency, away) / np.hypot(1.0, away)
        rows, columns, _ = lens.main.shape
        place = np.clip(s / self.of["depth_mm"], 0.0, 1.0) * (rows - 1.0)
        aside = np.minimum(np.abs(height) / wider / lens.main_mm.max() * (columns - 1.0), columns - 1.0)
        root, cycles = (
            ndimage.map_coordinates(lens.main[..., n].astype(float), [place, aside], order=1, mode="nearest")
            for n in range(2)
        )
        return root / np.sqrt(wider), cycles * frequency * bool(self.of["wavefront_curvature"])

    def _one_way(self, s: np.ndarray, frequency: np.ndarray | float, cosine: float) -> tuple[np.ndarray, np.ndarray]:
        """Variances of the lateral transmit and receive beams of a line with this cosine."""
        of, zones = self.of, int(self.of["transmit_zones"])
        if zones == 0:
            transmit = np.maximum(s * of["transmit_sigma_slope"], of["transmit_sigma"][0]) / frequency
        else:
            transmit = np.min([
                sigma * np.hypot(1.0 / frequency, (s - focus) / length * cosine**2)
                for sigma, focus, length in zip(
                    *(of[f"transmit_{name}"][:zones] for name in ("sigma", "focus", "rayleigh")), strict=True
                )
            ], axis=0)  # fmt: skip
        receive = np.maximum(s * of["receive_sigma_slope"], of["receive_sigma_min"]) / frequency
        return (transmit / cosine) ** 2, (receive / cosine) ** 2

    def lateral_sigma(self, s: np.ndarray, frequency: np.ndarray | float, cosine: float) -> np.ndarray:
        transmit2, receive2 = self._one_way(s, frequency, cosine)
        return np.sqrt(transmit2 * receive2 / (transmit2 + receive2))

    def lateral_curvature(self, s: np.ndarray, frequency: np.ndarray | float, cosine: float) -> np.ndarray:
        """Radians per squared millimetre by which the phase of the two-way beam is bent."""
        transmit2, receive2 = self._one_way(s, frequency, cosine)
        return np.sqrt(np.maximum(self.of["wavefront_curvature"] * (receive2**-2.0 - transmit2**-2.0), 0.0))

    def mirrored_power(self, s: np.ndarray, tube: np.ndarray, along: np.ndarray, cosine: float) -> np.ndarray:
        """What curved mirrors leave of the power of speckle; `tube` as in SEGMENT, `along` from where it is."""
        wide, growth = np.maximum(tube[::2, None] + tube[1::2, None] * along - 1.0, 0.0), tube[1::2]
        behind = [w / max(g, 1e-9) for w, g in zip(wide, growth, strict=True)]  # the mirror

        def squared(axis: int, away: np.ndarray | float, length: np.ndarray | float) -> np.ndarray:
            turned = away + wide[axis] * (away - behind[axis])
            return (1.0 + wide[axis]) ** 2 + (turned / length) ** 2

        of, zones, per_mm2 = self.of, int(self.of["transmit_zones"]), np.pi * self.of["cycles_per_mm"]
        transmit2, receive2 = self._one_way(s, 1.0, cosine)
        if zones == 0:
            mirrored2 = transmit2 * squared(0, 0.0, per_mm2 * transmit2)
        else:
            sigma, focus, length = (of[f"transmit_{name}"][:zones, None] for name in ("sigma", "focus", "rayleigh"))
            sigma, length = sigma / cosine, length / cosine**2
            at = np.argmin(sigma * np.hypot(1.0, (s - focus) / length), axis=0)
            sigma, focus, length = (values[at, 0] for values in (sigma, focus, length))
            mirrored2 = sigma**2 * squared(0, s - focus, length)
        lateral = (transmit2 + receive2) / (mirrored2 + receive2 * squared(0, 0.0, per_mm2 * receive2))
        away, length = s - of["elevation_focus"], of["elevation_rayleigh"]
        return np.sqrt(lateral * (1.0 + (away / length) ** 2) / squared(1, away, length))

    def line_cosine(self, line: float) -> float:
        """Of the angle of a line to the normal of a flat face; `line` in scan lines from the first."""
        if not self.of["flat_face"]:
            return 1.0
        angle = self.of["first_line"] + self.of["line_spacing"] * line
        return float(self.of["steering_cos"] if self.of["linear"] else np.cos(angle))

    def line_distance(self, s: np.ndarray) -> np.ndarray:
        """Between neighbouring traced lines at path length s plus where they begin (line_start)."""
        step = self.of["line_spacing"] / self.of["lateral_rays"]
        return np.maximum(step * (1.0 if self.of["linear"] else self.of["apex_radius_mm"] + s) + 0.0 * s, 1e-4)

    def line_start(self, line: np.ndarray | float) -> np.ndarray:
        """Displayed depth at which lines leave the face; `line` in scan lines from the first."""
        position = self.of["first_line"] + self.of["line_spacing"] * line
        if not self.of["steered"]:
            return 0.0 * position
        if self.of["linear"]:
            return self.of["start_mm"] + position * self.of["steering_sin"] / self.of["steering_cos"]
        return self.of["apex_radius_mm"] * (1.0 / np.cos(position) - 1.0)
