"""CT phantoms of a lumbar spine and of the lower chest, whose tissues are known.

A phantom is a list of shapes, painted one over the other. A voxel is the mean of its parts, blurred by the scanner,
with noise that the reconstruction kernel has made smooth; so borders have the partial volumes of a scan. Sizes belong
to an adult, rounded (vertebrae: Panjabi et al., Spine 17(3), 1992), not of a person. Coordinates are RAS mm.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume

#: Truth labels, from 1: the name of the tissue, and its number in Hounsfield units in the portal venous phase
TISSUES: dict[str, float] = {
    "skin": 45.0, "fat": -100.0, "muscle": 55.0, "blood": 165.0, "cancellous bone": 190.0, "bone": 1400.0,
    "lung": -850.0, "air": -1000.0, "liver": 110.0, "kidney": 180.0, "spinal canal": 20.0,
}  # fmt: skip
NAMES = tuple(TISSUES)
#: What segment_ct calls them without a map of organs: by their numbers
BY_NUMBER = {"liver": "muscle", "kidney": "blood", "spinal canal": "muscle"}
_AIR, _COUCH = -1000.0, 80.0
#: Deviation of the blur of a body kernel, mm, and of the noise's own smoothness, voxels
_BLUR_MM, _NOISE_VOXELS = 0.45, 0.6
_CORTEX_MM, _JOINT_MM = 1.2, 2.0

#: Middles of L5 to L1, z
_LEVELS = (-72.0, -36.0, 0.0, 36.0, 72.0)
_EVERYWHERE = ((-1e3, -1e3, -1e3), (1e3, 1e3, 1e3))


@dataclass(frozen=True)
class Shape:
    """A solid."""

    #: mm to its surface, negative inside, from x, y, z that can be broadcast
    distance: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    #: Corners of a box around it
    low: tuple[float, ...] = _EVERYWHERE[0]
    high: tuple[float, ...] = _EVERYWHERE[1]

    def part(self, axes: list[np.ndarray]) -> tuple[tuple[slice, ...], np.ndarray]:
        """(the part [k, j, i] of the grid of these coordinates along x, y, z in the box, distances there)"""
        ends = zip(axes, self.low, self.high, strict=True)
        inside = [slice(*np.searchsorted(axis, (low, high)).tolist()) for axis, low, high in ends]
        i, j, k = (axis[part] for axis, part in zip(axes, inside, strict=True))
        box = tuple(inside[::-1])
        distances = self.distance(i[None, None, :], j[None, :, None], k[:, None, None])
        return box, np.broadcast_to(distances, (len(k), len(j), len(i)))


@dataclass(frozen=True, eq=False)
class CtPhantom:
    """A CT and its truth."""

    #: int16, Hounsfield units
    ct: Volume
    #: uint8, labels of NAMES from 1; 0 outside the patient
    truth: Volume
    #: int16, label map in TotalSegmentator's numbers of what it labels in this phantom
    organs: Volume


def lumbar_spine(spacing_mm: tuple[float, float, float] = (1.0, 1.0, 1.0), noise_hu: float = 20.0) -> CtPhantom:
    """L2 to L4 and parts of their neighbours, of a patient on a couch: back muscles, aorta, joints 2 mm wide."""
    septa = [_box((x - 0.8, -62.0, -99.0), (x + 0.8, -30.0, 99.0), 0.0) for x in (-27.0, 27.0)]
    shapes = [
        *_trunk(halves=(120.0, 80.0), centre_y=12.0),
        ("fat", septa, 0.0),  # between the muscles of the back
        ("blood", [_rod((-4.0, 27.5, -99.0), (-4.0, 27.5, 99.0), 10.0)], 0.0),  # it touches the vertebrae
        *_bones([part for z in _LEVELS for part in _vertebra(z)]),
        ("spinal canal", [_rod((0.0, -25.0, -99.0), (0.0, -25.0, 99.0), 8.0)], 0.0),
    ]
    names = (f"vertebrae_L{n}" for n in range(5, 0, -1))
    organs = {name: (z - 18.0, z + 18.0) for name, z in zip(names, _LEVELS, strict=True)}
    return _phantom(shapes, (-125.0, -82.0, -60.0), (125.0, 97.0, 60.0), spacing_mm, noise_hu, organs)


def lower_chest(spacing_mm: tuple[float, float, float] = (1.0, 1.0, 1.0), noise_hu: float = 20.0) -> CtPhantom:
    """The right side of a chest: ribs in its wall, lung above the dome of the liver, a kidney in its fat, a trachea."""
    halves, y = (120.0, 85.0), 0.0
    inner = _ellipse((halves[0] - 28.0, halves[1] - 28.0), y)
    dome, around = (
        _ellipsoid((45.0, 0.0, -45.0), (85.0, 75.0, 80.0)),
        _ellipsoid((45.0, 0.0, -45.0), (88.0, 78.0, 83.0)),
    )
    trachea = _rod((-60.0, 20.0, -99.0), (-60.0, 20.0, 99.0), 10.5)
    shapes = [
        *_trunk(halves, y),
        ("fat", [inner], -2.0),
        ("lung", [_both(inner, Shape(lambda x, y, z: -30.0 - x + 0.0 * (y + z)))], 0.0),
        ("muscle", [_both(inner, around)], 0.0),  # the diaphragm
        ("liver", [_both(inner, dome)], 0.0),
        ("fat", [_both(inner, _ellipsoid((50.0, -30.0, -38.0), (36.0, 31.0, 60.0)))], 0.0),
        ("kidney", [_both(inner, _ellipsoid((50.0, -30.0, -38.0), (27.0, 22.0, 50.0)))], 0.0),
        ("blood", [_rod((-45.0, -30.0, -99.0), (-45.0, -30.0, 99.0), 11.0)], 0.0),
        ("muscle", [trachea], 0.0),
        ("air", [trachea], -1.5),
        *_bones([_rib(halves, y, z) for z in np.arange(-75.0, 100.0, 24.0)]),
    ]
    organs = {"liver": None, "kidney_right": None, "lung_lower_lobe_right": None}
    return _phantom(shapes, (-125.0, -95.0, -50.0), (125.0, 90.0, 75.0), spacing_mm, noise_hu, organs)


# ---- shapes ------------------------------------------------------------------------------------------------------

#: The name of the tissue, and its parts: a voxel is in the tissue where one of them is below this distance
Painted = tuple[str, list[Shape], float]


def _trunk(halves: tuple[float, float], centre_y: float) -> list[Painted]:
    """Skin of 2 mm, fat of 10 mm, muscle."""
    skin = _ellipse(halves, centre_y)
    return [("skin", [skin], 0.0), ("fat", [skin], -2.0), ("muscle", [skin], -12.0)]


def _bones(parts: list[Shape]) -> list[Painted]:
    return [("bone", parts, 0.0), ("cancellous bone", parts, -_CORTEX_MM)]


def _ellipse(halves: tuple[float, float], centre_y: float) -> Shape:
    """An elliptic cylinder along z."""
    a, b = halves
    return Shape(lambda x, y, z: (np.hypot(x / a, (y - centre_y) / b) - 1.0) * min(a, b) + 0.0 * z)


def _ellipsoid(centre, halves) -> Shape:
    def distance(x, y, z):
        parts = [(p - c) / h for p, c, h in zip((x, y, z), centre, halves, strict=True)]
        return (np.sqrt(sum(part**2 for part in parts)) - 1.0) * min(halves)

    reach = np.add(halves, 4.0)
    return Shape(distance, tuple(np.subtract(centre, reach)), tuple(np.add(centre, reach)))


def _rod(start: Sequence[float], end: Sequence[float], radius: float) -> Shape:
    """A capsule."""
    first, axis = np.array(start, np.float32), np.subtract(end, start).astype(np.float32)

    def distance(x, y, z):
        off = [p - s for p, s in zip((x, y, z), first, strict=True)]
        along = np.clip(sum(o * a for o, a in zip(off, axis, strict=True)) / (axis @ axis), 0.0, 1.0)
        return np.sqrt(sum((o - along * a) ** 2 for o, a in zip(off, axis, strict=True))) - radius

    ends = np.array([start, end], float)
    return Shape(distance, tuple(ends.min(axis=0) - radius), tuple(ends.max(axis=0) + radius))


def _box(low, high, rounding: float = 1.5) -> Shape:
    middle, half = np.add(low, high) / 2.0, np.subtract(high, low) / 2.0 - rounding

    def distance(x, y, z):
        off = [np.abs(p - m) - h for p, m, h in zip((x, y, z), middle.tolist(), half.tolist(), strict=True)]
        outside = np.sqrt(sum(np.maximum(o, 0.0) ** 2 for o in off))
        return outside + np.minimum(np.maximum(np.maximum(off[0], off[1]), off[2]), 0.0) - rounding

    return Shape(distance, tuple(low), tuple(high))


def _both(a: Shape, b: Shape) -> Shape:
    """What is in both."""
    low, high = np.maximum(a.low, b.low), np.minimum(a.high, b.high)
    return Shape(lambda x, y, z: np.maximum(a.distance(x, y, z), b.distance(x, y, z)), tuple(low), tuple(high))


def _facing(normal_xy: tuple[float, float], point_xy: tuple[float, float], sign: float) -> Shape:
    """Everything from half a joint's width beyond a plane along z."""
    n = np.array(normal_xy) / np.hypot(*normal_xy)
    return Shape(
        lambda x, y, z: _JOINT_MM / 2.0 - sign * ((x - point_xy[0]) * n[0] + (y - point_xy[1]) * n[1]) + 0.0 * z
    )


