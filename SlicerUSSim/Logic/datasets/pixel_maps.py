"""Maps on the image's pixels that follow from labels alone: attenuation, travel time and borders."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tissue.table import TissueTable

_STEP_MM = 0.5


def attenuation_and_time(
    labels: Volume, tissues: TissueTable, probe: Probe, grid: ImageGrid, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """((rows, columns) float32 dB one way at the received frequency, µs there and back), nan outside the imaged field.

    Along straight scan lines from the face, in steps of 0.5 mm: without refraction.
    """
    position, along = probe.line_positions(), np.arange(0.0, probe.displayed_mm, _STEP_MM)
    origin, direction = probe.line_at(position)
    matrix = (labels.ras_to_ijk @ pose).astype(np.float32)
    points = (origin[:, None] + along[:, None] * direction[:, None]).astype(np.float32)
    index = np.rint(points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.intp)[..., ::-1]
    inside = np.all((index >= 0) & (index < labels.array.shape), axis=-1)
    found = np.where(inside, labels.array[tuple(np.moveaxis(np.where(inside[..., None], index, 0), -1, 0))], 0)
    attenuation, slowness = np.zeros((2, 256), np.float32)
    for label, tissue in tissues.items():
        attenuation[label] = 0.1 * tissue.attenuation_db_cm_mhz * probe.received_mhz
        slowness[label] = 2e3 / tissue.speed_of_sound_m_s
    step = _STEP_MM * (along >= probe.line_starts_mm(position)[:, None])
    field, line, at = _nearest_steps(probe, grid, len(along))
    sums = (np.cumsum(values[found] * step, axis=1) for values in (attenuation, slowness))
    decibels, microseconds = (np.where(field, each[line, at], np.nan).astype(np.float32) for each in sums)
    return decibels, microseconds


@lru_cache(maxsize=4)
def _nearest_steps(probe: Probe, grid: ImageGrid, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(rows, columns) the imaged field, and the scan line and step nearest to a pixel."""
    (x, y), (dx, dy) = (grid.left_mm, grid.top_mm), grid.pixel_spacing_mm
    columns, rows = np.meshgrid(np.arange(grid.columns) + 0.5, np.arange(grid.rows) + 0.5)
    position, along = probe.line_through(x + dx * columns, y + dy * rows)
    line = np.rint((position - probe.first_line) / probe.line_spacing).astype(int)
    at = np.rint(np.nan_to_num(along) / _STEP_MM).astype(int)
    return grid.field(probe), np.clip(line, 0, probe.scan_lines - 1), np.clip(at, 0, steps - 1)


def walls(labels: np.ndarray, tissues: TissueTable, probe: Probe, grid: ImageGrid) -> np.ndarray:
    """(rows, columns) float32 largest amplitude reflection coefficient of the borders below and right of a pixel.

    `labels` are those of the image's pixels, (rows, columns); 0 outside the imaged field.
    """
    impedance = np.ones(256, np.float32)
    for label, tissue in tissues.items():
        impedance[label] = tissue.impedance_mrayl
    here, field = impedance[labels], grid.field(probe)
    found = np.zeros(labels.shape, np.float32)
    for axis in (0, 1):
        first, second = (np.moveaxis(here, axis, 0)[part] for part in (slice(-1), slice(1, None)))
        both = np.moveaxis(field, axis, 0)[:-1] & np.moveaxis(field, axis, 0)[1:]
        border = np.moveaxis(found, axis, 0)[:-1]
        np.maximum(border, np.where(both, abs(first - second) / (first + second), 0.0), out=border)
    return found
