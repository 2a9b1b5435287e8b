"""DICOM: which series is meant, and its images as one volume, read by pydicom and highdicom."""

from __future__ import annotations

import copy
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require, require_package
from SlicerUSSim.Logic.base.image_files import (
    ImageFile,
    remarks_withheld,
    require_readable_name,
    require_spacing,
    require_voxels,
)
from SlicerUSSim.Logic.base.reading import in_child, reader
from SlicerUSSim.Logic.base.segments import Segment, flattened, is_meaningful, ranked_codes
from SlicerUSSim.Logic.base.transforms import LPS_TO_RAS

_log = logging.getLogger(__name__)

#: Endings of files that may lack the DICOM prefix
_SUFFIXES = (".dcm", ".ima")
#: Fewer parallel images than this are a localiser
_LEAST_IMAGES = 10
#: Endings of files with a whole volume each
_ONE_FILE = (".nii", ".nii.gz", ".nrrd", ".mha", ".mgz")
#: Files in a folder and below it: some studies have 10 000 images, and each is opened
_MOST_FILES = 50_000
#: Spacing that differs by more than this share of the median, and tilt of the stack
_UNEVEN, _TILT_DEG = 0.2, 0.5
#: Direction cosines, and pixel spacings in mm, that differ by less are the same, as scanners round them
_SAME = 1e-3
#: Letters of a description that are used as a name
_LONGEST_TITLE = 60
#: What is read of a file to find its series
_TAGS = (
    "SOPClassUID", "Modality", "PatientID", "PatientName", "SeriesInstanceUID", "SeriesNumber", "SeriesDescription",
    "Rows", "Columns", "NumberOfFrames", "ImageOrientationPatient",
    "PerFrameFunctionalGroupsSequence",
)  # fmt: skip


@dataclass(frozen=True)
class Series:
    """The images of one series in a folder, of one orientation."""

    uid: str
    files: tuple[str, ...]
    number: str
    description: str
    #: "256x256"
    size: str
    #: PatientID and PatientName, only compared and never shown
    patient: tuple[str, str]
    #: Whether it has enough images for a volume, or frames with places
    is_volume: bool
    modality: str
    #: Whether its frames say where they are, and every file is a separate volume
    has_frames: bool
    is_compressed: bool

    def __str__(self) -> str:
        name = " ".join(part for part in (self.number, repr(self.description) if self.description else "") if part)
        return f"{name or self.uid}: {self.images} ({Path(self.files[0]).name})"

    @property
    def images(self) -> str:
        """Their number and size: "176 images of 256x256"."""
        return f"{len(self.files)} images of {self.size}"

    @property
    def size_text(self) -> str:
        """Its number and images, without descriptions and names of files, in which names of patients may be."""
        number = f"series {self.number}: " if self.number else ""
        return f"{number}{self.images}"

    @property
    def title(self) -> str:
        """Its description, as far as it can be a name, and its number: "T1 MPRAGE (series 3)"."""
        description = " ".join(re.sub(r"[^\w+.,() -]", " ", self.description).split())[:_LONGEST_TITLE].strip(" .")
        number = f"series {self.number}" if self.number else ""
        return f"{description} ({number})" if description and number else description or number or "DICOM"


@reader
def list_series(path: Path) -> list[Series]:
    """All DICOM series of a folder, by their numbers; those of the folders in it too, if it has none itself."""
    return _series_of(path)[0] or _series_of(path, recursive=True)[0]


@reader
def read_dicom(path: Path) -> ImageFile:
    """The volume of a DICOM folder, of a series to which one image belongs, or of a file with many frames.

    Labels of a DICOM SEG have their names; where its segments overlap, the last is taken, with a warning.
    Raises SimulationError for several volumes, with a list of them, and for images that are not one even stack.
    """
    require_package("highdicom", "highdicom", f"{path}: reading DICOM")
    require_readable_name(path)
    if path.is_dir():
        series = _only_volume(path)
    else:
        series = next((one for one in _series_of(path.parent)[0] if str(path) in one.files), None)
        if series is not None and len(series.files) > 1 and not series.has_frames:
            _log.warning("%s: is one image of a DICOM series, which is read: %s", path, series.size_text)
            _log.info("%s: %s", path, series)
    files = (str(path),) if series is None or (series.has_frames and not path.is_dir()) else series.files
    _log.info("%s: DICOM, %d files", path, len(files))
    is_compressed = _is_compressed(_header(path)) if series is None else series.is_compressed
    return (_read_compressed if is_compressed else _read_files)(path, files)


