"""DICOM files as scanners and archives write them, by pydicom and highdicom, for tests."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pydicom
from pydicom.data import get_testdata_file
from pydicom.dataset import Dataset
from pydicom.uid import generate_uid

from SlicerUSSim.Logic import Volume

#: A series as tests write it, with its place; of positive numbers, as in an MRI
SERIES = Volume(
    np.random.default_rng(0).integers(0, 900, (12, 16, 20)).astype(np.int16),
    np.array([[-1.25, 0, 0, 10], [0, -1.5, 0, 20], [0, 0, 3, 0], [0, 0, 0, 1.0]]),
)


def images(volume: Volume = SERIES, change: Callable[[Dataset, int], object] | None = None, **values) -> list[Dataset]:
    """One MR image per slice of a volume with the axes of LPS; `change` gets each with its number."""
    series, reference, (columns, rows, step) = generate_uid(), generate_uid(), volume.spacing_mm.tolist()
    template = pydicom.dcmread(get_testdata_file("MR_small.dcm"))
    found = []
    for number, slice_ in enumerate(volume.array.astype(np.int16)):
        one = copy.deepcopy(template)
        one.Rows, one.Columns = slice_.shape
        one.PixelSpacing, one.SpacingBetweenSlices, one.SliceThickness = [rows, columns], step, step
        place = volume.ijk_to_ras @ [0, 0, number, 1]
        one.ImageOrientationPatient, one.ImagePositionPatient = [1, 0, 0, 0, 1, 0], [-place[0], -place[1], place[2]]
        one.SeriesInstanceUID, one.FrameOfReferenceUID, one.InstanceNumber = series, reference, number + 1
        one.SOPInstanceUID = one.file_meta.MediaStorageSOPInstanceUID = generate_uid()
        one.PixelRepresentation, one.BitsStored, one.HighBit = 1, 16, 15
        one.RescaleSlope, one.RescaleIntercept, one.PixelData = 1, 0, slice_.tobytes()
        for name, value in values.items():
            setattr(one, name, value)
        if change is not None:
            change(one, number)
        found.append(one)
    return found


def save(folder: Path, datasets: list[Dataset], names: list[int] | None = None) -> Path:
    """Write datasets as 0.dcm, 1.dcm and so on, or by other numbers."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, one in zip(names or range(len(datasets)), datasets, strict=True):
        one.save_as(folder / f"{number}.dcm")
    return folder


def enhanced(datasets: list[Dataset], order: list[int] | None = None, modality: str = "MR") -> Dataset:
    """One file with many frames, as highdicom converts a series, with the frames in another `order`."""
    from highdicom import legacy

    for one in datasets:
        one.SOPClassUID = "1.2.840.10008.5.1.4.1.1.2" if modality == "CT" else "1.2.840.10008.5.1.4.1.1.4"
        one.file_meta.MediaStorageSOPClassUID, one.Modality = one.SOPClassUID, modality
    convert = getattr(legacy, f"LegacyConvertedEnhanced{modality}Image")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = convert(datasets, generate_uid(), 1, generate_uid(), 1)
    if order is not None:
        frames, pixels = found.PerFrameFunctionalGroupsSequence, found.pixel_array
        found.PerFrameFunctionalGroupsSequence = [frames[n] for n in order]
        found.PixelData = pixels[order].tobytes()
    return found


def as_ultrasound(found: Dataset) -> Dataset:
    """An enhanced image as an enhanced ultrasound volume, whose frames have their places in the volume."""
    found.SOPClassUID = found.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.6.2"
    found.Modality = "US"
    for group in (*found.PerFrameFunctionalGroupsSequence, found.SharedFunctionalGroupsSequence[0]):
        for macro, keyword in (("PlanePosition", "ImagePosition"), ("PlaneOrientation", "ImageOrientation")):
            if f"{macro}Sequence" in group:
                item = Dataset()
                setattr(item, f"{keyword}Volume", getattr(group[f"{macro}Sequence"][0], f"{keyword}Patient"))
                setattr(group, f"{macro}VolumeSequence", [item])
                delattr(group, f"{macro}Sequence")
    return found


def segmentation(masks: np.ndarray, labels: list[tuple[str, str]], kind: str = "BINARY") -> Dataset:
    """A DICOM SEG of SERIES from (slices, rows, columns, segments); `labels` are names and SNOMED CT concepts."""
    import highdicom
    from pydicom.sr.codedict import codes

    described = [
        highdicom.seg.SegmentDescription(
            n, name, codes.SCT.MorphologicallyAbnormalStructure, getattr(codes.SCT, concept), "MANUAL"
        )
        for n, (name, concept) in enumerate(labels, 1)
    ]
    return highdicom.seg.Segmentation(
        images(), masks, kind, described, generate_uid(), 1, generate_uid(), 1, "maker", "model", "1", "1"
    )
