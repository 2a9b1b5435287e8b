"""DICOM series: which one is meant, and whether its slices are complete."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require

_log = logging.getLogger(__name__)

#: Fewer parallel images than this are a localiser
_LEAST_IMAGES = 10
#: Endings of files with a whole volume each
_ONE_FILE = (".nii", ".nii.gz", ".nrrd", ".mha", ".mgz")
#: Folders below one that is searched for images
_MOST_FOLDERS = 1000
#: Spacing that differs by more than this share of the median, and tilt of the stack, that ITK would silently ignore
_UNEVEN, _TILT_DEG = 0.2, 0.5


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
        _log.warning("%s: has no DICOM images itself; those below it are read, in %s", folder, ", ".join(places[:4]))
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
        _log.warning("%s: has %d DICOM series; the only volume is read: %s", folder, len(found), stacks[0])
    return _read(stacks[0], str(folder))


def series_with(file: Path) -> Series | None:
    """The DICOM series of several images, in its folder, to which a file belongs; None if there is no such series."""
    if not is_dicom(file):
        return None
    uid = _value(_header(str(file)), "0020|000e")
    for series in _series_of(file.parent):
        # ITK's identifiers begin with the series instance UID.
        names = {Path(name).name for name in series.files}
        if series.uid.startswith(uid) and file.name in names and len(series.files) > 1:
            return series
    return None


def read_series(series: Series, name: str):
    """The SimpleITK image of a series, which is said."""
    _log.warning("%s: is one image of a DICOM series, which is read: %s", name, series)
    return _read(series, name)


def is_dicom(file: Path) -> bool:
    """Whether a file has the DICOM prefix, or the suffix of the older ones that lack it."""
    if file.suffix.lower() in (".dcm", ".ima"):
        return True
    with open(file, "rb") as opened:
        return opened.read(132)[128:] == b"DICM"


def _series_of(folder: Path, recursive: bool = False) -> list[Series]:
    import SimpleITK as sitk

    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    folders = [folder]
    if recursive:
        folders = [place for place in sorted(folder.rglob("*")) if place.is_dir()]
        require(len(folders) <= _MOST_FOLDERS, f"{folder}: has {len(folders)} folders in it, give that of the series")
    uids = {uid for place in folders for uid in sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(place))}
    return sorted(
        (Series.of(folder, uid, recursive) for uid in uids), key=lambda series: (len(series.number), series.number)
    )


def _read(series: Series, name: str):
    import SimpleITK as sitk

    _log.info("%s: DICOM series %s with %d files", name, series.uid, len(series.files))
    _check_slices(series, name)
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(series.files)
    try:
        return reader.Execute()
    except RuntimeError as error:
        raise SimulationError(f"{name}: cannot be read ({str(error).strip().splitlines()[-1]})") from None


def _check_slices(series: Series, name: str) -> None:
    """Raise SimulationError for slices of several patients, missing or repeated ones, and a tilted stack.

    ITK would make a wrong volume of them.
    """
    if len(series.files) < 3:
        return
    headers = [_header(file) for file in series.files]
    patients = len({_value(header, "0010|0020") for header in headers})
    require(patients == 1, f"{name}: its images are of {patients} patients by their PatientID, expected one patient")
    places = [_numbers(header, "0020|0032", 3) for header in headers]
    axes = _numbers(headers[0], "0020|0037", 6)
    if axes is None or any(place is None for place in places):
        return
    normal = np.cross(axes[:3], axes[3:])
    positions = np.array(places)
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
            f"{steps[at]:.4g} mm after slice {at + 1} of {len(along)}, expected {usual:.4g} mm"
            f"{_not_readable(series)}; export the series again"
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


def _not_readable(series: Series) -> str:
    """Names the DICOM files beside those of a series that have no readable header: "; IM12 cannot be read"."""
    beside = sorted({Path(file).parent for file in series.files})
    known = {Path(file) for folder in beside for other in _series_of(folder) for file in other.files}
    bad = [
        file.name
        for folder in beside
        for file in sorted(folder.iterdir())
        if file.is_file() and file not in known and is_dicom(file)
    ]
    return f"; {', '.join(bad[:4])}{' and others' * (len(bad) > 4)} cannot be read" if bad else ""


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