def is_dicom(file: Path) -> bool:
    """Whether a file has the DICOM prefix, or the suffix of the older ones that lack it."""
    if file.suffix.lower() in _SUFFIXES:
        return True
    with open(file, "rb") as opened:
        return opened.read(132)[128:] == b"DICM"


def _header(file: Path) -> Any:
    import pydicom

    with remarks_withheld():
        header = pydicom.dcmread(file, stop_before_pixels=True, force=True, specific_tags=[*_TAGS])
        for tag in _TAGS:
            header.get(tag)  # values are decoded when they are asked for
    return header


def _is_compressed(header: Any) -> bool:
    syntax = getattr(header.file_meta, "TransferSyntaxUID", None)
    return syntax is not None and not syntax.is_private and syntax.is_compressed and not syntax.is_deflated


# ---- series ----------------------------------------------------------------------------------------------------------


def _series_of(folder: Path, recursive: bool = False) -> tuple[list[Series], list[Path]]:
    """The series of images in a folder, by their numbers, and the DICOM files that cannot be read."""
    entries = list(islice(folder.rglob("*") if recursive else folder.iterdir(), _MOST_FILES + 1))
    require(
        len(entries) <= _MOST_FILES,
        f"{folder}: has more than {_MOST_FILES} files in it, give the folder of the series, or one of its images",
    )
    groups: dict[str, list[tuple[Path, Any, np.ndarray]]] = {}
    damaged = []
    for file in sorted(entries):
        if not file.is_file() or file.name.upper() == "DICOMDIR" or not is_dicom(file):
            continue
        try:
            header = _header(file)
            uid, is_image = str(header.SeriesInstanceUID), "Rows" in header
            cosines = np.array(header.get("ImageOrientationPatient") or [0.0], float)
            int(header.get("NumberOfFrames") or 1)
        except Exception:  # pydicom raises various exceptions for damaged files
            damaged.append(file)
            continue
        if is_image:
            groups.setdefault(uid, []).append((file, header, cosines))
    found = []
    for uid, images in groups.items():
        _, header, cosines = images[0]
        frames, has_frames = int(header.get("NumberOfFrames") or 1), "PerFrameFunctionalGroupsSequence" in header
        is_parallel = all(
            len(other) == len(cosines) == 6 and np.allclose(other, cosines, atol=_SAME) for _, _, other in images
        )
        found.append(
            Series(
                uid, tuple(str(file) for file, *_ in images), str(header.get("SeriesNumber") or ""),
                str(header.get("SeriesDescription") or ""), f"{header.get('Columns')}x{header.Rows}",
                (str(header.get("PatientID") or ""), str(header.get("PatientName") or "")),
                has_frames or (is_parallel and max(frames, len(images)) >= _LEAST_IMAGES),
                str(header.get("Modality") or ""), has_frames, any(_is_compressed(one) for _, one, _ in images),
            )
        )  # fmt: skip
    return sorted(found, key=lambda series: (len(series.number), series.number)), damaged


