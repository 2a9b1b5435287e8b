"""Tables of side lobes by depth and distance, from Fresnel's integrals (imaging/diffraction.py has a transform)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import integrate, special

from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.verification.numpy_model.beam import Beam

_ROWS, _COLUMNS = 33, 33  # depths and distances
_WAVELENGTH = 1.54  # mm at 1 MHz


@dataclass(frozen=True)
class Table:
    """Square roots of the power per distance, by (depth, distance re the last column's)."""

    depth_mm: float
    values: np.ndarray
    #: (depths,) distance of the last column
    ends: np.ndarray

    def _place(self, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        place = np.clip(along / self.depth_mm, 0.0, 1.0) * (_ROWS - 1)
        row = np.minimum(place.astype(int), _ROWS - 2)
        return row, place - row

    def end(self, along: np.ndarray) -> np.ndarray:
        """The distance of the last column at path lengths."""
        row, deeper = self._place(along)
        return self.ends[row] + deeper * (self.ends[row + 1] - self.ends[row])

    def at(self, along: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """The value at path lengths and distances from the axis; 0 beyond the last column."""
        row, deeper = self._place(along)
        place = distance / self.end(along) * (_COLUMNS - 1)
        column = np.minimum(place.astype(int), _COLUMNS - 2)
        share = place - column

        def within(which: np.ndarray) -> np.ndarray:
            return (1.0 - share) * self.values[which, column] + share * self.values[which, column + 1]

        return np.where(place < _COLUMNS - 1, (1.0 - deeper) * within(row) + deeper * within(row + 1), 0.0)


def lateral_table(acquisition: np.ndarray, probe: Probe) -> Table:
    """The lateral lobes, with the clutter, by distance in wavelengths x receive f-number."""
    beam, rows, half = Beam(acquisition), [], 0.5 * probe.receive_apodization
    farthest = 0.75 * (_COLUMNS - 1)
    clutter = np.exp(probe.clutter_db * np.log(10.0) / 10.0)
    for depth in _depths(probe):
        unit = _wavelength(probe) * max(probe.receive_f_number, depth / probe.aperture_mm)
        x, transmitted = _uniform(probe, probe.aperture_mm, probe.focus_mm, depth)
        u = x / unit
        received = (1.0 - half) * np.sinc(u) + 0.5 * half * (np.sinc(u - 1.0) + np.sinc(u + 1.0))
        beyond = _Beyond.of(u, transmitted**2 * received**2, float(beam.lateral_sigma(depth)) / unit)
        density = beyond.averaged(np.linspace(0.0, farthest, _COLUMNS), 1.0)
        rows.append(np.sqrt(density + 0.5 * clutter / farthest))
    return Table(probe.depth_mm, np.array(rows), np.full(_ROWS, farthest))


def elevational_table(acquisition: np.ndarray, probe: Probe) -> Table:
    """The elevational lobes by distance in millimetres."""
    beam, rows, ends = Beam(acquisition), [], []
    for depth in _depths(probe):
        lobe = _wavelength(probe) * depth / probe.elevation_aperture_mm
        end = max(5.0 * lobe, 26.0 * _wavelength(probe))
        x, amplitude = _uniform(probe, probe.elevation_aperture_mm, probe.elevation_focus_mm, depth)
        beyond = _Beyond.of(x, amplitude**4, float(beam.elevation_sigma(depth)))
        rows.append(np.sqrt(beyond.averaged(np.linspace(0.0, end, _COLUMNS), end / (_COLUMNS - 1))))
        ends.append(end)
    return Table(probe.depth_mm, np.array(rows), np.array(ends))


def _depths(probe: Probe) -> np.ndarray:
    depths = np.linspace(0.0, probe.depth_mm, _ROWS)
    depths[0] = 0.5 * depths[1]
    return depths


def _wavelength(probe: Probe) -> float:
    return _WAVELENGTH / probe.frequency_mhz


def _uniform(probe: Probe, aperture: float, focus: float, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """(distances from the axis, amplitude there) of the field of a uniform aperture with one focus."""
    wavelength = _wavelength(probe)
    x = np.linspace(0.0, 256.0 * wavelength * depth / aperture, 16385)
    bend = (1.0 / depth - 1.0 / focus) / wavelength
    if abs(bend) * aperture**2 < 1e-4:
        return x, np.abs(np.sinc(x * aperture / (wavelength * depth)))
    # exp(i pi (bend p^2 - 2 p x / (wavelength depth))) over points p is Fresnel's integral about a shifted centre.
    centre, scale = x / (wavelength * depth * bend), np.sqrt(2.0 * abs(bend))
    ends = [special.fresnel(scale * (side * aperture - centre)) for side in (-0.5, 0.5)]
    return x, np.hypot(ends[1][0] - ends[0][0], ends[1][1] - ends[0][1])


@dataclass(frozen=True)
class _Beyond:
    """The power of a pattern beyond each distance less that of the main beam; as at `nearest` there and nearer."""

    x: np.ndarray
    power: np.ndarray
    nearest: float

    @classmethod
    def of(cls, x: np.ndarray, pattern: np.ndarray, sigma: float) -> _Beyond:
        within = integrate.cumulative_trapezoid(pattern, x, initial=0.0)
        more = np.maximum(1.0 - within / within[-1] - special.erfc(x / sigma), 0.0)
        return cls(x, np.maximum.accumulate(more[::-1])[::-1], 2.0 * sigma)

    def at(self, distance: np.ndarray | float) -> np.ndarray:
        return np.interp(np.maximum(distance, self.nearest), self.x, self.power)

    def averaged(self, at: np.ndarray, window: float) -> np.ndarray:
        """The power per distance on either side, averaged over a window."""
        return (self.at(np.maximum(at - 0.5 * window, 0.0)) - self.at(at + 0.5 * window)) / (2.0 * window)
