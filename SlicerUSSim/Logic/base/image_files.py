"""One image in a file of NIfTI, NRRD, MGH, MINC, MetaImage and others, read by the library of its format.

Every reading is then compared, in one function, with what the header says by another route: two descriptions of the
voxels that contradict each other cause a warning with both, and the one that the format's standard prefers is used.
"""

from __future__ import annotations

import gzip
import importlib.util
import itertools
import logging
import math
import os
import re
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require, require_package, shown_path
from SlicerUSSim.Logic.base.reading import in_child, reader
from SlicerUSSim.Logic.base.segments import segments_of
from SlicerUSSim.Logic.base.transforms import LPS_TO_RAS, is_singular

_log = logging.getLogger(__name__)

#: Voxels of the largest image: 2000 slices of 1024 x 1024
MOST_VOXELS = 2**31
#: Millimetres that voxels may have along an axis, and those that suggest that the file is in metres
_SPACING_MM, _LIKE_METRES = (0.01, 50.0), (1e-4, 9e-3)
#: Two descriptions of the voxels differ if they move a corner of the image by more than this, or sizes by this share
_SAME_MM, _SAME_SPACING = 0.1, 0.01
#: Cosine between two axes up to which they are perpendicular: float32 headers round to 1e-7, text to 1e-6
_MOST_SKEW = 1e-4
_NIFTI_SUFFIXES = (".nii", ".nii.gz", ".hdr", ".img")
#: The first number of a NIfTI-2 file, the size of its header (https://nifti.nimh.nih.gov/nifti-2)
_NIFTI2_HEADER = 540
#: Millimetres per unit of length: the lower three bits of NIfTI's xyzt_units (nifti1.h), and NRRD's "space units"
_NIFTI_UNITS = {0: 1.0, 1: 1000.0, 2: 1.0, 3: 0.001}
_NRRD_UNITS = {
    "": 1.0, "mm": 1.0, "millimeter": 1.0, "m": 1000.0, "meter": 1000.0, "cm": 10.0, "centimeter": 10.0, "um": 0.001,
    "µm": 0.001, "micron": 0.001, "micrometer": 0.001,
}  # fmt: skip
#: NRRD's anatomical spaces, as signs that turn coordinates into RAS (http://teem.sourceforge.net/nrrd/format.html)
_NRRD_SPACES = {
    "right-anterior-superior": (1, 1, 1), "ras": (1, 1, 1),
    "left-anterior-superior": (-1, 1, 1), "las": (-1, 1, 1),
    "left-posterior-superior": (-1, -1, 1), "lps": (-1, -1, 1),
}  # fmt: skip
#: The longest XML text of a label table
_LONGEST_TABLE = 4 * 2**20
_LONGEST_HEADER, _CHUNK = 2**26, 2**16
#: Value of ElementDataFile for a file per slice: a pattern with one number, and first, last and step of that
_NUMBERED_FILES = r"[^%]*%(0?[0-9]{1,2})?d[^%]*?([ \t]+[0-9]{1,9}){0,3}"


@dataclass(frozen=True, eq=False)
class ImageFile:
    """What is in a file with an image, and what its header says of the voxels by other routes."""

    #: (k, j, i), (t, k, j, i) or (j, i), with the components of a voxel as a further, last axis
    array: np.ndarray
    #: (4, 4) from homogeneous voxel indices (i, j, k, 1) to RAS millimetres
    ijk_to_ras: np.ndarray
    has_components: bool = False
    #: Texts of the header
    header: Mapping[str, str] = field(default_factory=dict)
    #: {field of the header: voxels along i, j, k}, {field: their size in mm}, and {field: (4, 4) as ijk_to_ras}
    sizes: Mapping[str, Sequence[int]] = field(default_factory=dict)
    spacings: Mapping[str, Sequence[float]] = field(default_factory=dict)
    #: The first of these is used
    matrices: Mapping[str, np.ndarray] = field(default_factory=dict)
    label_names: Mapping[int, str] = field(default_factory=dict)
    #: {label: SNOMED CT codes, the most special first}
    label_codes: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    #: One line each, without the name of the file
    doubts: tuple[str, ...] = ()
    #: Of DICOM: "CT", "MR", ...
    modality: str = ""