def _only_volume(folder: Path) -> Series:
    """The only series of a folder that is a volume, or else of the folders in it.

    Raises SimulationError if there is none, or if several are volumes: the message lists them.
    """
    found, damaged = _series_of(folder)
    if not found:  # as on a CD, whose images are in separate folders
        found, damaged = _series_of(folder, recursive=True)
        places = sorted({str(Path(file).parent) for series in found for file in series.files})
        require(bool(found), f"{folder}: has no DICOM series, nor have the folders in it{_other_images(folder)}")
        many = f"{len(places)} folder{'s' * (len(places) != 1)}"
        _log.warning("%s: has no DICOM images itself; those below it are read, in %s", folder, many)
        _log.info("%s: in %s", folder, ", ".join(places[:4]))
    volumes = found if len(found) == 1 else [series for series in found if series.is_volume]
    images = [series for series in volumes if series.modality != "SEG"]  # beside which archives keep their segments
    volumes = images or volumes
    if len(volumes) != 1:
        many = "; ".join(map(str, found[:12])) + ("; ..." if len(found) > 12 else "")
        patients = len({series.patient for series in found})
        of_whom = f" of {patients} different patients" if patients > 1 else ""
        raise SimulationError(
            f"{folder}: has {len(found)} DICOM series{of_whom}, {len(volumes) or 'none'} of them with {_LEAST_IMAGES} "
            f"or more parallel images; give the path of one image of the required series: {many}"
        )
    if damaged:
        names = ", ".join(file.name for file in damaged[:4]) + ", ..." * (len(damaged) > 4)
        _log.warning("%s: %s cannot be read as DICOM; export the series again if an image is missing", folder, names)
    if len(found) > 1:
        _log.warning("%s: has %d DICOM series; the only volume is read: %s", folder, len(found), volumes[0].size_text)
        _log.info("%s: %s", folder, volumes[0])
    return volumes[0]


def _other_images(folder: Path) -> str:
    """What to give instead of a folder with images of one file each, as TotalSegmentator writes its masks."""
    files = sorted(file.name for file in folder.iterdir() if file.name.lower().endswith(_ONE_FILE))
    if not files:
        return ""
    some = ", ".join(files[:3]) + (", ..." if len(files) > 3 else "")
    return f"; files there are separate images ({some}): give one, or one label map of several masks"


# ---- images ----------------------------------------------------------------------------------------------------------

#: How highdicom maps stored values to those of the scanner: by slope and intercept, and by nothing for a display
_VALUES: Mapping[str, Any] = {
    "apply_real_world_transform": False, "apply_modality_transform": None, "apply_voi_transform": False,
    "apply_presentation_lut": False, "apply_palette_color_lut": False, "apply_icc_profile": False,
}  # fmt: skip


@in_child
def _read_compressed(path: Path, files: Sequence[str]) -> ImageFile:
    """Decoders of JPEG and JPEG 2000 are where image libraries are broken into."""
    return _read_files(path, files)


def _read_files(path: Path, files: Sequence[str]) -> ImageFile:
    import pydicom

    with remarks_withheld():
        datasets = [pydicom.dcmread(file, force=True) for file in files]
        first = datasets[0]
        require("Rows" in first and "PixelData" in first, f"{path}: has no image, expected one with rows and pixels")
        frames = int(first.get("NumberOfFrames") or 1)
        require_voxels(path, [int(first.get(name) or 0) for name in ("Columns", "Rows")] + [max(frames, len(files))])
        for file, dataset in zip(files, datasets, strict=True):
            try:
                _ = dataset.pixel_array
            except Exception as error:  # decoders raise various exceptions
                reason = " ".join(str(error).split())[:300] or type(error).__name__
                raise SimulationError(f"{path}: {Path(file).name} cannot be read ({reason}); export it again") from None
        require(
            frames == 1 or len(files) == 1,
            f"{path}: has {len(files)} files with {frames} frames each; give one of them",
        )
        if "SegmentSequence" in first:
            return _segments(path, first)
        channels = int(first.get("SamplesPerPixel") or 1)
        require(channels == 1, f"{path}: has {channels} components per voxel, expected 1; export it in grey levels")
        try:
            found = _frames(path, first) if frames > 1 else _stack(path, files, datasets)
            return replace(found, modality=str(first.get("Modality") or ""))
        except (ValueError, RuntimeError, AttributeError) as error:  # what highdicom refuses
            raise SimulationError(f"{path}: is not one volume ({str(error).splitlines()[0]})") from None


