"""How a head lies that the atlas does not fit: axes turned or flipped, or a wrong voxel size, in its header."""

from __future__ import annotations

import itertools

import numpy as np

from SlicerUSSim.Logic.mri.alignment import Alignment, CoarseImage, agreement_by_moments, align_coarse

_ENDS = ("RL", "AP", "SI")
#: Agreement with the atlas, put at the centre of a stripped brain with its size. T1 that lie as their header says had
#: 0.40 to 0.97, T2 0.24; others 0.14 to 0.23, and then 1.7 to 3.9 times as much in their true orientation.
_SURELY_RIGHT = 0.3
#: A patient in a scanner nods by up to 40 degrees.
MOST_TURN_DEG = 48.0
_NAMES = {"R": "right", "L": "left", "A": "front", "P": "back", "S": "top", "I": "bottom"}


def lies_otherwise(image: CoarseImage, alignment: Alignment, least: float, remedy: str) -> str | None:
    """One line if the head fits the atlas better in another orientation or size than its header's; None if not."""
    # A fit in the header's orientation has to be beaten clearly; one that turned the head is a finding itself.
    enough = max(least, (1.3 if alignment.turn_deg < MOST_TURN_DEG else 0.9) * alignment.agreement)
    best, turn = 0.0, np.eye(3)
    for candidate in _turns():
        other = align_coarse(image, turn=candidate, quick=True)
        if other.turn_from(candidate) < 45.0 and other.agreement > best:
            best, turn = other.agreement, candidate
    fits = f"agreement with the atlas {best:.2f}, in the header's orientation {alignment.agreement:.2f}"
    if best >= enough:
        return f"the head does not lie as its header says: {_described(turn)} ({fits}); correct the header, or {remedy}"
    for factors in _sizes():
        other = align_coarse(image, turn=np.diag(factors), quick=True)
        if other.agreement >= enough:
            axes = zip(factors, ("width", "length", "height"), strict=True)
            words = ", ".join(f"{axis} {factor:g} times" for factor, axis in axes if factor != 1)
            cut = _cut_ends(image)
            check = "check whether it is whole, and the voxel size" if cut else "check the voxel size"
            return f"the head has a wrong size ({words} an adult's{cut}); {check} in its header, or {remedy}"
    return None


def stripped_lies_otherwise(image: CoarseImage, inside: np.ndarray, least: float, remedy: str) -> str | None:
    """One line if a skull-stripped brain, which is `inside`, fits the atlas in another orientation only; else None.

    Its place and size are known from the mask, so that this takes 0.1 s for most that lie as their header says, and 2 s
    for the others.
    """
    upright = agreement_by_moments(image, inside, np.eye(3))
    if upright >= _SURELY_RIGHT:
        return None
    fits = [(agreement_by_moments(image, inside, turn), number) for number, turn in enumerate(_turns())]
    best, number = max(fits)
    if best < max(least, 1.4 * upright):
        return None
    alignment = align_coarse(image)  # a head may also be tilted
    if alignment.turn_deg < MOST_TURN_DEG and alignment.agreement >= best:
        return None
    return (
        f"the brain does not lie as its header says: {_described(_turns()[number])} (agreement with the atlas "
        f"{best:.2f}, in the header's orientation {upright:.2f}); correct the header, or {remedy}"
    )


def how_it_lies(image: CoarseImage, alignment: Alignment, least: float, remedy: str) -> str:
    """One line about an image that the atlas does not fit: where the head lies, or that there is none."""
    size = " x ".join(f"{n * image.spacing_mm:.0f}" for n in image.array.shape[::-1])
    message = lies_otherwise(image, alignment, least, remedy)
    position = (
        f"only if turned by {alignment.turn_deg:.0f} degrees, {alignment.size:.2f} times as large and stretched by a "
        f"factor of {alignment.stretch:.2f}"
    )
    if message is None and alignment.agreement >= 2.0 * least:
        message = (
            f"the atlas fits this {size} mm image {position}, more than any adult's head; check the orientation and "
            f"the voxel size in its header, or {remedy}"
        )
    expected = f"expected {least:g} or more" if alignment.agreement < least else f"but {position}"
    return message or (
        f"no head or brain is recognised in this {size} mm image (agreement with the atlas {alignment.agreement:.2f}, "
        f"{expected}{_cut_ends(image)}); {remedy}"
    )


def _cut_ends(image: CoarseImage) -> str:
    """Where the image ends in the middle of the object, but for its bottom (the neck): of half a head, perhaps."""
    inside = image.foreground()
    ends = []
    for axis, (first, last) in enumerate((("bottom", "top"), ("back", "front"), ("left", "right"))):
        areas = inside.sum(axis=tuple(other for other in range(3) if other != axis))
        for area, name in ((areas[1], first), (areas[-2], last)):
            if area > 0.5 * areas.max() and name != "bottom":
                ends.append(name)
    return f"; the object is cut off at the {' and '.join(ends)} of the image" if ends else ""


def _turns() -> list[np.ndarray]:
    """Signed permutations but the identity; left and right cannot be told, so that one of each pair is enough."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[list(order), range(3)] = signs
            if np.linalg.det(matrix) > 0 and not np.allclose(matrix, np.eye(3)):
                found.append(matrix)
    return found


def _sizes() -> list[tuple[float, float, float]]:
    return [(0.5, 0.5, 0.5), (2.0, 2.0, 2.0), (1.0, 1.0, 2.0), (1.0, 1.0, 0.5), (1.0, 2.0, 1.0), (1.0, 0.5, 1.0),
            (2.0, 1.0, 1.0), (0.5, 1.0, 1.0)]  # fmt: skip


def _described(turn: np.ndarray) -> str:
    """Where the top and the front of the head point, in the header's words."""
    words = []
    for axis, name in ((2, "top"), (1, "face")):
        towards = turn[:, axis]
        row = int(np.abs(towards).argmax())
        letter = _ENDS[row][0 if towards[row] > 0 else 1]
        words.append(f"its {name} is where the header says {_NAMES[letter]}")
    return " and ".join(words)