@reader
def read_image(path: Path) -> ImageFile:
    """The image of a file, of any format but DICOM and VTI, compared with its header.

    Raises SimulationError, naming the file, for a missing or unreadable one, for complex numbers, and for axes that
    are not perpendicular.
    """
    require_readable_name(path)
    require(path.is_file(), f"{path}: no such file")
    require(path.stat().st_size > 0, f"{path}: cannot be read as an image (it is empty, 0 bytes)")
    try:
        found = _reader_of(path)(path)
    except SimulationError:
        raise
    except Exception as error:  # the libraries raise various exceptions for damaged files
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise SimulationError(f"{path}: cannot be read as an image ({reason[:200]})") from error
    return checked_image(path, found)


def _reader_of(path: Path) -> Callable[[Path], ImageFile]:
    """The reader of a format; without its library, as in 3D Slicer, ITK."""
    name, has_nibabel = path.name.lower(), importlib.util.find_spec("nibabel") is not None
    if name.endswith(_NIFTI_SUFFIXES) and has_nibabel:
        return _read_nifti
    if name.endswith((".mgz", ".mgh")) and has_nibabel:
        return _read_mgh
    with path.open("rb") as file:
        start = file.read(4)
    if (start == b"NRRD" or name.endswith((".nrrd", ".nhdr"))) and importlib.util.find_spec("nrrd") is not None:
        with path.open("rb") as file:
            has_list = re.search(rb"^data ?file:.*(LIST|%)", file.read(_CHUNK), re.MULTILINE)
        return _read_by_itk if has_list else _read_nrrd  # pynrrd reads no voxels in several files
    return _read_minc1 if name.endswith(".mnc") and start[:3] == b"CDF" else _read_by_itk


def checked_image(path: Path, found: ImageFile) -> ImageFile:
    """An image whose voxels are finite, after it was compared with its header; doubts are logged as warnings.

    Raises SimulationError for voxels that are not real numbers, for a size other than the header's, and for axes that
    are not perpendicular.
    """
    array, doubts = found.array, list(found.doubts)
    if found.has_components and array.shape[-1] == 1:
        array, found = array[..., 0], replace(found, has_components=False)
    if array.ndim - found.has_components == 4 and array.shape[0] == 1:
        array = array[0]  # a time axis of length one
    require(not np.iscomplexobj(array), f"{path}: holds complex numbers, expected real ones; save its magnitude")
    space = array.shape[::-1][1:] if found.has_components else array.shape[::-1]
    for name, size in found.sizes.items():
        require(
            tuple(size[:3]) == space[: len(size[:3])],
            f"{path}: {name} says {_times(size)} voxels, and {_times(space)} were read; copy or export it again",
        )
    axes = found.ijk_to_ras[:3, :3]
    lengths = np.linalg.norm(axes, axis=0)
    require(bool((np.isfinite(lengths) & (lengths > 0)).all()), f"{path}: its voxels have the size {_times(lengths)}")
    cosines = (axes / lengths).T @ (axes / lengths)
    require(
        np.abs(cosines - np.eye(3)).max() < _MOST_SKEW,
        f"{path}: its axes are not perpendicular, as after an affine registration that was written into the header; "
        "resample it to a regular grid",
    )
    for name, spacing in found.spacings.items():
        if len(spacing) == 3 and not np.allclose(spacing, lengths, rtol=_SAME_SPACING, atol=0.0):
            doubts.append(
                f"its {name} says voxels of {_times(spacing)} mm, its axes {_times(lengths)} mm, which is used"
            )
    used = next(iter(found.matrices), "")
    for name, matrix in found.matrices.items():
        apart = _distance_mm(matrix, found.ijk_to_ras, (*space, 1, 1)[:3])
        if not apart <= _SAME_MM:
            doubts.append(
                f"its {name} puts it {apart:.1f} mm away from its {used}, which is used: i, j, k go towards "
                f"{_lies(matrix)} by the {name}, {_lies(found.ijk_to_ras)} by the {used}; check left and right"
            )
    bad = array.size - int(np.isfinite(array).sum()) if array.dtype.kind == "f" else 0
    if bad:
        require(bad < array.size, f"{path}: no voxel is a finite number, expected an image")
        array = np.where(np.isfinite(array), array, array.dtype.type(0))
        doubts.append(f"{bad} of {array.size} voxels are not finite numbers; they are read as 0")
    for doubt in doubts:
        _log.warning("%s: %s", path, doubt)
    return replace(found, array=array, doubts=tuple(f"{path}: {doubt}" for doubt in doubts))


