"""Amplifier noise: which draw of it an image has.

A scanner's noise is another in every image. Here it follows from the settings' seed and a number, `noise_seed`, so that
an image can be had again: the images of a sweep are numbered, what follows a probe takes the number from its pose
(seed_of_pose), and a fit keeps to 0 throughout, so that its cost is a function.
"""

from __future__ import annotations

import zlib

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.transforms import check_affine

#: What counts as the same pose: steps of the axes' coordinates and of the origin [mm]. They begin off the numbers that
#: people and programs like, or the last digit of such a pose would decide between two steps.
_AXES_STEP, _ORIGIN_STEP_MM, _BEGINNING = 1e-4, 1e-2, 0.381966


def seed_of_pose(probe_to_ras: np.ndarray) -> int:
    """The `noise_seed` of the image at a pose (4, 4): the same at the same pose, and another at another.

    Poses are the same to a hundredth of a millimetre and 0.1 mrad, far more than the rounding of a product of parent
    transforms. Raises SimulationError for a matrix that is not affine.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic import seed_of_pose
    >>> from SlicerUSSim.Logic.probe import turned
    >>> pose = np.eye(4)
    >>> seed_of_pose(pose) == seed_of_pose(pose + 1e-9)
    True
    >>> seed_of_pose(pose) == seed_of_pose(turned(pose, rock_deg=1))
    False
    """
    pose = check_affine("probe_to_ras", probe_to_ras)[:3]
    steps = np.floor(pose / [*[_AXES_STEP] * 3, _ORIGIN_STEP_MM] + _BEGINNING)
    return zlib.crc32(steps.astype("<i8").tobytes())


def noise_key(acquisition: np.ndarray, noise_seed: int) -> int:
    """What starts the hash of the noise: it has nothing in common with that of the scatterers, nor with other draws'.

    Raises SimulationError for a noise_seed that is not a whole number of 32 bits.
    """
    require(
        isinstance(noise_seed, int | np.integer) and 0 <= noise_seed < 2**32,
        f"noise_seed is {noise_seed!r}, expected a whole number from 0 to {2**32 - 1}",
    )
    return (int(acquisition["seed"]) * 0x9E3779B1 + 0x7F4A7C15 + stirred(int(noise_seed))) % 2**32


def stirred(number: int) -> int:
    """32 bits of which each depends on all of the number's (the kernels' hash_mix); 0 stays 0."""
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        number = ((number ^ (number >> shift)) * factor) % 2**32
    return number ^ (number >> 16)
