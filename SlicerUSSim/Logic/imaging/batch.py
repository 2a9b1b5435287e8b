"""Many images as arrays: what UltrasoundSimulator.simulate_batch downloads or computes on the host."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from numbers import Integral
from typing import Any

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.declaration import short
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.quality import line_shape
from SlicerUSSim.Logic.imaging.stage import DeviceFrame
from SlicerUSSim.Logic.opencl.layout import CONSTANTS, SEGMENT
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import slice_under_probe

#: {output: (its type, the name of the signal on the device or "", whether it has the image's pixels)}
OUTPUTS: dict[str, tuple[type[np.generic], str, bool]] = {
    "image": (np.uint8, "image", True),
    "labels": (np.uint8, "", True),
    "labels_as_imaged": (np.uint8, "", True),
    "depth": (np.float32, "", True),
    "iq": (np.complex64, "iq", False),
    "rf": (np.float32, "iq", False),
    "envelope": (np.float32, "envelope", False),
    "bmode": (np.uint8, "grey", False),
}
#: Steps of the displacement of lines, and a distance beyond all volumes
_SHIFT_STEP_MM, _FAR_MM = 0.25, 1e6
_NO_RF = "rf has 2 samples per cycle, expected more; take iq, or quality full"
#: Part of the free memory that arrays may have; larger ones are files
_MOST_OF_MEMORY = 0.5


def one_per_image(name: str, given: Any, kind: type, count: int) -> list:
    """`given`, one for all images or a sequence of one for each. Raises SimulationError for another number of them.

    All but probes may be None. One noise_seed is the first of consecutive ones.
    """
    if kind is Integral and isinstance(given, kind):
        return list(range(int(given), int(given) + count))
    if isinstance(given, kind) or (given is None and kind is not Probe):
        return [given] * count
    expected = f"expected one {'whole number' if kind is Integral else kind.__name__} or one for each pose"
    values = list(given) if isinstance(given, Sequence | np.ndarray) else [given]
    require(all(isinstance(value, kind) for value in values), f"{name} is {short(given)}, {expected}")
    require(len(values) == count, f"{name} are {len(values)} for {count} poses, {expected}")
    return values


def same_shapes(shapes: Sequence[tuple], remedy: str) -> tuple:
    """The shape of all images. Raises SimulationError that names the first of another shape, with what to do."""
    other = next((number for number, shape in enumerate(shapes) if shape != shapes[0]), None)
    require(
        other is None,
        f"image {other} of the batch is {_times(shapes[other or 0])}, the first is {_times(shapes[0])}, expected one "
        f"size; {remedy}",
    )
    return shapes[0]


def arrays_for(
    outputs: Sequence[str], pixels: tuple[int, int], works: Sequence[tuple[Probe, SimulationSettings]],
    out: Mapping[str, np.ndarray] | None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """{output: array of all images}: those of `out`, or new ones, which are temporary files if memory is short.

    Images have `pixels` (rows, columns) and are computed by `works` (quality.worked). Raises SimulationError for
    unknown outputs, signals of different shapes, the rf of drafts, an `out` of another shape or type, and if neither
    has room.
    """
    require(bool(outputs) and not isinstance(outputs, str), f"outputs are {outputs!r}, expected a list of names")
    for name in outputs:
        require(name in OUTPUTS, f"output {name!r} is unknown, expected some of {', '.join(OUTPUTS)}")
    require("rf" not in outputs or min(settings.samples_per_cycle for _, settings in works) > 2, _NO_RF)
    shapes, lines = {}, [line_shape(*work) for work in works]
    for name in outputs:
        one = pixels if OUTPUTS[name][2] else same_shapes(lines, f"simulate them apart, or without {name}")
        shapes[name] = (len(works), *one)
    if out is not None:
        require(
            isinstance(out, Mapping) and set(out) == set(outputs),
            f"out is {list(out) if isinstance(out, Mapping) else type(out).__name__}, expected a dict with an array "
            f"for each of {', '.join(outputs)}",
        )
        for name, array in out.items():
            kind = np.dtype(OUTPUTS[name][0])
            is_right = isinstance(array, np.ndarray) and (array.shape, array.dtype) == (shapes[name], kind)
            found = f"{_times(array.shape)} {array.dtype}" if isinstance(array, np.ndarray) else type(array).__name__
            require(is_right, f"out[{name!r}] is {found}, expected {_times(shapes[name])} {kind}")
            require(array.flags.writeable, f"out[{name!r}] is read-only, expected an array that can be written")
        return dict(out)
    size = sum(int(np.prod(shapes[name])) * np.dtype(OUTPUTS[name][0]).itemsize for name in outputs)
    make = _filed if size > _MOST_OF_MEMORY * free_memory() else np.empty
    return {name: make(shapes[name], OUTPUTS[name][0]) for name in outputs}


def free_memory() -> float:
    """Bytes that new arrays may take, as Linux says; infinite elsewhere."""
    return bytes_of("/proc/meminfo", "MemAvailable", np.inf)


def bytes_of(file: str, name: str, otherwise: float) -> float:
    """Bytes by a line of a file in which Linux tells kilobytes; `otherwise` elsewhere."""
    try:
        with open(file) as lines:
            return 1024.0 * next(int(line.split()[1]) for line in lines if line.startswith(name))
    except (OSError, StopIteration):
        return otherwise


def _filed(shape: tuple[int, ...], kind: type[np.generic]) -> np.ndarray:
    """An array in a temporary file, which goes with it."""
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    try:
        with tempfile.TemporaryFile() as file:
            if hasattr(os, "posix_fallocate"):  # a full disk would end the process later
                os.posix_fallocate(file.fileno(), 0, size)
            return np.memmap(file, kind, "w+", shape=shape)
    except OSError as error:
        raise SimulationError(
            f"arrays of a batch that fill the memory are files, but {tempfile.gettempdir()} has no room for one of "
            f"{size / 1e9:.1f} GB ({error.strerror}); simulate the batch in parts, or set TMPDIR"
        ) from None


def _times(shape: Sequence[int]) -> str:
    return " x ".join(map(str, shape))


def on_carrier(iq: np.ndarray, samples_per_cycle: int) -> np.ndarray:
    """(scan_lines, samples) complex64 analytic RF signal of a baseband signal. Raises SimulationError for too few."""
    require(samples_per_cycle > 2, _NO_RF)
    return iq * np.exp(2j * np.pi / samples_per_cycle * np.arange(iq.shape[1])).astype(np.complex64)


# ---- labels and depths -----------------------------------------------------------------------------------------------


def geometric_labels(labels: Volume, probe: Probe, grid: ImageGrid, pose: np.ndarray) -> np.ndarray:
    """(rows, columns) uint8 labels at the places of the pixels; 0 outside the imaged field."""
    found = slice_under_probe(labels, grid, pose, order=0).astype(np.uint8)
    found[~_field(probe, grid)] = 0
    return found


@lru_cache(maxsize=4)
def _field(probe: Probe, grid: ImageGrid) -> np.ndarray:
    return grid.field(probe)


@lru_cache(maxsize=4)
def depth_of_pixels(probe: Probe, grid: ImageGrid) -> np.ndarray:
    """(rows, columns) float32 millimetres along the scan line from the face; nan outside the imaged field."""
    position, along = lines_of_pixels(probe, grid)
    return np.where(_field(probe, grid), along - probe.line_starts_mm(position), np.nan).astype(np.float32)


@lru_cache(maxsize=4)
def lines_of_pixels(probe: Probe, grid: ImageGrid) -> tuple[np.ndarray, np.ndarray]:
    """Probe.line_through of the centres of all pixels, (rows, columns) each."""
    (x, y), (dx, dy) = (grid.left_mm, grid.top_mm), grid.pixel_spacing_mm
    columns, rows = np.meshgrid(np.arange(grid.columns) + 0.5, np.arange(grid.rows) + 0.5)
    return probe.line_through(x + dx * columns, y + dy * rows)


def fetched(name: str, frame: DeviceFrame, pose: np.ndarray) -> Callable[[], np.ndarray]:
    """What gives one of OUTPUTS of a frame that is enqueued; downloads begin now, the rest is computed when called."""
    labels, probe, grid = frame.medium.labels, frame.probe, frame.grid
    if name == "labels":
        return lambda: geometric_labels(labels, probe, grid, pose)
    if name == "depth":
        return lambda: depth_of_pixels(probe, grid)
    if name == "labels_as_imaged":
        traced, tree = int(frame.acquisition["traced_lines"]), frame.tree
        start = frame.medium.device.start_download
        segments = start(tree.segments, (traced, CONSTANTS["MAX_SEGMENTS"]), SEGMENT)
        counts = start(tree.segment_counts, (traced,), np.int32)
        return lambda: _imaged(frame, labels, pose, segments(), counts())
    signal, samples = frame.start_download(OUTPUTS[name][1]), line_shape(probe, frame.settings)[1]
    if name == "rf":
        return lambda: np.real(on_carrier(signal()[:, :samples], frame.settings.samples_per_cycle))
    return signal if name == "image" else lambda: signal()[:, :samples]


def _imaged(
    frame: DeviceFrame, labels: Volume, pose: np.ndarray, segments: np.ndarray, counts: np.ndarray
) -> np.ndarray:
    """(rows, columns) uint8 labels where travel time and refraction put them; 0 outside the imaged field.

    A pixel has the label of its own place, displaced as far as the nearest traced line is when the echo of the pixel's
    depth is made. A line that ends, as at air, shows nothing behind that: 0. `segments` (traced lines, MAX_SEGMENTS)
    are layout.SEGMENT, with `counts` in use.
    """
    probe, grid, record = frame.probe, frame.grid, frame.acquisition
    depth = np.arange(0.0, probe.displayed_mm + _SHIFT_STEP_MM, _SHIFT_STEP_MM)
    lines, lateral, guard = np.arange(len(counts)), int(record["lateral_rays"]), int(record["guard_lines"])
    is_direct = (np.arange(segments.shape[1]) < counts[:, None]) & (segments["reflections"] == 0)
    direct, line = segments[is_direct], np.nonzero(is_direct)[0]
    # Depths of one line after those of another
    ends = np.searchsorted(line * _FAR_MM + direct["depth_mm"], lines[:, None] * _FAR_MM + depth, side="right")
    piece = np.minimum(np.maximum(ends - 1, np.searchsorted(line, lines)[:, None]), len(direct) - 1)
    along = (depth - direct["depth_mm"][piece]) / direct["depth_per_mm"][piece]
    origin, direction = probe.line_at(probe.first_line + probe.line_spacing * (lines - guard) / lateral)
    straight = (origin[:, None] + depth[:, None] * direction[:, None]) @ pose[:3, :3].T + pose[:3, 3]
    shift = direct["start"][piece] + along[..., None] * direct["direction"][piece] - straight
    is_seen = is_direct.any(axis=1)[:, None] & (along <= direct["length_mm"][piece] + _SHIFT_STEP_MM)
    shift = np.where(is_seen[..., None], shift @ labels.ras_to_ijk[:3, :3].T, _FAR_MM).astype(np.float32)

    row, column, nearest = _nearest(probe, grid, lateral, guard, len(counts), len(depth))
    to_ijk = (labels.ras_to_ijk @ pose @ grid.image_to_probe)[:3].astype(np.float32)
    place = shift.reshape(-1, 3).T.copy().take(nearest, axis=1)
    place += to_ijk[:, :1] * column + to_ijk[:, 1:2] * row + to_ijk[:, 3:]
    found = np.zeros((grid.rows, grid.columns), np.uint8)
    found[_field(probe, grid)] = ndimage.map_coordinates(labels.array, place[::-1], order=0, cval=0)
    return found


@lru_cache(maxsize=4)
def _nearest(
    probe: Probe, grid: ImageGrid, lateral: int, guard: int, traced: int, depths: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the pixels in the imaged field: float32 row, column, and which of (traced lines, depths) is nearest."""
    position, along = (of[_field(probe, grid)] for of in lines_of_pixels(probe, grid))
    line = np.rint((position - probe.first_line) / probe.line_spacing * lateral).astype(int) + guard
    depth = np.rint(np.clip(along, 0.0, probe.displayed_mm) / _SHIFT_STEP_MM).astype(int)
    row, column = (of.astype(np.float32) for of in np.nonzero(_field(probe, grid)))
    return row, column, np.clip(line, 0, traced - 1) * depths + depth