def _lies(matrix: np.ndarray) -> str:
    """Directions of i, j, k and place of the first voxel: "RAS from (-90, -126, -72) mm"."""
    return f"{axis_letters(matrix)} from ({', '.join(f'{mm:.4g}' for mm in matrix[:3, 3])}) mm"


def axis_letters(ijk_to_ras: np.ndarray) -> str:
    """Approximate directions of the axes i, j, k of a (4, 4) ijk_to_ras: "RAS", "LPS", ..."""
    axes = ijk_to_ras[:3, :3].T
    main = np.abs(axes).argmax(axis=1)
    return "".join("RAS"[n] if axis[n] > 0 else "LPI"[n] for axis, n in zip(axes, main, strict=True))


def _times(values: Sequence[float] | np.ndarray) -> str:
    return "x".join(f"{value:.4g}" if isinstance(value, float) else str(value) for value in values)


def _distance_mm(one: np.ndarray, other: np.ndarray, size: Sequence[int]) -> float:
    """Largest distance between the positions of a corner of the image under two (4, 4) maps."""
    corners = np.array([[*corner, 1] for corner in itertools.product(*((0, n - 1) for n in size[:3]))], float)
    return float(np.linalg.norm((corners @ (one - other).T)[:, :3], axis=1).max())


def require_readable_name(path: str | os.PathLike) -> None:
    """Raise SimulationError for a name that ITK and VTK cannot take: with bytes that are not UTF-8, or with NUL."""
    text, shown = str(path), shown_path(path)
    require(shown == text, f"{shown}: its name has bytes that are not UTF-8, expected a name in UTF-8")
    require("\0" not in text, f"{text!r}: its name has a NUL, expected a file name")


def require_voxels(path: str | os.PathLike, size: Sequence[int]) -> None:
    """Raise SimulationError for an image of more voxels than are read."""
    many = math.prod(int(n) for n in size)
    require(many <= MOST_VOXELS, f"{path}: has {_times(size)} voxels, expected at most {MOST_VOXELS} in all")


def require_spacing(name: str, spacing_mm: Sequence[float]) -> None:
    """Raise SimulationError for voxels smaller than .01 mm or larger than 50 mm, such as lengths in another unit."""
    low, high = _SPACING_MM
    if all(low <= mm <= high for mm in spacing_mm):
        return
    hint = ""
    if all(_LIKE_METRES[0] <= mm <= _LIKE_METRES[1] for mm in spacing_mm):
        hint = "; its lengths look like metres: set the unit, or multiply them by 1000"
    elif all(low <= mm / 1000.0 <= high for mm in spacing_mm):
        hint = "; its lengths look like micrometres: set the unit, or divide them by 1000"
    shown = " x ".join(f"{mm:.3g}" for mm in spacing_mm)
    raise SimulationError(f"{name}: has voxels of {shown} mm, expected {low:g} to {high:g} mm along every axis{hint}")


def content_of(path: Path) -> bytes:
    """What is in a file, decompressed if it is gzip, whatever its name is. Raises SimulationError if it is damaged."""
    content = path.read_bytes()
    if content[:2] != b"\x1f\x8b":
        return content
    try:
        return gzip.decompress(content)
    except EOFError:
        raise SimulationError(f"{path}: is incomplete, the end is missing; copy or export it again") from None
    except (OSError, zlib.error):
        raise SimulationError(f"{path}: its compressed content is damaged; copy or export it again") from None