def _vertebra(z: float) -> list[Shape]:
    """Body, arch, spinous, transverse and articular processes of the lumbar vertebra in the middle at z."""
    parts = [
        _both(_ellipse((23.0, 17.0), 0.0), _box((-25.0, -20.0, z - 13.3), (25.0, 20.0, z + 13.3))),
        _box((-3.5, -60.0, z - 14.0), (3.5, -38.0, z + 6.0)),
    ]
    for side in (-1.0, 1.0):
        for start, end, radius in (
            ((14, -13, 6), (17, -27, 6), 5.0), ((16, -29, 1), (1, -39, -5), 4.0), ((16, -26, 4), (42, -30, 6), 4.5),
            ((17, -29, 2), (14, -34, -6), 5.0),
        ):  # fmt: skip
            first, last = ((side * x, y, z + h) for x, y, h in (start, end))
            parts.append(_rod(first, last, radius))
        for start, end, sign in (((20, -29, 6), (21, -29, 20), 1.0), ((14, -35, -6), (14, -36, -19), -1.0)):
            first, last = ((side * x, y, z + h) for x, y, h in (start, end))
            parts.append(_both(_rod(first, last, 6.5), _facing((side * 0.7, 0.7), (side * 17.4, -32.5), sign)))
    return parts


def _rib(halves: tuple[float, float], centre_y: float, z: float) -> Shape:
    """A rib in the wall, 12 mm high and 7 mm thick, which rises towards the back."""
    around = _ellipse((halves[0] - 20.0, halves[1] - 20.0), centre_y)
    return Shape(
        lambda x, y, h: 3.5
        * (np.hypot(around.distance(x, y, h) / 3.5, (h - z + 0.25 * (y - centre_y) + 0.0 * x) / 6.0) - 1.0),
        (-1e3, -1e3, z - 28.0), (1e3, 1e3, z + 28.0),
    )  # fmt: skip


