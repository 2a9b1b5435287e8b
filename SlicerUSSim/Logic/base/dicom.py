"""DICOM series: which one is meant, and whether its slices are complete."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.dicom_elements import is_compressed, require_sound_elements, require_whole_pixels
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.headers import MOST_VOXELS, is_dicom, require_held, require_spacing
from SlicerUSSim.Logic.base.reading import reader

_log = logging.getLogger(__name__)

#: Fewer parallel images than this are a localiser
_LEAST_IMAGES = 10
#: Endings of files with a whole volume each
_ONE_FILE = (".nii", ".nii.gz", ".nrrd", ".mha", ".mgz")
#: Folders below one that is searched for images, and files and folders in a folder and below it: some studies have
#: 10 000 images, and each is opened
_MOST_FOLDERS, _MOST_FILES = 1000, 50_000
#: Spacing that differs by more than this share of the median, and tilt of the stack, that ITK would silently ignore
_UNEVEN, _TILT_DEG = 0.2, 0.5
#: Direction cosines that differ by less are the same, as scanners round them
_SAME_AXES = 1e-3
#: Letters of a description that are used as a name
_LONGEST_TITLE = 60
#: The part of a file in which modality and series are
_HEADER_BYTES = 2**16


@dataclass(frozen=True)
class _Tag:
    """A tag with numbers, and its name in messages."""

    tag: str
    count: int
    name: str


_POSITION, _ORIENTATION = _Tag("0020|0032", 3, "position"), _Tag("0020|0037", 6, "orientation")
_SPACING = _Tag("0028|0030", 2, "pixel spacing")
_ROWS, _COLUMNS = _Tag("0028|0010", 1, "number of rows"), _Tag("0028|0011", 1, "number of columns")
#: How pixels are stored: ITK reads all slices as it reads the first
_STORED = tuple(
    _Tag(f"0028|{element}", 1, name)
    for element, name in (
        ("0100", "BitsAllocated"), ("0101", "BitsStored"), ("0103", "PixelRepresentation"), ("0002", "SamplesPerPixel")
    )
)  # fmt: skip


@dataclass(frozen=True)
class Series:
    """One series of a folder."""

    uid: str
    files: tuple[str, ...]
    number: str
    description: str
    size: str
    #: PatientID and PatientName, only compared and never shown
    patient: tuple[str, str]

    @classmethod
    def of(cls, folder: Path, uid: str, recursive: bool = False) -> Series:
        """The series of this identifier in a folder, with `recursive` also in the folders in it."""
        import SimpleITK as sitk

        files = tuple(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), uid, False, recursive))
        header = _header(files[0])
        size = f"{_value(header, '0028|0011') or '?'}x{_value(header, '0028|0010') or '?'}"
        patient = _value(header, "0010|0020"), _value(header, "0010|0010")
        return cls(uid, files, _value(header, "0020|0011"), _value(header, "0008|103e"), size, patient)

    def __str__(self) -> str:
        name = " ".join(part for part in (self.number, repr(self.description) if self.description else "") if part)
        return f"{name or self.uid}: {len(self.files)} images of {self.size} ({Path(self.files[0]).name})"

    @property
    def size_text(self) -> str:
        """Its number and images, without descriptions and names of files, in which names of patients may be."""
        number = f"series {self.number}: " if self.number else ""
        return f"{number}{len(self.files)} images of {self.size}"

    @property
    def title(self) -> str:
        """Its description, as far as it can be a name, and its number."""
        description = " ".join(re.sub(r"[^\w+.,() -]", " ", self.description).split())[:_LONGEST_TITLE].strip(" .")
        number = f"series {self.number}" if self.number else ""
        return f"{description} ({number})" if description and number else description or number or "DICOM"

    @property
    def is_stack(self) -> bool:
        """Whether it has enough images for a volume, all of one orientation."""
        if len(self.files) < _LEAST_IMAGES:
            return False
        orientations = [_numbers(_header(file), "0020|0037", 6) for file in (self.files[0], self.files[-1])]
        return all(one is not None for one in orientations) and np.allclose(*orientations, atol=1e-3)  # type: ignore


def _other_images(folder: Path) -> str:
    """What to give instead of a folder with images of one file each, as TotalSegmentator writes its masks."""
    files = sorted(file.name for file in folder.iterdir() if file.name.lower().endswith(_ONE_FILE))
    if not files:
        return ""
    some = ", ".join(files[:3]) + (", ..." if len(files) > 3 else "")
    return f"; files there are images of their own ({some}): give one, or one label map of several masks"


def read_dicom_folder(folder: Path):
    """The SimpleITK image of the only series of a folder that is a volume, or else of the folders in it.

    Raises SimulationError if there is none, or if several are volumes: the message lists them.
    """
    found = _series_of(folder)
    if not found:  # as on a CD, whose images are in folders of their own
        found = _series_of(folder, recursive=True)
        places = sorted({str(Path(file).parent) for series in found for file in series.files})
        require(bool(found), f"{folder}: has no DICOM series, nor have the folders in it{_other_images(folder)}")
        many = f"{len(places)} folder{'s' * (len(places) != 1)}"
        _log.warning("%s: has no DICOM images itself; those below it are read, in %s", folder, many)
        _log.info("%s: in %s", folder, ", ".join(places[:4]))
    stacks = found if len(found) == 1 else [series for series in found if series.is_stack]
    if len(stacks) != 1:
        many = "; ".join(map(str, found[:12])) + ("; ..." if len(found) > 12 else "")
        patients = len({series.patient for series in found})
        of_whom = f" of {patients} different patients" if patients > 1 else ""
        raise SimulationError(
            f"{folder}: has {len(found)} DICOM series{of_whom}, {len(stacks) or 'none'} of them with {_LEAST_IMAGES} "
            f"or more parallel images; give the path of one image of the required series: {many}"
        )
    if len(found) > 1:
        _log.warning("%s: has %d DICOM series; the only volume is read: %s", folder, len(found), stacks[0].size_text)
        _log.info("%s: %s", folder, stacks[0])
    return _read(stacks[0], str(folder))


@dataclass(frozen=True)
class FoundSeries:
    """A series of a folder, for a user who chooses."""

    #: Description and number, without anything about the patient: "T1 MPRAGE (series 3)"
    title: str
    #: Numbers and sizes of its images: "176 images of 256x256"
    images: str
    #: Paths of its files
    files: tuple[str, ...]
    #: Whether it has enough parallel images for a volume, or is one file with several
    is_volume: bool
    #: Number of the patient, from 0, among those of the folder
    patient: int


@reader
def list_series(path: Path) -> list[FoundSeries]:
    """All DICOM series of a folder, by their numbers; those of the folders in it too, if it has none itself."""
    found = _series_of(path) or _series_of(path, recursive=True)
    patients = list(dict.fromkeys(series.patient for series in found))
    return [
        FoundSeries(
            series.title, f"{len(series.files)} images of {series.size}", series.files,
            series.is_stack or len(found) == 1, patients.index(series.patient),
        )
        for series in found
    ]  # fmt: skip


def series_with(file: Path) -> Series | None:
    """The DICOM series of several images, in its folder, to which a file belongs; None if there is no such series."""
    if not is_dicom(file):
        return None
    require_sound_elements(file)
    uid = _value(_header(str(file)), "0020|000e")
    for series in _series_of(file.parent):
        # ITK's identifiers begin with the series instance UID.
        names = {Path(name).name for name in series.files}
        if series.uid.startswith(uid) and file.name in names and len(series.files) > 1:
            return series
    return None


def has_compressed(path: Path) -> bool:
    """Whether DICOM images in a folder, or those beside one, are compressed.

    They are read in a child process: decoders of JPEG and JPEG 2000 are where image libraries are broken into, and
    print several lines about a damaged one.
    """
    if not path.is_dir() and not is_dicom(path):
        return False
    beside = path.rglob("*") if path.is_dir() else path.parent.iterdir()
    return any(file.is_file() and is_compressed(file) for file in islice(beside, _MOST_FILES))


def read_series(series: Series, name: str):
    """The SimpleITK image of a series, which is said."""
    _log.warning("%s: is one image of a DICOM series, which is read: %s", name, series.size_text)
    _log.info("%s: %s", name, series)
    return _read(series, name)


def _series_of(folder: Path, recursive: bool = False) -> list[Series]:
    import SimpleITK as sitk

    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    folders = [folder]
    entries = list(islice(folder.rglob("*") if recursive else folder.iterdir(), _MOST_FILES + 1))
    require(
        len(entries) <= _MOST_FILES,
        f"{folder}: has more than {_MOST_FILES} files in it, give the folder of the series, or one of its images",
    )
    for file in entries:
        if file.is_file():
            require_sound_elements(file)
    if recursive:
        folders = sorted(place for place in entries if place.is_dir())
        require(len(folders) <= _MOST_FOLDERS, f"{folder}: has {len(folders)} folders in it, give that of the series")
    uids = {uid for place in folders for uid in sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(place))}
    return sorted(
        (Series.of(folder, uid, recursive) for uid in uids), key=lambda series: (len(series.number), series.number)
    )


def _read(series: Series, name: str):
    import SimpleITK as sitk

    _log.info("%s: DICOM series %s with %d files", name, series.uid, len(series.files))
    headers = [_header(file) for file in series.files]
    _require_bounded(series, headers, name)
    _check_slices(series, headers, name)
    for file in series.files:
        require_whole_pixels(Path(file))
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(series.files)
    try:
        return reader.Execute()
    except RuntimeError as error:
        raise SimulationError(f"{name}: cannot be read ({str(error).strip().splitlines()[-1]})") from None


def _require_bounded(series: Series, headers: list[dict[str, str]], name: str) -> None:
    """Raise SimulationError for more voxels than are read, or than the files can hold, before any is allocated."""
    values = 0
    for file, header in zip(series.files, headers, strict=True):
        rows, columns = (_required(file, header, tag, name)[0] for tag in (_ROWS, _COLUMNS))
        # Frames and samples: 1 where they are not said
        more = [_numbers(header, tag, 1) for tag in ("0028|0008", "0028|0002")]
        values += int(rows * columns * np.prod([max(one[0], 1.0) for one in more if one is not None and one[0] < 1e9]))
    size = f"{len(series.files)} images of {series.size}"
    require(values <= MOST_VOXELS, f"{name}: has {values} voxels in {size}, expected at most {MOST_VOXELS} in all")
    require_held(name, f"{size}, {values}", values, [Path(file) for file in series.files])


def _check_slices(series: Series, headers: list[dict[str, str]], name: str) -> None:
    """Raise SimulationError for slices of several patients, missing or repeated ones, a tilted stack, and for slices
    without a place, an orientation or a pixel spacing, or of several.

    ITK would make a wrong volume of them.
    """
    if len(series.files) < 2:  # one with many frames has the places of all of them elsewhere in its header
        return
    patients = len({_value(header, "0010|0020") for header in headers})
    require(patients == 1, f"{name}: its images are of {patients} patients by their PatientID, expected one patient")
    damaged = _damaged_files(series, _value(headers[0], "0008|0060"))
    require(
        not damaged,
        f"{name}: {', '.join(damaged[:4])}{' and others' * (len(damaged) > 4)} cannot be read, which may be "
        f"{'an image' if len(damaged) == 1 else 'images'} of the series of {len(series.files)}; export the series "
        f"again, or remove {'it' if len(damaged) == 1 else 'them'} if not",
    )
    positions = _places(series, headers, name)
    axes = _required(series.files[0], headers[0], _ORIENTATION, name)
    normal = np.cross(axes[:3], axes[3:])
    along = np.sort(positions @ normal)
    steps = np.diff(along)
    usual = float(np.median(steps))
    repeated = int((steps < 1e-3).sum())
    require(
        repeated == 0,
        f"{name}: {repeated} of {len(along)} images lie at the place of another one (several times, echoes or "
        "coils); put one volume into a folder of its own",
    )
    wide = np.flatnonzero(np.abs(steps - usual) > _UNEVEN * usual)
    if len(wide):
        at = int(wide[0])
        raise SimulationError(
            f"{name}: slices are missing or unevenly spaced at {len(wide)} place{'s' * (len(wide) > 1)}, first "
            f"{steps[at]:.4g} mm after slice {at + 1} of {len(along)}, expected {usual:.4g} mm; export the series again"
        )
    first, last = positions[np.argmin(positions @ normal)], positions[np.argmax(positions @ normal)]
    direction = last - first
    cosine = abs(direction @ normal) / (np.linalg.norm(direction) * np.linalg.norm(normal))
    tilt = float(np.degrees(np.arccos(min(cosine, 1.0))))
    require(
        tilt <= _TILT_DEG,
        f"{name}: the stack is tilted by {tilt:.1f} degrees against its slices (gantry tilt), expected a rectangular "
        "volume; resample it, for example with dcm2niix or 3D Slicer",
    )


def _places(series: Series, headers: list[dict[str, str]], name: str) -> np.ndarray:
    """(n, 3) positions of images, whose orientation, pixel spacing and size are found to be the same."""
    first = series.files[0], headers[0]
    for file, header in zip(series.files, headers, strict=True):
        cosines = _required(file, header, _ORIENTATION, name).reshape(2, 3)
        require(
            np.abs(cosines @ cosines.T - np.eye(2)).max() < _SAME_AXES,
            f"{name}: {Path(file).name} has the orientation {_value(header, _ORIENTATION.tag)}, expected directions of "
            "rows and columns that are perpendicular and have length 1",
        )
        require_spacing(f"{name}: {Path(file).name}", tuple(_required(file, header, _SPACING, name)))
        exact = [(wanted, 0.0) for wanted in (_ROWS, _COLUMNS, *_STORED)]
        for wanted, tolerance in ((_ORIENTATION, _SAME_AXES), (_SPACING, 1e-3), *exact):
            if wanted in _STORED and _value(header, wanted.tag) == _value(headers[0], wanted.tag):
                continue  # all of them may lack one that has a default
            here, there = _required(file, header, wanted, name), _required(*first, wanted, name)
            require(
                np.abs(here - there).max() <= tolerance,
                f"{name}: {Path(file).name} has the {wanted.name} {_value(header, wanted.tag)}, and "
                f"{Path(first[0]).name} {_value(headers[0], wanted.tag)}, expected one in all images of a volume; put "
                "one volume into a folder of its own",
            )
    return np.array([_required(*image, _POSITION, name) for image in zip(series.files, headers, strict=True)])


def _required(file: str, header: dict[str, str], wanted: _Tag, name: str) -> np.ndarray:
    """The numbers of a tag; raises SimulationError if they are missing or no numbers."""
    found = _numbers(header, wanted.tag, wanted.count)
    if found is None or not np.isfinite(found).all():
        raise SimulationError(
            f"{name}: {Path(file).name} has the {wanted.name} {_value(header, wanted.tag)!r} (DICOM tag "
            f"{wanted.tag.replace('|', ',')}), expected {wanted.count} number{'s' * (wanted.count > 1)}; without it "
            "there is no volume"
        )
    return found


def _damaged_files(series: Series, modality: str) -> list[str]:
    """Names of the DICOM files beside those of a series that belong to it, or may, and have no readable image.

    Other objects without an image, such as reports and presentation states, have another modality.
    """
    beside = sorted({Path(file).parent for file in series.files})
    known = {Path(file) for folder in beside for other in _series_of(folder) for file in other.files}
    return [
        file.name
        for folder in beside
        for file in sorted(folder.iterdir())
        if file.is_file() and file not in known and is_dicom(file) and _may_be_of(file, series, modality)
    ]


def _may_be_of(file: Path, series: Series, modality: str) -> bool:
    if file.name.upper() == "DICOMDIR":
        return False
    with file.open("rb") as opened:
        start = opened.read(_HEADER_BYTES)
    _, tag, value = start.partition(b"\x08\x00\x60\x00")  # the modality, after four bytes with its length
    if not tag or len(value) < 4 + len(modality):
        return True  # it ends before
    uid = series.uid.split("_")[0].rstrip(".")
    return value[4:].startswith(modality.encode()) and (uid.encode() in start or b"\x20\x00\x0e\x00" not in start)


def _header(file: str) -> dict[str, str]:
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    reader.SetFileName(str(file))
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise SimulationError(f"{file}: cannot be read as DICOM ({str(error).strip().splitlines()[-1]})") from None
    return {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys()}


def _value(header: dict[str, str], key: str) -> str:
    return header.get(key, "").strip().strip("\0")


def _numbers(header: dict[str, str], key: str, count: int) -> np.ndarray | None:
    try:
        numbers = np.array([float(part) for part in _value(header, key).split("\\")])
    except ValueError:
        return None
    return numbers if len(numbers) == count else None
