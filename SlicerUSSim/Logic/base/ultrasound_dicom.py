"""A DICOM ultrasound image, of one frame or several, from pixels and their scale."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping

import numpy as np

from SlicerUSSim.Logic.base.version import __version__

#: What DICOM demands and is not known
_UNKNOWN = ("PatientID", "PatientBirthDate", "PatientSex", "StudyID", "AccessionNumber", "ReferringPhysicianName",
            "PatientOrientation")  # fmt: skip


def ultrasound_dicom(
    frames: np.ndarray, edges: tuple[int, ...], pixel_mm: tuple[float, float], *, patient: str = "", time: str = "",
    frame_ms: float = 1.0, has_texts: bool = False,
) -> bytes:  # fmt: skip
    """The content of a file with one calibrated region.

    Parameters
    ----------
    frames : (n, rows, columns) uint8 grey levels, or (n, rows, columns, 3) RGB.
    edges : first column and row of the region, and the last ones.
    pixel_mm : (column, row) millimetres per pixel in it.
    patient : name; by default none.
    time : of the images, "2026-11-29T12:30:00"; by default unknown.
    frame_ms : between frames.
    has_texts : whether the pixels show texts.
    """
    from pydicom import uid
    from pydicom.dataset import FileMetaDataset

    count, rows, columns = frames.shape[:3]
    is_grey = frames.ndim == 3
    kind = uid.UltrasoundImageStorage if count == 1 else uid.UltrasoundMultiFrameImageStorage
    of_study, of_series, of_image = (uid.generate_uid() for _ in range(3))
    date, time = time[:10].replace("-", ""), time[11:19].replace(":", "")
    pixels = frames.tobytes()
    region = {
        "RegionSpatialFormat": 1, "RegionDataType": 1, "RegionFlags": 0,  # two-dimensional, tissue, opaque
        "RegionLocationMinX0": edges[0], "RegionLocationMinY0": edges[1], "RegionLocationMaxX1": edges[2],
        "RegionLocationMaxY1": edges[3], "PhysicalUnitsXDirection": 3, "PhysicalUnitsYDirection": 3,  # cm
        "PhysicalDeltaX": 0.1 * pixel_mm[0], "PhysicalDeltaY": 0.1 * pixel_mm[1],
    }  # fmt: skip
    values = {
        "SpecificCharacterSet": "ISO_IR 192", "SOPClassUID": kind, "SOPInstanceUID": of_image,
        "StudyInstanceUID": of_study, "SeriesInstanceUID": of_series, "SeriesNumber": 1, "InstanceNumber": 1,
        "PatientName": re.sub(r"[\\^=]", " ", patient)[:64], **dict.fromkeys(_UNKNOWN, ""),
        "StudyDate": date, "SeriesDate": date, "ContentDate": date, "StudyTime": time, "SeriesTime": time,
        "ContentTime": time, "Modality": "US", "SeriesDescription": "Simulated ultrasound (SlicerUSSim)",
        "DerivationDescription": "Simulated from images of the patient, not acquired by a scanner",
        "ImageType": ["DERIVED", "SECONDARY", "", "0001"],  # a two-dimensional image
        "Manufacturer": "SlicerUSSim", "ManufacturerModelName": "Simulator", "SoftwareVersions": __version__,
        "BurnedInAnnotation": "YES" if has_texts else "NO", "LossyImageCompression": "00",
        "SequenceOfUltrasoundRegions": [_dataset(region)],
        "SamplesPerPixel": 1 if is_grey else 3, "PhotometricInterpretation": "MONOCHROME2" if is_grey else "RGB",
        **({} if is_grey else {"PlanarConfiguration": 0}), "Rows": rows,
        "Columns": columns, "BitsAllocated": 8, "BitsStored": 8, "HighBit": 7, "PixelRepresentation": 0,
        "PixelData": pixels + b"\0" * (len(pixels) % 2),
    }  # fmt: skip
    if count > 1:
        values |= {"NumberOfFrames": count, "FrameTime": f"{frame_ms:.6g}", "FrameIncrementPointer": 0x00181063}
    data, buffer = _dataset(values), io.BytesIO()
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = uid.ExplicitVRLittleEndian
    data.save_as(buffer, enforce_file_format=True)
    return buffer.getvalue()


def _dataset(values: Mapping[str, object]):
    from pydicom.dataset import Dataset

    made = Dataset()
    for name, value in values.items():
        setattr(made, name, value)
    return made