def _stack(path: Path, files: Sequence[str], datasets: Sequence[Any]) -> ImageFile:
    """A series of one image per slice."""
    import highdicom

    patients = len({str(dataset.get("PatientID") or "") for dataset in datasets})
    require(patients == 1, f"{path}: its images are of {patients} patients by their PatientID, expected one patient")
    names = [f"{path}: {Path(file).name}" for file in files]
    first = datasets[0]
    cosines = [_numbers(one, "ImageOrientationPatient", 6, name) for one, name in zip(datasets, names, strict=True)]
    spacings = [_numbers(one, "PixelSpacing", 2, name) for one, name in zip(datasets, names, strict=True)]
    positions = [_numbers(one, "ImagePositionPatient", 3, name) for one, name in zip(datasets, names, strict=True)]
    sizes = [np.array([one.Rows, one.Columns, one.BitsAllocated]) for one in datasets]
    for what, values, tolerance in (
        ("ImageOrientationPatient", cosines, _SAME), ("PixelSpacing", spacings, _SAME),
        ("rows, columns and bits", sizes, 0.0),
    ):  # fmt: skip
        for name, value in zip(names, values, strict=True):
            require(
                np.abs(value - values[0]).max() <= tolerance,
                f"{name} has the {what} {value.tolist()}, and {Path(files[0]).name} {values[0].tolist()}, expected one "
                "in all images of a volume; put one volume into a separate folder",
            )
    require_spacing(names[0], spacings[0].tolist())
    _require_even(path, np.array(positions), cosines[0])
    for dataset in datasets:  # which highdicom compares to the last digit
        dataset.PixelSpacing, dataset.ImageOrientationPatient = first.PixelSpacing, first.ImageOrientationPatient
        dataset.FrameOfReferenceUID = first.get("FrameOfReferenceUID") or "1.2.3"  # some programs leave it out
    kind = np.float32 if int(first.BitsAllocated) <= 16 else np.float64
    volume = highdicom.get_volume_from_series(datasets, dtype=kind, rtol=_UNEVEN, **_VALUES)
    return _image(volume.array, volume.affine)


def _frames(path: Path, dataset: Any) -> ImageFile:
    """A file with many frames: enhanced MR, CT and ultrasound volumes, and older classes without places of frames."""
    import highdicom
    from pydicom.uid import EnhancedMRImageStorage

    if "PerFrameFunctionalGroupsSequence" not in dataset:
        slices, doubt = _as_slices(path, dataset)
        return replace(_stack(path, [str(path)] * len(slices), slices), doubts=(doubt,))
    shared = dataset.get("SharedFunctionalGroupsSequence") or [{}]
    positions, cosines = [], []
    groups = dataset.PerFrameFunctionalGroupsSequence
    parts = int(dataset.get("InConcatenationTotalNumber") or 1)
    require(
        parts == 1 and len(groups) == int(dataset.NumberOfFrames),
        f"{path}: has {len(groups)} of {dataset.NumberOfFrames} frames in the first of {parts} files, expected one "
        "file with all frames; export the volume as one",
    )
    stacks = {str(item.get("StackID")) for frame in groups for item in frame.get("FrameContentSequence") or ()}
    require(len(stacks) <= 1, f"{path}: has {len(stacks)} stacks of frames, expected one; export one of them")
    for number, frame in enumerate(groups, 1):
        name = f"{path}: frame {number}"
        for group in (frame, shared[0]):
            _name_as_of_patients(group)
        for found, macro, keyword, count in (
            (positions, "PlanePositionSequence", "ImagePositionPatient", 3),
            (cosines, "PlaneOrientationSequence", "ImageOrientationPatient", 6),
        ):
            items = frame.get(macro) or shared[0].get(macro) or [{}]
            found.append(_numbers(items[0], keyword, count, name))
    require(
        np.abs(np.array(cosines) - cosines[0]).max() <= _SAME,
        f"{path}: its frames have several orientations, expected one stack; export one of them",
    )
    _require_even(path, np.array(positions), cosines[0])
    dataset.FrameOfReferenceUID = dataset.get("FrameOfReferenceUID") or "1.2.3"
    dataset.SOPClassUID = EnhancedMRImageStorage  # whose frames highdicom looks for, of whatever modality
    for measures in (item for group in (*groups, shared[0]) for item in group.get("PixelMeasuresSequence") or ()):
        measures.pop("SpacingBetweenSlices", None)  # the places of frames count
    kind = np.float32 if int(dataset.BitsAllocated) <= 16 else np.float64
    image = highdicom.Image.from_dataset(dataset, copy=False)
    volume = image.get_volume(dtype=kind, rtol=_UNEVEN, **_VALUES)
    return _image(volume.array, volume.affine)


