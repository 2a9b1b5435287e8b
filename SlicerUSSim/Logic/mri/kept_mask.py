"""Brain masks kept beside their MRI, so that a brain is extracted once."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.files import make_folder, written_whole
from SlicerUSSim.Logic.base.image_files import read_image
from SlicerUSSim.Logic.base.version import __version__
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.given_mask import checked_mask

_log = logging.getLogger(__name__)

_PREFIX = "ussim_"


@dataclass(frozen=True, eq=False)
class KeptMask:
    """A mask that was read from its file."""

    inside: np.ndarray
    method: str
    seconds: float
    #: Whether somebody changed its voxels since it was written
    is_edited: bool
    path: Path
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Kept:
    """What became of a file that was to be kept."""

    #: One line for the user
    text: str
    is_beside: bool


def read_kept(path: Path, mri: Volume, method: str) -> KeptMask | None:
    """The mask kept for this MRI and method; None if there is none, or it belongs to another image or method.

    Raises SimulationError for one that somebody edited and that would be refused if it were given (checked_mask).
    """
    fingerprint = fingerprint_of(mri)
    for place in (path, _in_cache(path, fingerprint)):
        kept = _read(place, mri, method, fingerprint)
        if kept is not None:
            return kept
    return None


def keep(path: Path, mri: Volume, inside: np.ndarray, method: str, seconds: float, warnings: tuple[str, ...]) -> Kept:
    """Write the mask to `path`, or to the user's cache folder as keep_file does.

    A file at `path` is never replaced.
    """
    mask = mri.with_array(inside.astype(np.uint8))
    entries = {
        "mri": fingerprint_of(mri), "mask": _hash(mask.array), "method": method, "seconds": f"{seconds:.1f}",
        "version": __version__, "warnings": " | ".join(warnings),
    }  # fmt: skip
    in_cache = _in_cache(path, entries["mri"])
    return keep_file(path, in_cache, "the brain mask is", lambda place: _write(place, mask, entries))


def keep_file(path: Path, in_cache: Path, what: str, write: Callable[[Path], None]) -> Kept:
    """Write a file to `path`, or to the user's cache folder if `path` exists or cannot be written."""
    why = f"{path} exists"
    if not path.exists():
        try:
            write(path)
            return Kept(f"{what} kept in {path}", True)
        except SimulationError as error:
            _log.info("%s", error)
            why = f"{path.parent} cannot be written"
    try:
        make_folder(in_cache.parent)
        write(in_cache)
    except SimulationError as error:
        return Kept(f"{what} not kept: {error}", False)
    return Kept(f"{what} kept in {in_cache}, since {why}", False)


def fingerprint_of(mri: Volume) -> str:
    """A hash of voxels and geometry. Rounded, so that it survives the formats in which an MRI is stored."""
    return _hash(mri.array.astype(np.float32)) + _hash(np.round(mri.ijk_to_ras, 3) + 0.0)


def _hash(array: np.ndarray) -> str:
    digest = hashlib.sha256(str(array.shape).encode())
    digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:32]


def cache_folder() -> Path:
    """Where things are kept that cannot be beside their MRI."""
    import platformdirs

    return Path(platformdirs.user_cache_dir("ussim", appauthor=False))


def _in_cache(path: Path, fingerprint: str) -> Path:
    return cache_folder() / "brain-masks" / f"{fingerprint}-{path.name}"


def _write(path: Path, mask: Volume, entries: dict[str, str]) -> None:
    import SimpleITK as sitk

    image = mask.to_sitk()
    for name, value in entries.items():
        image.SetMetaData(_PREFIX + name, value)
    with written_whole(path) as partial:
        sitk.WriteImage(image, str(partial), useCompression=True)


def _is_as_written(mask: Volume, digest: str) -> bool:
    """Whether nobody has edited a mask since its voxels, 0 and 1, had this hash."""
    inside = mask.array > 0
    return np.array_equal(mask.array, inside) and digest == _hash(inside.astype(np.uint8))


def _read(path: Path, mri: Volume, method: str, fingerprint: str) -> KeptMask | None:
    if not path.is_file():
        return None
    try:
        image = read_image(path)
        mask = Volume.from_image_file(image, str(path))
    except SimulationError as error:
        _log.warning("%s", error)
        return None
    entries = {key.removeprefix(_PREFIX): text for key, text in image.header.items() if key.startswith(_PREFIX)}
    # Without our entries: another program wrote it under this name, and most programs drop them from what they edit.
    is_same_grid = mask.array.shape == mri.array.shape and np.allclose(mask.ijk_to_ras, mri.ijk_to_ras, atol=1e-3)
    is_mask = bool(entries) or len(np.unique(np.nan_to_num(mask.array))) <= 2
    if entries.get("mri", fingerprint) != fingerprint or not (is_same_grid and is_mask):
        _log.info("%s: is not used, since it was made for another image", path)
        return None
    is_edited = not _is_as_written(mask, entries.get("mask", ""))
    inside = _checked(mask, path, mri) if is_edited else mask.array > 0
    made_by = entries.get("method", "")
    if not is_edited and method not in ("auto", made_by):
        _log.info("%s: is not used, since it was made by %s", path, made_by)
        return None
    try:
        seconds = float(entries.get("seconds", "0"))
    except ValueError:
        seconds = 0.0
    warnings = tuple(line for line in entries.get("warnings", "").split(" | ") if line)
    return KeptMask(inside, made_by, seconds, is_edited, path, () if is_edited else warnings)


def _checked(mask: Volume, path: Path, mri: Volume) -> np.ndarray:
    try:
        return checked_mask(replace(mask, name=str(path)), mri)
    except SimulationError as error:
        raise SimulationError(
            f"{error}; that file is beside the MRI and was edited: correct it, or delete it to extract the brain again"
        ) from None
