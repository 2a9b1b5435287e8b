"""Seeds of the amplifier noise of images.

A scanner's noise differs between images. Here it is a function of the settings' seed and a number, `noise_seed`, so
that images are reproducible: it is the image's number in a sweep, a function of the pose for a live probe
(seed_of_pose), and 0 throughout a fit, so that the cost is deterministic.
"""

from __future__ import annotations

import zlib

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.transforms import check_affine

#: Steps for rounding the axes' coordinates and the origin [mm]. They are offset from round numbers, so that rounding
#: errors of poses with round numbers do not change the step.
_AXES_STEP, _ORIGIN_STEP_MM, _BEGINNING = 1e-4, 1e-2, 0.381966


def seed_of_pose(probe_to_ras: np.ndarray) -> int:
    """The `noise_seed` of the image at a pose (4, 4), different for different poses.

    Poses that agree within 0.01 mm and 0.1 mrad are considered equal, which is much more than the rounding errors of
    products of parent transforms. Raises SimulationError for a matrix that is not affine.

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


def require_seed(noise_seed: int) -> None:
    """Raise SimulationError for a noise_seed that is not a whole number of 32 bits."""
    require(
        isinstance(noise_seed, int | np.integer) and 0 <= noise_seed < 2**32,
        f"noise_seed is {noise_seed!r}, expected a whole number from 0 to {2**32 - 1}",
    )


def noise_key(acquisition: np.ndarray, noise_seed: int) -> int:
    """Initial value of the noise's hash, independent of that of the scatterers and of other noise seeds."""
    require_seed(noise_seed)
    return (int(acquisition["seed"]) * 0x9E3779B1 + 0x7F4A7C15 + stirred(int(noise_seed))) % 2**32


def stirred(number: int) -> int:
    """A hash of 32 bits, each of which depends on all bits of the number (the kernels' hash_mix); 0 stays 0."""
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        number = ((number ^ (number >> shift)) * factor) % 2**32
    return number ^ (number >> 16)