def _name_as_of_patients(group: Any) -> None:
    """Give the places of frames in an ultrasound volume, in its own frame of reference, the names of other images."""
    from pydicom.dataset import Dataset

    for macro, keyword in (("PlanePosition", "ImagePosition"), ("PlaneOrientation", "ImageOrientation")):
        of_volume = group.get(f"{macro}VolumeSequence")
        if of_volume:
            item = Dataset()
            setattr(item, f"{keyword}Patient", of_volume[0].get(f"{keyword}Volume"))
            setattr(group, f"{macro}Sequence", [item])


def _as_slices(path: Path, dataset: Any) -> tuple[list[Any], str]:
    """The frames of a class without places as images, evenly spaced, which is returned as a doubt."""
    from pydicom.uid import ExplicitVRLittleEndian

    step = abs(float(dataset.get("SpacingBetweenSlices") or dataset.get("SliceThickness") or 0.0))
    require(step > 0, f"{path}: its frames have neither places nor SpacingBetweenSlices; a volume needs one")
    first = _numbers(dataset, "ImagePositionPatient", 3, str(path))
    cosines = _numbers(dataset, "ImageOrientationPatient", 6, str(path))
    pixels = dataset.pixel_array
    del dataset.PixelData, dataset.NumberOfFrames
    slices = [copy.deepcopy(dataset) for _ in pixels]
    for number, (one, values) in enumerate(zip(slices, pixels, strict=True)):
        one.ImagePositionPatient = (first + number * step * np.cross(cosines[:3], cosines[3:])).tolist()
        one.PixelData, one.file_meta.TransferSyntaxUID = values.tobytes(), ExplicitVRLittleEndian
    return slices, f"its frames have no places, read as {step:g} mm apart, towards the normal; check left and right"


def _segments(path: Path, dataset: Any) -> ImageFile:
    """A DICOM SEG as a label map; where segments overlap, the last is on top."""
    import highdicom

    for measures in dataset.SharedFunctionalGroupsSequence[0].get("PixelMeasuresSequence") or ():
        # Slices without a segment have no frames
        measures.SpacingBetweenSlices = measures.get("SpacingBetweenSlices") or measures.get("SliceThickness")
    image: Any = highdicom.seg.Segmentation.from_dataset(dataset, copy=False)
    layers, volume, found = [], None, []
    for place, number in enumerate(image.segment_numbers):
        described = image.get_segment_description(number)
        kind = described.segmented_property_type
        name = str(described.segment_label or "")
        volume = image.get_volume(
            segment_numbers=[number], combine_segments=False, allow_missing_positions=True, dtype=np.float32
        )
        layers.append((np.asarray(volume.array)[..., 0] > 0.5).astype(np.uint8))
        codes = ranked_codes(
            described.segmented_property_category.value, kind.value,
            _first_code(kind, "SegmentedPropertyTypeModifierCodeSequence"),
            _first_code(described, "AnatomicRegionSequence"),
        )  # fmt: skip
        found.append(Segment(name if is_meaningful(name) else kind.meaning, place, 1, int(number), codes))
    require(volume is not None, f"{path}: has no segments")
    voxel_ml = float(abs(np.linalg.det(volume.affine[:3, :3])) / 1000.0)  # type: ignore[union-attr]
    if len(layers[0]) == 1:  # the slice beside it has no segment
        layers = [np.pad(layer, ((0, 1), (0, 0), (0, 0))) for layer in layers]
    labels = flattened(np.stack(layers, axis=-1), found, voxel_ml, str(path))
    codes = {one.label: one.codes for one in found}
    names = {one.label: one.name for one in found}
    return replace(_image(labels, volume.affine), label_names=names, label_codes=codes)  # type: ignore[union-attr]