# ---- images ------------------------------------------------------------------------------------------------------


def _phantom(
    shapes: list[Painted], low, high, spacing_mm, noise_hu: float,
    organs: Mapping[str, tuple[float, float] | None],
) -> CtPhantom:  # fmt: skip
    spacing = np.array(spacing_mm)
    counts = np.rint(np.subtract(high, low) / spacing).astype(int)
    matrix = np.diag([*spacing, 1.0])
    matrix[:3, 3] = np.add(low, 0.5 * spacing)
    parts = [2 * round(size) + 1 if size > 1.5 else 3 for size in spacing]  # odd: no voxel is half and half
    shape = tuple(counts[::-1])
    hu, votes = np.zeros(shape, np.float32), np.zeros((len(NAMES) + 1, *shape), np.uint8)
    values = np.array([_AIR, *TISSUES.values()], np.float32)
    for offset in itertools.product(*((np.arange(n) + 0.5) / n - 0.5 for n in parts)):
        axes = [
            (matrix[n, 3] + spacing[n] * (np.arange(counts[n]) + offset[n])).astype(np.float32) for n in range(3)
        ]  # fmt: skip
        painted = np.zeros(shape, np.uint8)
        for name, solids, below in shapes:
            for solid in solids:
                box, distance = solid.part(axes)
                painted[box][distance < below] = NAMES.index(name) + 1
        hu += values[painted]
        for label in range(len(NAMES) + 1):
            votes[label] += painted == label
        touched = np.flatnonzero(painted.any(axis=(0, 2)))  # the couch is in contact with the back
        couch = painted[:, max(touched[0] - round(4.0 / spacing[1]), 0) : touched[0]] == 0
        hu[:, max(touched[0] - round(4.0 / spacing[1]), 0) : touched[0]] += np.where(couch, _COUCH - _AIR, 0.0)
    hu /= np.prod(parts)
    truth = votes.argmax(axis=0).astype(np.uint8)
    sizes = spacing[::-1]
    hu = ndimage.gaussian_filter(hu, _BLUR_MM / sizes, mode="nearest")
    noise = np.random.default_rng(1).standard_normal(shape).astype(np.float32)
    noise = ndimage.gaussian_filter(noise, _NOISE_VOXELS, mode="wrap")
    ct = np.rint(np.clip(hu + noise_hu / noise.std() * noise, -1024.0, 3071.0)).astype(np.int16)
    found = Volume(truth, matrix)
    return CtPhantom(Volume(ct, matrix), found, found.with_array(_organ_labels(found, organs)))


def _organ_labels(truth: Volume, organs: Mapping[str, tuple[float, float] | None]) -> np.ndarray:
    from SlicerUSSim.Logic.tissue.schemes import schemes

    numbers = {name: number for number, name in schemes()["totalsegmentator"].names.items()}
    tissues = {"vertebrae": ("bone", "cancellous bone"), "lung": ("lung",), "liver": ("liver",), "kidney": ("kidney",)}
    labels = np.zeros(truth.array.shape, np.int16)
    k = np.arange(truth.array.shape[0]) * truth.spacing_mm[2] + truth.ijk_to_ras[2, 3]
    for name, between in organs.items():
        inside = np.isin(truth.array, [NAMES.index(tissue) + 1 for tissue in tissues[name.split("_")[0]]])
        if between is not None:
            inside &= ((k >= between[0]) & (k < between[1]))[:, None, None]
        labels[inside] = numbers[name]
    return labels
