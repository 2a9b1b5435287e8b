"""What ITK does not say of a NIfTI file: how it read the geometry, missing bytes, and voxels that are no numbers."""

from __future__ import annotations

import gzip
import itertools
import logging
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require

_log = logging.getLogger(__name__)

#: Millimetres per unit and name of the lower three bits of xyzt_units (nifti1.h)
_UNITS = {1: (1000.0, "metres"), 2: (1.0, "millimetres"), 3: (0.001, "micrometres")}
#: Before the voxels of a file that this program writes: the header and four bytes for extensions
_HEADER_BYTES = 352
_CHUNK = 2**18  # bytes
#: Two orientations are different if they move a corner of the volume by more than this, millimetres.
_SAME_MM = 0.1


def log_nifti_geometry(image, ijk_to_ras: np.ndarray, name: str) -> None:
    """Log which unit and which of its two orientations a SimpleITK image from NIfTI was read with.

    Warns if the two differ and if there is none. Logs nothing for images from other formats.
    """
    if not image.HasMetaDataKey("sform_code"):
        return
    try:
        header = {key: image.GetMetaData(key) for key in image.GetMetaDataKeys()}
        sform_code, qform_code = int(header["sform_code"]), int(header["qform_code"])
        unit = int(header.get("xyzt_units", "0")) & 7
        scale, unit_name = _UNITS.get(unit, (1.0, ""))
        forms = {}
        if sform_code:
            forms["sform"] = _sform(header, scale)
        if qform_code:
            # ITK does not report the direction of the third axis, so the nearer of the two is taken.
            both = [_qform(header, scale, way) for way in (1.0, -1.0)]
            forms["qform"] = min(both, key=lambda matrix: _distance_mm(matrix, ijk_to_ras, image.GetSize()))
    except (KeyError, ValueError):  # the form of these fields is not documented
        return
    if not unit_name:
        _log.info("%s: NIfTI without a unit of length, read as millimetres", name)
    elif scale != 1.0:
        _log.info("%s: NIfTI in %s, read as millimetres", name, unit_name)
    if not forms:
        _log.warning("%s: NIfTI without an orientation (sform and qform have code 0); check left and right", name)
        return
    size = image.GetSize()
    off = {form: _distance_mm(matrix, ijk_to_ras, size) for form, matrix in forms.items()}
    used = min(off, key=lambda form: off[form])
    codes = f"sform code {sform_code}, qform code {qform_code}"
    matrices = list(forms.values())
    apart = _distance_mm(matrices[0], matrices[-1], size)
    if apart > _SAME_MM:
        _log.warning(
            "%s: sform and qform differ by up to %.1f mm (%s); ITK uses the %s",
            name, apart, codes, used,
        )  # fmt: skip
    else:
        _log.info("%s: NIfTI orientation from its %s (%s)", name, " and ".join(forms), codes)


def _sform(header: dict[str, str], scale: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3] = [np.array(header[f"srow_{axis}"].split(), float) for axis in "xyz"]
    matrix[:3] *= scale
    return matrix


def _qform(header: dict[str, str], scale: float, way: float) -> np.ndarray:
    """Method 2 of nifti1.h: a rotation by a quaternion, voxel sizes, and the `way` of the third axis, 1 or -1."""
    from scipy.spatial.transform import Rotation  # imported here to keep base light

    b, c, d = (float(header[f"quatern_{letter}"]) for letter in "bcd")
    a = np.sqrt(max(1.0 - b * b - c * c - d * d, 0.0))
    rotation = Rotation.from_quat([b, c, d, a]).as_matrix()
    sizes = np.array([float(header[f"pixdim[{n}]"]) for n in (1, 2, 3)])
    sizes[2] *= way
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * sizes
    matrix[:3, 3] = [float(header[f"qoffset_{axis}"]) for axis in "xyz"]
    matrix[:3] *= scale
    return matrix


def _distance_mm(one: np.ndarray, other: np.ndarray, size) -> float:
    """Largest distance between the positions of a corner of the volume under two (4, 4) maps."""
    corners = np.array([[*corner, 1] for corner in itertools.product(*((0, n - 1) for n in size[:3]))], float)
    return float(np.linalg.norm((corners @ (one - other).T)[:, :3], axis=1).max())