@contextmanager
def remarks_withheld() -> Iterator[None]:
    """Keep quiet what libraries remark about headers, which are checked here."""
    loggers = [logging.getLogger(name) for name in ("nibabel.global", "pydicom", "highdicom")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _native(array: np.ndarray) -> np.ndarray:
    """In the byte order of this computer, and in that of C."""
    return np.ascontiguousarray(array.astype(array.dtype.newbyteorder("="), copy=False))


# ---- nibabel ---------------------------------------------------------------------------------------------------------


def _read_nifti(path: Path) -> ImageFile:
    import nibabel

    doubts = []
    with remarks_withheld():  # what nibabel corrects in a header is compared below
        if path.suffix.lower() in (".hdr", ".img"):
            image: Any = nibabel.load(path)  # type: ignore[attr-defined]
            if not isinstance(image, nibabel.Nifti1Pair):  # Analyze 7.5, which has no orientation
                return replace(_read_by_itk(path), doubts=("has no orientation; check left and right",))
            raw = image.header
        else:
            content = content_of(path)
            require(len(content) > 4, f"{path}: cannot be read as an image (it has {len(content)} bytes of content)")
            is_second = _NIFTI2_HEADER in (int.from_bytes(content[:4], order) for order in ("little", "big"))
            kind = nibabel.Nifti2Image if is_second else nibabel.Nifti1Image
            raw = kind.header_class(content[: kind.header_class.sizeof_hdr], check=False)
            require_voxels(path, [int(n) for n in raw["dim"][1 : max(int(raw["dim"][0]), 0) + 1]])
            image = kind.from_bytes(content)
            first, stored = int(raw["vox_offset"]), int(np.prod(image.shape)) * raw.get_data_dtype().itemsize
            least = kind.header_class.sizeof_hdr + 4
            require(first >= least, f"{path}: vox_offset is {first}, expected {least} or more, behind the header")
            more = len(content) - first - stored
            if more > 0:
                doubts.append(f"has {more} bytes more than the {_times(image.shape)} voxels of its header")
        array = np.asanyarray(image.dataobj)
        if float(raw["pixdim"][0]) < 0:  # nifti1.h: any number below 0 is -1
            image.header["pixdim"][0] = -1.0
        qform = np.array(image.header.get_qform())
    if array.dtype.names:  # colours
        array = np.stack([array[name] for name in array.dtype.names], axis=-1)[..., None, :]
    elif array.dtype == np.float64 and np.issubdtype(image.get_data_dtype(), np.integer):
        array = array.astype(np.float32)  # scaled
    unit = int(raw["xyzt_units"]) & 7
    scale = np.diag([*[_NIFTI_UNITS.get(unit, 1.0)] * 3, 1.0])
    pixdim = np.asarray(raw["pixdim"][1:4], float) * scale[0, 0]
    matrices = {}
    if int(raw["sform_code"]) > 0:
        matrices["sform"] = scale @ raw.get_sform()
    if int(raw["qform_code"]) > 0 and pixdim.all():
        matrices["qform"] = scale @ qform
    for name in [name for name, one in matrices.items() if not np.isfinite(one).all() or is_singular(one)]:
        del matrices[name]
        doubts.append(f"its {name} has no three axes and is not used")
    if not matrices:  # as ITK and 3D Slicer read it
        matrices["size"] = LPS_TO_RAS @ np.diag([*np.abs(pixdim), 1.0])
        doubts.append("has no orientation (no sform and no qform), read as LPS; check left and right")
    require(
        "sform" in matrices or pixdim.all(),
        f"{path}: pixdim is {_times(pixdim)} and there is no sform, expected the size of its voxels",
    )
    if float(raw["scl_slope"]) == 0.0 and float(raw["scl_inter"]) != 0.0 and np.isfinite(raw["scl_inter"]):
        doubts.append(f"scl_slope is 0 and scl_inter {float(raw['scl_inter']):g}, read without both, as NIfTI requires")
    if unit not in _NIFTI_UNITS:
        doubts.append(f"its unit of length has the code {unit}, which NIfTI does not know, read as millimetres")
    elif scale[0, 0] != 1.0:
        _log.info("%s: lengths are converted to millimetres, by %g", path, scale[0, 0])
    has_components = array.ndim == 5 and array.shape[3] == 1 and array.shape[4] > 1
    array = array.reshape([*array.shape[:3], *(n for n in array.shape[3:] if n > 1)])
    turned = np.moveaxis(array, 3, 0).T if has_components else array.T
    used = next(iter(matrices))
    return ImageFile(
        _native(turned), matrices[used], has_components, spacings={"pixdim": tuple(pixdim.tolist())}, matrices=matrices,
        label_names=_label_table(image), doubts=tuple(doubts),
    )  # fmt: skip


def add_label_table(path: Path, names: Mapping[int, str]) -> None:
    """Add the names of labels to a NIfTI file, as _label_table reads them; without nibabel it is not changed."""
    if importlib.util.find_spec("nibabel") is None:
        return
    import nibabel
    from nibabel.nifti1 import Nifti1Extension

    root = ElementTree.Element("CaretExtension")
    table = ElementTree.SubElement(ElementTree.SubElement(root, "VolumeInformation", Index="0"), "LabelTable")
    for label, name in names.items():
        ElementTree.SubElement(table, "Label", Key=str(label), Red="1", Green="1", Blue="1", Alpha="1").text = name
    image = nibabel.Nifti1Image.from_bytes(content_of(path))
    image.header.extensions.append(Nifti1Extension(0, ElementTree.tostring(root)))
    content = image.to_bytes()
    path.write_bytes(gzip.compress(content, mtime=0) if path.name.endswith(".gz") else content)


def _label_table(image) -> dict[int, str]:
    """Names in a label table of Connectome Workbench's XML, which TotalSegmentator writes into a NIfTI extension."""
    names = {}
    for extension in image.header.extensions:
        content = extension.get_content()
        text = content.decode("utf-8", "replace") if isinstance(content, bytes) else str(content)
        if "<LabelTable" not in text or "<!" in text.replace("<![CDATA[", "") or len(text) > _LONGEST_TABLE:
            continue  # with a document type a small text can expand without limit
        try:
            for label in ElementTree.fromstring(text.strip("\0 \n")).iter("Label"):
                names[int(label.get("Key", "0"))] = (label.text or "").strip()
        except (ElementTree.ParseError, ValueError) as error:
            _log.info("names in the header cannot be read (%s)", error)
    return {label: name for label, name in names.items() if label}


def _read_mgh(path: Path) -> ImageFile:
    """FreeSurfer's MGH and MGZ, whose millimetres are RAS of the scanner."""
    import nibabel

    image: Any = nibabel.MGHImage.from_bytes(content_of(path))
    array = np.asanyarray(image.dataobj)
    if array.ndim == 4 and array.shape[3] == 1:
        array = array[..., 0]
    return ImageFile(_native(array.T), np.array(image.affine))


def _read_minc1(path: Path) -> ImageFile:
    """MINC 1, which is NetCDF; MINC 2 is HDF5, which ITK reads."""
    require_package("nibabel", "nibabel", f"{path}: reading MINC 1")
    import nibabel

    image: Any = nibabel.Minc1Image.from_filename(path)
    values = np.asarray(image.dataobj)
    whole = values.round()
    if np.issubdtype(image.get_data_dtype(), np.integer) and np.abs(values - whole).max() < 1e-3:
        values = whole.astype(np.int32)  # nibabel always scales to floating point
    # nibabel's indices are (z, y, x) as in the file; its millimetres are in MNI world coordinates, which are RAS.
    return ImageFile(values, np.array(image.affine)[:, [2, 1, 0, 3]])


# ---- pynrrd ----------------------------------------------------------------------------------------------------------


def _read_nrrd(path: Path) -> ImageFile:
    import nrrd

    values = nrrd.read_header(str(path))
    require_voxels(path, values["sizes"])
    array, values = nrrd.read(str(path), index_order="C")
    header = {key: value for key, value in values.items() if isinstance(value, str)}
    segments = segments_of(header, str(path))
    count, spacings, doubts = array.ndim, {}, []
    kinds = [str(kind) for kind in values.get("kinds", ["domain"] * count)]
    steps = np.full((count, 3), np.nan)
    vectors, lengths = values.get("space directions"), values.get("spacings")
    for axis, vector in enumerate([] if vectors is None else vectors):
        if np.size(vector) in (2, 3):
            steps[axis] = np.resize([*vector, 0.0], 3)
    is_space = [kind in ("domain", "space") for kind in kinds] if vectors is None else np.isfinite(steps).all(axis=1)
    axes = np.flatnonzero(is_space)[:3].tolist()
    lengths = np.full(count, np.nan) if lengths is None else np.asarray(lengths, float)
    # Lists are images one after another, and the layers of segments; axis n of the file is axis -1 - n of the array.
    slow = [
        axis for axis in range(count) if axis not in axes and kinds[axis] in ("list", "time", "domain") and not segments
    ]
    fast = [axis for axis in range(count) if axis not in axes and axis not in slow]
    array = array.transpose([count - 1 - axis for axis in (*slow[::-1], *axes[::-1], *fast[::-1])])
    units = {str(unit).lower().removesuffix("s") for unit in values.get("space units") or values.get("units") or [""]}
    scale = _NRRD_UNITS.get(min(units), 1.0)
    if len(units) > 1 or not units <= _NRRD_UNITS.keys():
        scale = 1.0
        doubts.append(f"its space units are {', '.join(sorted(units))}, expected one of mm, cm, m, um; read as mm")
    matrix = np.eye(4)
    for place, axis in enumerate(axes):
        if np.isfinite(steps[axis]).all():
            matrix[:3, place] = steps[axis]
        elif np.isfinite(lengths[axis]):
            matrix[place, place] = lengths[axis]
    if not np.isfinite(np.where(np.isfinite(lengths[axes]), lengths[axes], steps[axes, 0])).all() and len(axes) == 3:
        doubts.append("its header has no size of voxels, read as 1 mm")
    if np.isfinite(lengths[axes]).all():
        spacings["spacings"] = tuple((lengths[axes] * scale).tolist())
    if values.get("space origin") is not None:
        matrix[:3, 3] = np.resize([*values["space origin"], 0.0], 3)
    signs = _NRRD_SPACES.get(str(values.get("space", "")).lower().removesuffix("-time"))
    if signs is None and len(axes) == 3:
        space = f"its space is {values['space']}, which is not anatomical" if "space" in values else "it has no space"
        doubts.append(f"{space}, read as LPS, as 3D Slicer does; check left and right")
    matrix[:3] *= scale
    return ImageFile(
        _native(array), np.diag([*(signs or (-1, -1, 1)), 1.0]) @ matrix, bool(fast), header, spacings=spacings,
        label_names={segment.label: segment.name for segment in segments},
        label_codes={segment.label: segment.codes for segment in segments}, doubts=tuple(doubts),
    )  # fmt: skip


# ---- ITK, whose child process ends with it at damaged files ----------------------------------------------------------


@in_child
def _read_by_itk(path: Path) -> ImageFile:
    import SimpleITK as sitk

    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    is_metaimage = path.suffix.lower() in (".mha", ".mhd")
    sizes, spacings, held = _metaimage_says(path) if is_metaimage else ({}, {}, None)
    file = sitk.ImageFileReader()
    file.SetFileName(str(path))
    try:
        file.ReadImageInformation()
        require_voxels(path, file.GetSize())
        image = file.Execute()
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1].removeprefix("sitk::ERROR: ")
        if "Unable to determine ImageIO reader" in reason:  # SimpleITK's words
            reason = "its content has no known format, expected NIfTI, NRRD, MetaImage, MGH, MINC, VTK or DICOM"
        if "No such file" in reason:  # ITK's words for voxels that it could not read
            reason = "its voxels are missing or incomplete; copy or export it again"
        raise SimulationError(f"{path}: cannot be read as an image ({reason})") from None
    found, doubts = of_sitk(image), ()
    if held is not None and held != found.array.nbytes:
        line = f"has {held} bytes of voxels, expected {found.array.nbytes} for {_times(image.GetSize())} voxels"
        require(held > found.array.nbytes, f"{path}: {line}; copy or export it again")
        doubts = (f"{line}: check size and type in its header",)
    if is_metaimage and not spacings and image.GetDimension() > 2 and "Seq_Frame0000_Timestamp" not in found.header:
        doubts = (*doubts, "its header has no size of voxels, read as 1 mm")
    return replace(found, sizes=sizes, spacings=spacings, doubts=doubts)


