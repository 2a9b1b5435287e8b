"""Brain masks kept beside their MRI, so that a brain is extracted once and a person can edit its mask."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import written_whole
from SlicerUSSim.Logic.base.image_files import read_image
from SlicerUSSim.Logic.base.volume import Volume

_log = logging.getLogger(__name__)

#: Entry of the file with the fingerprint of its MRI
_MRI = "ussim_mri"


def read_kept(path: Path, mri: Volume) -> Volume | None:
    """The mask kept for this MRI, also where a user edited it; None without one, or if it belongs to another image."""
    if not path.is_file():
        return None
    try:
        image = read_image(path)
        mask = Volume.from_image_file(image, str(path))
    except SimulationError as error:
        _log.warning("%s", error)
        return None
    # Most programs drop our entry from what they edit.
    is_of_mri = image.header.get(_MRI, fingerprint := fingerprint_of(mri)) == fingerprint
    if is_of_mri and mask.array.shape == mri.array.shape and np.allclose(mask.ijk_to_ras, mri.ijk_to_ras, atol=1e-3):
        return replace(mask, name=str(path))
    _log.info("%s: is not used, since it was made for another image", path)
    return None


def keep(path: Path, mri: Volume, mask: Volume) -> str:
    """Write the mask of an MRI as keep_file does; a line about it."""

    def write(place: Path) -> None:
        import SimpleITK as sitk

        image = mask.to_sitk()
        image.SetMetaData(_MRI, fingerprint_of(mri))
        with written_whole(place) as partial:
            sitk.WriteImage(image, str(partial), useCompression=True)

    return keep_file(path, "the brain mask", write)


def keep_file(path: Path, what: str, write: Callable[[Path], None], *, replaces: bool = False) -> str:
    """Write a file to `path`, where there is none unless it `replaces` one; a line that says so, or why not."""
    try:
        require(replaces or not path.exists(), f"{path} exists and belongs to another image")
        write(path)
    except SimulationError as error:
        return f"{what} is not kept: {error}"
    return f"{what} is kept in {path}"


def fingerprint_of(mri: Volume) -> str:
    """A hash of voxels and geometry. Rounded, so that it survives the formats in which an MRI is stored."""
    return _hash(mri.array.astype(np.float32)) + _hash(np.round(mri.ijk_to_ras, 3) + 0.0)


def _hash(array: np.ndarray) -> str:
    digest = hashlib.sha256(str(array.shape).encode())
    digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:32]
