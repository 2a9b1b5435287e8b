"""DICOM ultrasound images from frames that a page has composed: image, banner, scale and measurements in the pixels."""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Mapping

import numpy as np
from PIL import Image

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.version import __version__
from SlicerUSSim.Logic.mrml.taken_image import TakenImage

#: Bytes of all pixels
_MOST_BYTES = 2**30
#: Numbers that a page sends: edges of the image region in pixels (x1, y1 behind the last), mm per pixel, ms per frame
_NAMES = ("x0", "y0", "x1", "y1", "mm_x", "mm_y", "frame_ms")
#: What DICOM demands and is not known
_UNKNOWN = ("PatientID", "PatientBirthDate", "PatientSex", "StudyID", "AccessionNumber", "ReferringPhysicianName",
            "PatientOrientation")  # fmt: skip


def ultrasound_file(sent: Mapping[str, bytes], taken: TakenImage) -> bytes:
    """One frame or several as a DICOM file of the patient and time of `taken`, with one calibrated region.

    `sent` are the frames (PNG) by name, in their order, and "": JSON with the numbers of _NAMES.
    Raises SimulationError for frames of several sizes, and for a region that is not in them.
    """
    try:
        about = json.loads(sent.get("", b""))
        x0, y0, x1, y1, mm_x, mm_y, frame_ms = (float(about[name]) for name in _NAMES)
        images = [Image.open(io.BytesIO(content)) for name, content in sent.items() if name]
        sizes = {image.size for image in images}
        require(len(sizes) == 1, f"the frames have the sizes {sorted(sizes)}, expected one size")
        width, height = sizes.pop()
        require(3 * width * height * len(images) <= _MOST_BYTES, f"the frames are {len(images)}, expected fewer")
        frames = np.stack([np.asarray(image.convert("RGB")) for image in images])
    except (ValueError, LookupError, TypeError, OSError) as error:
        raise SimulationError(f"the frames of the page cannot be read ({error})") from None
    scale = mm_x, mm_y, frame_ms if len(images) > 1 else 1.0
    is_scale = all(0 < value < math.inf for value in scale)
    is_region = 0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height
    require(is_region and is_scale, f"the region of the image is {about}, expected one within {width}x{height} pixels")
    return _file(frames, tuple(map(round, (x0, y0, x1 - 1, y1 - 1))), scale, taken)


def _file(frames: np.ndarray, edges: tuple[int, ...], scale: tuple[float, ...], taken: TakenImage) -> bytes:
    """Of (n, rows, columns, 3) uint8 frames; `edges` are the first column and row of the region, and the last ones."""
    from pydicom import uid
    from pydicom.dataset import FileMetaDataset

    count, rows, columns, _ = frames.shape
    mm_x, mm_y, frame_ms = scale
    kind = uid.UltrasoundImageStorage if count == 1 else uid.UltrasoundMultiFrameImageStorage
    of_study, of_series, of_image = (uid.generate_uid() for _ in range(3))
    date, time = taken.time[:10].replace("-", ""), taken.time[11:19].replace(":", "")
    pixels = frames.tobytes()
    region = {
        "RegionSpatialFormat": 1, "RegionDataType": 1, "RegionFlags": 0,  # two-dimensional, tissue, opaque
        "RegionLocationMinX0": edges[0], "RegionLocationMinY0": edges[1], "RegionLocationMaxX1": edges[2],
        "RegionLocationMaxY1": edges[3], "PhysicalUnitsXDirection": 3, "PhysicalUnitsYDirection": 3,  # cm
        "PhysicalDeltaX": 0.1 * mm_x, "PhysicalDeltaY": 0.1 * mm_y,
    }  # fmt: skip
    values = {
        "SpecificCharacterSet": "ISO_IR 192", "SOPClassUID": kind, "SOPInstanceUID": of_image,
        "StudyInstanceUID": of_study, "SeriesInstanceUID": of_series, "SeriesNumber": 1, "InstanceNumber": 1,
        "PatientName": re.sub(r"[\\^=]", " ", taken.patient)[:64], **dict.fromkeys(_UNKNOWN, ""),
        "StudyDate": date, "SeriesDate": date, "ContentDate": date, "StudyTime": time, "SeriesTime": time,
        "ContentTime": time, "Modality": "US", "SeriesDescription": "Simulated ultrasound (SlicerUSSim)",
        "DerivationDescription": "Simulated from images of the patient, not acquired by a scanner",
        "ImageType": ["DERIVED", "SECONDARY", "", "0001"],  # a two-dimensional image
        "Manufacturer": "SlicerUSSim", "ManufacturerModelName": "Simulator", "SoftwareVersions": __version__,
        "BurnedInAnnotation": "YES", "LossyImageCompression": "00", "SequenceOfUltrasoundRegions": [_dataset(region)],
        "SamplesPerPixel": 3, "PhotometricInterpretation": "RGB", "PlanarConfiguration": 0, "Rows": rows,
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
