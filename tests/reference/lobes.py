"""Tables of side lobes by depth and distance, from Fresnel's integrals (imaging/diffraction.py has a transform)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import integrate, special

from SlicerUSSim.Logic.probe.arrays import Probe
from tests.reference.acquisition import received_wavelength_mm
from tests.reference.beam import Beam
from tests.reference.elementary import f32

_ROWS, _COLUMNS = 33, 65  # depths and distances


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
    clutter = 0.0 if probe.clutter_db is None else np.exp(probe.clutter_db * np.log(10.0) / 10.0)
    distance = np.linspace(0.0, farthest, _COLUMNS)
    # cos^2 has the mean 1/2 from its peak to its zero.
    diffuse = clutter / farthest * np.cos(0.5 * np.pi * distance / farthest) ** 2
    fading = np.cos(0.5 * np.pi * np.maximum(4.0 * distance / farthest - 3.0, 0.0)) ** 2
    for depth in _depths(acquisition):
        unit = received_wavelength_mm(probe) * max(probe.receive_f_number, depth / probe.aperture_mm)
        x, transmitted = _transmitted(beam, probe, depth, unit)
        u = x / unit
        received = (1.0 - half) * np.sinc(u) + 0.5 * half * (np.sinc(u - 1.0) + np.sinc(u + 1.0))
        beyond = _Beyond.of(u, transmitted**2 * received**2, float(beam.lateral_sigma(depth)) / unit)
        apart = float(beam.line_distance(f32(depth))) * int(acquisition["lateral_rays"]) / unit
        node = apart * np.clip(int(1.0 / apart), -(-probe.scan_lines // 128), probe.scan_lines)
        # Of the main beam's power; lines of a node, interpolation of nodes; mean over a lobe, interpolation of columns
        widened = 0.5 * (float(beam.lateral_sigma(depth)) / unit) ** 2 + 0.188 * node**2 + 0.130
        faded = fading * beyond.averaged(distance, 1.0)
        rows.append(np.sqrt(_sharpened(faded, np.sqrt(widened) / farthest * (_COLUMNS - 1)) + diffuse))
    return Table(float(acquisition["depth_mm"]), np.array(rows), np.full(_ROWS, farthest))


def _sharpened(power: np.ndarray, width: float) -> np.ndarray:
    """What a Gaussian of `width` columns makes `power`, by three steps of Gold's deconvolution, 8 places per column.

    Up to its peak it stays as it is: the main beam is there.
    """
    place = np.arange(8 * (_COLUMNS - 1) + 1) / 8.0
    filled = power.copy()
    peak = int(power.argmax())
    filled[:peak] = power[peak]
    wanted = np.exp(np.interp(place, np.arange(_COLUMNS), np.log(filled + 1e-9)))
    # Both ends are mirrors, in which the first and the last place are once.
    images = [place - place[:, None], place + place[:, None], 2.0 * place[-1] - place - place[:, None]]
    once = [np.ones(len(place), bool), place > 0.0, place < place[-1]]
    terms = [np.exp(-0.5 * (image / width) ** 2) * counts for image, counts in zip(images, once, strict=True)]
    blur = np.sum(terms, axis=0)
    made = wanted
    for _ in range(3):
        made = made * wanted / (blur @ made / blur.sum(axis=1))
    return np.concatenate([power[: peak + 1], np.maximum(made[8 * (peak + 1) :: 8] - 1e-9, 0.0)])


def elevational_table(acquisition: np.ndarray, probe: Probe) -> Table:
    """The elevational lobes by distance in millimetres."""
    beam, rows, ends, wavelength = Beam(acquisition), [], [], received_wavelength_mm(probe)
    aperture, focus = probe.elevation_aperture_mm, probe.elevation_focus_mm
    for depth in _depths(acquisition):
        lobe = wavelength * depth / aperture
        end = max(5.0 * lobe, 26.0 * wavelength)
        x = _distances(lobe, aperture)
        received = _uniform(x, wavelength, aperture, focus, depth)
        sent = _uniform(x, 2.0 * wavelength, aperture, focus, depth) ** 2 if probe.harmonic else received
        beyond = _Beyond.of(x, (sent * received) ** 2, float(beam.elevation_sigma(depth)))
        rows.append(np.sqrt(beyond.averaged(np.linspace(0.0, end, _COLUMNS), end / (_COLUMNS - 1))))
        ends.append(end)
    return Table(float(acquisition["depth_mm"]), np.array(rows), np.array(ends))


def _depths(acquisition: np.ndarray) -> np.ndarray:
    depths = np.linspace(0.0, float(acquisition["depth_mm"]), _ROWS)
    depths[0] = 0.5 * depths[1]
    return depths


def _distances(lobe: float, aperture: float = 0.0) -> np.ndarray:
    """Distances from the axis, a sixty-fourth of a lobe apart; at least up to the aperture's size."""
    return np.linspace(0.0, max(256.0 * lobe, aperture), 16385)


def _transmitted(beam: Beam, probe: Probe, depth: float, unit: float) -> tuple[np.ndarray, np.ndarray]:
    """(distances from the axis, lateral amplitude there) of the pulse, or of the harmonic that its square feeds."""
    wavelength, focus = received_wavelength_mm(probe), beam.transmit_focus(depth)
    if probe.transmit == "angles":
        # In focus: the first zero of the pattern is a wavelength x f-number aside.
        lobe = float(np.sqrt(beam.one_way(f32(depth))[0])) * np.sqrt(8.0 * np.log(2.0)) / 1.21
        x = _distances(min(lobe, unit))
        return x, np.abs(np.sinc(x / lobe))
    aperture = probe.aperture_mm
    if probe.transmit == "zones":
        aperture = min(aperture, focus / probe.receive_f_number)
    x = _distances(wavelength * depth / aperture, aperture)
    if not probe.harmonic:
        return x, _uniform(x, wavelength, aperture, focus, depth)
    return x, _uniform(x, 2.0 * wavelength, aperture, focus, depth) ** 2


def _uniform(x: np.ndarray, wavelength: float, aperture: float, focus: float, depth: float) -> np.ndarray:
    """The amplitude of the field of a uniform aperture with one focus, at distances from the axis."""
    bend = (1.0 / depth - 1.0 / focus) / wavelength
    if abs(bend) * aperture**2 < 1e-4:
        return np.abs(np.sinc(x * aperture / (wavelength * depth)))
    # exp(i pi (bend p^2 - 2 p x / (wavelength depth))) over points p is Fresnel's integral about a shifted centre.
    centre, scale = x / (wavelength * depth * bend), np.sqrt(2.0 * abs(bend))
    ends = [special.fresnel(scale * (side * aperture - centre)) for side in (-0.5, 0.5)]
    return np.hypot(ends[1][0] - ends[0][0], ends[1][1] - ends[0][1])


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