def _first_code(item: Any, sequence: str) -> str:
    """The value of the first code in a sequence; "" without."""
    return str(item[sequence][0].CodeValue) if item.get(sequence) else ""


def _image(array: np.ndarray, affine: np.ndarray) -> ImageFile:
    """Slices, rows and columns in highdicom's LPS, with slices in the order of their normal, as ITK has them."""
    matrix = LPS_TO_RAS @ np.asarray(affine)[:, [2, 1, 0, 3]]
    if np.linalg.det(matrix[:3, :3]) < 0:
        array = array[::-1]
        matrix[:3, 3] += matrix[:3, 2] * (len(array) - 1)
        matrix[:3, 2] *= -1.0
    whole = np.rint(array)
    if np.array_equal(whole, array):
        is_short = whole.min() >= -(2**15) and whole.max() < 2**15
        array = whole.astype(np.int16 if is_short else np.int32)
    return ImageFile(np.ascontiguousarray(array), matrix)


def _numbers(dataset: Any, keyword: str, count: int, name: str) -> np.ndarray:
    """The numbers of an element. Raises SimulationError if they are missing or not finite."""
    try:
        found = np.array(dataset.get(keyword), float).ravel()
    except (TypeError, ValueError):
        found = np.array([np.nan])
    require(
        len(found) == count and np.isfinite(found).all(),
        f"{name} has no {keyword} of {count} numbers, which a volume needs",
    )
    return found


def _require_even(path: Path, positions: np.ndarray, cosines: np.ndarray) -> None:
    """Raise SimulationError for positions (n, 3), in mm, with gaps, at one place, or in a tilted stack."""
    axes = cosines.reshape(2, 3)
    require(
        np.abs(axes @ axes.T - np.eye(2)).max() < _SAME,
        f"{path}: has the ImageOrientationPatient {cosines.tolist()}, expected two perpendicular unit vectors",
    )
    if len(positions) < 2:
        return
    normal = np.cross(axes[0], axes[1])
    along = np.sort(positions @ normal)
    steps = np.diff(along)
    usual = float(np.median(steps))
    repeated = int((steps < _SAME).sum())
    require(
        repeated == 0,
        f"{path}: {repeated} of {len(along)} images lie at the place of another one (several times, echoes or "
        "coils); put one volume into a separate folder",
    )
    wide = np.flatnonzero(np.abs(steps - usual) > _UNEVEN * usual)
    off = np.abs(along - np.linspace(along[0], along[-1], len(along)))  # errors below this share may add up
    require(
        len(wide) > 0 or off.max() <= _UNEVEN * usual,
        f"{path}: slices are unevenly spaced, {steps.min():.4g} to {steps.max():.4g} mm, up to {off.max():.3g} mm away "
        "from an even stack; resample it to one, for example with 3D Slicer",
    )
    if len(wide):
        at = int(wide[0])
        raise SimulationError(
            f"{path}: slices are missing or unevenly spaced at {len(wide)} place{'s' * (len(wide) > 1)}, first "
            f"{steps[at]:.4g} mm after slice {at + 1} of {len(along)}, expected {usual:.4g} mm; export the series again"
        )
    direction = positions[np.argmax(positions @ normal)] - positions[np.argmin(positions @ normal)]
    tilt = float(np.degrees(np.arccos(min(abs(direction @ normal) / np.linalg.norm(direction), 1.0))))
    require(
        tilt <= _TILT_DEG,
        f"{path}: the stack is tilted by {tilt:.1f} degrees against its slices (gantry tilt), expected a rectangular "
        "volume; resample it, for example with dcm2niix or 3D Slicer",
    )