def of_sitk(image) -> ImageFile:
    """What is in a SimpleITK image (LPS); a time axis of length one is left out."""
    import SimpleITK as sitk

    if image.GetDimension() == 4 and image.GetSize()[3] == 1:
        image = image[..., 0]
    dimensions = image.GetDimension()
    index_to_lps, count = np.eye(4), min(dimensions, 3)
    axes = np.reshape(image.GetDirection(), (dimensions, dimensions)) * np.array(image.GetSpacing())
    index_to_lps[:count, :count] = axes[:count, :count]
    index_to_lps[:count, 3] = image.GetOrigin()[:count]
    header = {key: image.GetMetaData(key) for key in image.GetMetaDataKeys()}
    has_components = image.GetNumberOfComponentsPerPixel() > 1
    return ImageFile(sitk.GetArrayFromImage(image), LPS_TO_RAS @ index_to_lps, has_components, header)


def _metaimage_says(path: Path) -> tuple[dict[str, list[int]], dict[str, list[float]], int | None]:
    """Size and spacing in the header of a MetaImage, and the bytes of its voxels; None if they are in several files.

    MetaIO leaves voxels that are missing as the memory was, and hands the name of numbered files to printf.
    """
    fields: dict[str, str] = {}
    with path.open("rb") as file:
        while "ElementDataFile" not in fields:
            line = file.readline()
            require(line and file.tell() <= _LONGEST_HEADER, f"{path}: its header has no line ElementDataFile")
            name, _, value = line.decode("utf-8", "replace").partition("=")
            fields[name.strip()] = value.strip()
        pattern, content = fields["ElementDataFile"], file.read()
    require(
        "%" not in pattern or re.fullmatch(_NUMBERED_FILES, pattern),
        f"{path}: ElementDataFile is {pattern[:80]!r}, expected a file, LOCAL, LIST or numbered files, as "
        "'slice%03d.raw 1 9 1'",
    )
    try:
        size = [int(part) for part in fields.get("DimSize", "").split()]
        spacing = [float(part) for part in fields.get("ElementSpacing", fields.get("ElementSize", "")).split()]
    except ValueError:
        raise SimulationError(f"{path}: DimSize or ElementSpacing has no numbers, expected one for each axis") from None
    require(
        len(size) in (2, 3, 4) and min(size) > 0, f"{path}: DimSize is {_times(size)}, expected 2 to 4 sizes above 0"
    )
    require_voxels(path, size)
    voxels = path.parent / pattern
    if pattern != "LOCAL":
        content = voxels.read_bytes() if voxels.is_file() else b""
    held = len(content) if content and "HeaderSize" not in fields else None
    if fields.get("CompressedData", "").lower() in ("true", "t", "1"):
        try:
            held = len(zlib.decompress(content))
        except zlib.error:
            raise SimulationError(f"{path}: its compressed content is damaged; copy or export it again") from None
    return {"DimSize": size}, {"ElementSpacing": spacing[:3]} if len(spacing) == len(size) >= 3 else {}, held
