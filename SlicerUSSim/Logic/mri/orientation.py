"""How a head lies that the atlas does not fit: axes turned or flipped, or a wrong voxel size, in its header."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.alignment import SIZES, Alignment, agreement_by_moments, align_coarse, align_turned
from SlicerUSSim.Logic.mri.coarse import CoarseImage
from SlicerUSSim.Logic.mri.not_a_head import cut_ends, is_noise, is_phantom

_ENDS = ("RL", "AP", "SI")
#: A patient in a scanner nods by up to 40 degrees.
MOST_TURN_DEG = 48.0
_TURN_IT = (
    "correct the orientation in its header, for example in 3D Slicer: turn it in the module Transforms, "
    "harden the transform and save it"
)
_WHOLE = "use a series of the whole head, or give a brain mask (--mask)"
_NAMES = {"R": "right", "L": "left", "A": "front", "P": "back", "S": "top", "I": "bottom"}


def lies_otherwise(
    mri: Volume, image: CoarseImage, alignment: Alignment, least: float, progress: Callable[[float], None] | None = None
) -> str | None:
    """One line if the head fits the atlas better in another orientation or size than its header's; None if not.

    It takes 3 s.
    """
    report = progress or (lambda share: None)
    # A fit in the header's orientation has to be beaten clearly; one that turned the head is a finding itself.
    enough = max(least, (1.3 if alignment.turn_deg < MOST_TURN_DEG else 0.9) * alignment.agreement)
    turns = _turns()
    number, other = align_turned(image, turns, lambda share: report(0.7 * share))
    if other.agreement >= enough and other.turn_from(turns[number]) < 45.0:
        compared = f"{other.agreement:.2f}, in the header's orientation {alignment.agreement:.2f}"
        if alignment.turn_deg >= MOST_TURN_DEG:  # it was turned by the search itself
            compared = f"{other.agreement:.2f}, only when turned so"
        return (
            f"the head does not lie as its header says: {_described(turns[number])} (agreement with the atlas "
            f"{compared}); {_TURN_IT}"
        )
    ends = cut_ends(mri)
    is_cut = set(ends) - {"bottom"}  # where the neck leaves the image
    upside_down = " (if that is the neck, the head is upside down)" if is_cut == {"top"} else ""
    where = (
        f"the object is cut off at its {' and '.join(ends)}{upside_down}; {_WHOLE}, or correct the orientation in its "
        "header if it is whole"
    )
    if is_cut and alignment.agreement < least:
        return where
    sizes = _sizes()
    later = lambda share: report(0.7 + 0.3 * share)  # noqa: E731
    number, other = align_turned(image, [np.diag(factors) for factors in sizes], later)
    if other.agreement < enough:
        return where if ends and alignment.agreement < least else None
    axes = zip(sizes[number], ("width", "length", "height"), strict=True)
    words = ", ".join(f"{axis} {factor:g} times" for factor, axis in axes if factor != 1)
    return (
        f"the head has a wrong size ({words} an adult's), or a part of it is missing, or it does not lie as its header "
        "says; use a series of the whole head, correct the voxel size or the orientation in its header, or give a "
        "brain mask (--mask)"
    )


def stripped_lies_otherwise(image: CoarseImage, inside: np.ndarray, upright: float, least: float) -> str | None:
    """One line if a skull-stripped brain, which is `inside`, fits the atlas in another orientation only; else None.

    `upright` is its agreement as its header says (agreement_by_moments). It takes 2 s.
    """
    fits = [(agreement_by_moments(image, inside, turn), number) for number, turn in enumerate(_turns())]
    best, number = max(fits)
    if best < max(least, 1.4 * upright):
        return None
    alignment = align_coarse(image)  # a head may also be tilted
    if alignment.turn_deg < MOST_TURN_DEG and alignment.agreement >= best:
        return None
    return (
        f"the brain does not lie as its header says: {_described(_turns()[number])} (agreement with the atlas "
        f"{best:.2f}, in the header's orientation {upright:.2f}); {_TURN_IT}"
    )


def why_refused(
    mri: Volume, image: CoarseImage, alignment: Alignment, least: float, progress: Callable[[float], None] | None = None
) -> str:
    """One line about an image that the atlas does not fit: what it shows instead, and what to do."""
    size = " x ".join(f"{n * image.spacing_mm:.0f}" for n in image.array.shape[::-1])
    if is_noise(image):
        return f"this {size} mm image is noise, in which neighbours have nothing in common, expected an MRI of a head"
    if is_phantom(image, looks_like_a_head=alignment.agreement > 0.75 * least):
        return (
            f"this {size} mm image has large uniform parts, as a phantom has and no head; "
            "use an MRI of a head, or --skull-strip none to take everything brighter than the background"
        )
    if {"bottom", "top"} <= set(cut_ends(mri)):
        return (
            f"the object in this {size} mm image is cut off at its bottom and its top, as a limb, a body or a part of "
            f"a head is, expected a whole head; {_WHOLE}"
        )
    if alignment.agreement >= least and alignment.turn_deg <= MOST_TURN_DEG and alignment.size < SIZES[0]:
        return (
            f"the brain in this head is {alignment.size:.2f} times as large as an adult's, expected {SIZES[0]:g} or "
            "more: a small child, or a wrong voxel size in its header; correct it, or give a brain mask (--mask)"
        )
    message = lies_otherwise(mri, image, alignment, least, progress)
    if message is not None:
        return message
    position = (
        f"only if turned by {alignment.turn_deg:.0f} degrees, {alignment.size:.2f} times as large and stretched by a "
        f"factor of {alignment.stretch:.2f}"
    )
    if alignment.agreement >= 2.0 * least:
        return (
            f"the atlas fits this {size} mm image {position}, more than any adult's head; correct the orientation or "
            "the voxel size in its header"
        )
    expected = f"expected {least:g} or more" if alignment.agreement < least else f"but {position}"
    return (
        f"no head or brain is recognised in this {size} mm image (agreement with the atlas {alignment.agreement:.2f}, "
        f"{expected}); use a T1, T2 or FLAIR of the whole head, check the orientation and voxel size in its header, "
        "or give a brain mask (--mask)"
    )


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
    return [(0.5, 0.5, 0.5), (0.7, 0.7, 0.7), (2.0, 2.0, 2.0), (1.0, 1.0, 2.0), (1.0, 1.0, 0.5), (1.0, 2.0, 1.0),
            (1.0, 0.5, 1.0), (2.0, 1.0, 1.0), (0.5, 1.0, 1.0)]  # fmt: skip


def _described(turn: np.ndarray) -> str:
    """Where the top and the front of the head point, in the header's words."""
    words = []
    for axis, name in ((2, "top"), (1, "face")):
        towards = turn[:, axis]
        row = int(np.abs(towards).argmax())
        letter = _ENDS[row][0 if towards[row] > 0 else 1]
        words.append(f"its {name} is where the header says {_NAMES[letter]}")
    return " and ".join(words)