def require_complete(path: Path) -> None:
    """Raise SimulationError if bytes of a NIfTI file are missing or damaged: ITK reads the missing voxels as 0.

    Files of other formats pass.
    """
    import nibabel

    try:
        image = nibabel.load(path)
    except Exception:  # whatever nibabel cannot read and ITK can is no ordinary NIfTI file
        return
    if not isinstance(image, nibabel.Nifti1Pair):  # type: ignore[attr-defined]
        return
    stored: Any = image.dataobj
    file = Path(image.file_map["image"].filename or path)
    expected = int(stored.offset) + int(np.prod(stored.shape)) * stored.dtype.itemsize
    found, is_damaged, has_end = _bytes_of(file)
    require(
        has_end or is_damaged or found < expected,
        f"{file}: the file is incomplete, its checksum is missing; copy or export it again",
    )
    require(
        found >= expected and not is_damaged,
        f"{file}: the file is {'damaged' if is_damaged else 'incomplete'}, {found} of {expected} bytes"
        f"{' of its content' if file.suffix == '.gz' else ''} can be read; copy or export it again",
    )


def require_whole_gzip(path: Path) -> None:
    """Raise SimulationError for a file compressed by gzip, by its suffix, without its end or with another checksum."""
    _, is_damaged, has_end = _bytes_of(path)
    require(
        has_end and not is_damaged,
        f"{path}: the file is {'damaged' if is_damaged else 'incomplete'}; copy or export it again",
    )


def require_written(path: Path, voxel_bytes: int) -> None:
    """Raise OSError unless a NIfTI file holds what was to be written: ITK does not say that the disk is full."""
    found, is_damaged, has_end = _bytes_of(path)
    if found < _HEADER_BYTES + voxel_bytes or is_damaged or not has_end:
        raise OSError("not all voxels are in the file; is the disk full?")


def _bytes_of(file: Path) -> tuple[int, bool, bool]:
    """The bytes of a file, decompressed if it is compressed, whether they are not those that were compressed, and
    whether compressed content has its end and checksum.
    """
    if file.suffix.lower() not in (".gz", ".mgz"):
        return file.stat().st_size, False, True
    count = 0
    try:
        with gzip.open(file) as content:
            while chunk := content.read1(_CHUNK):
                count += len(chunk)
    except EOFError:
        return count, False, False
    except (OSError, zlib.error):  # a checksum that differs, or codes that do not exist
        return count, True, True
    return count, False, True


def check_numbers(path: Path, image) -> tuple[str, ...]:
    """Look for voxels of a NIfTI file that are not numbers: ITK reads them as 0 without a word.

    NaN that reaches the border of the volume is how SPM and others write "outside the head": it is read as 0, with a
    warning, which is returned, too. Raises SimulationError for NaN within, for slices of NaN between others, and for
    infinite voxels.
    """
    if not (image.HasMetaDataKey("sform_code") and "float" in image.GetPixelIDTypeAsString()):
        return ()
    import nibabel
    from scipy import ndimage

    stored = np.asanyarray(nibabel.load(path).dataobj)  # type: ignore[attr-defined]
    stored = stored.reshape(stored.shape[:3]) if stored.ndim > 3 and max(stored.shape[3:]) == 1 else stored
    bad = ~np.isfinite(stored)
    count = int(bad.sum())
    if not count:
        return ()
    require(count < bad.size, f"{path}: no voxel is a finite number, expected an image")
    background = np.zeros_like(bad)
    if bad.ndim == 3:
        at_the_border = np.pad(bad, 1, constant_values=True)
        parts, _ = ndimage.label(at_the_border)  # type: ignore[misc]
        background = (parts == parts[0, 0, 0])[1:-1, 1:-1, 1:-1] & np.isnan(stored)
    within = bad & ~background
    if within.any():
        first = tuple(int(n) for n in np.argwhere(within)[0])
        raise SimulationError(
            f"{path}: {int(within.sum())} of {bad.size} voxels are not finite numbers, the first at (i, j, k) = "
            f"{first}; expected numbers, or NaN around the head alone; replace them and try again"
        )
    for axis, name in enumerate("ijk"[: bad.ndim]):
        is_gap = bad.all(axis=tuple(other for other in range(bad.ndim) if other != axis))
        first, last = np.flatnonzero(~is_gap)[[0, -1]]
        gaps = first + np.flatnonzero(is_gap[first:last])
        if gaps.size:
            raise SimulationError(
                f"{path}: {gaps.size} slice{'s are' if gaps.size > 1 else ' is'} NaN between slices with values, the "
                f"first at {name} = {gaps[0]}; expected numbers, or NaN around the head alone"
            )
    line = f"{path}: {count} of {bad.size} voxels, at the border of the volume, are NaN: they are read as 0"
    _log.warning("%s", line)
    return (line,)
