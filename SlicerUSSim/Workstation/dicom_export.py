"""DICOM ultrasound images from frames that a page has composed: image, banner, scale and measurements in the pixels."""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Mapping

import numpy as np
from PIL import Image, UnidentifiedImageError

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.version import __version__
from SlicerUSSim.Logic.mrml.taken_image import TakenImage

#: Bytes of all pixels
_MOST_BYTES = 2**30
#: Numbers that a page sends: edges of the image region in pixels (x1, y1 behind the last), mm per pixel, ms per frame
_NAMES = ("x0", "y0", "x1", "y1", "mm_x", "mm_y", "frame_ms")


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
        require(
            3 * width * height * len(images) <= _MOST_BYTES, f"{len(images)} frames of {width}x{height} are too many"
        )
        frames = np.stack([np.asarray(image.convert("RGB")) for image in images])
    except (ValueError, LookupError, TypeError, UnidentifiedImageError, OSError) as error:
        raise SimulationError(f"the frames of the page cannot be read ({error})") from None
    is_region = 0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height and all(map(math.isfinite, (x1, y1)))
    is_scale = all(math.isfinite(value) and value > 0 for value in (mm_x, mm_y, frame_ms if len(frames) > 1 else 1.0))
    require(is_region and is_scale, f"the region of the image is {about}, expected one within {width}x{height} pixels")
    return _file(frames, tuple(map(round, (x0, y0, x1 - 1, y1 - 1))), (mm_x, mm_y), frame_ms, taken)


def _file(
    frames: np.ndarray, region: tuple[int, ...], mm: tuple[float, float], frame_ms: float, taken: TakenImage
) -> bytes:
    """Of (n, rows, columns, 3) uint8 frames, with (first column, first row, last column, last row) of the region."""
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.uid import (
        ExplicitVRLittleEndian,
        UltrasoundImageStorage,
        UltrasoundMultiFrameImageStorage,
        generate_uid,
    )

    is_grey, is_single = bool((frames == frames[..., :1]).all()), len(frames) == 1
    date, time = taken.time[:10].replace("-", ""), taken.time[11:19].replace(":", "")
    data = Dataset()
    data.SpecificCharacterSet = "ISO_IR 192"
    data.SOPClassUID = UltrasoundImageStorage if is_single else UltrasoundMultiFrameImageStorage
    data.SOPInstanceUID, data.StudyInstanceUID, data.SeriesInstanceUID = (generate_uid() for _ in range(3))
    data.PatientName = re.sub(r"[\\^=]", " ", taken.patient)[:64]
    data.PatientID = data.PatientBirthDate = data.PatientSex = data.StudyID = ""
    data.AccessionNumber = data.ReferringPhysicianName = data.PatientOrientation = ""
    data.StudyDate = data.SeriesDate = data.ContentDate = date
    data.StudyTime = data.SeriesTime = data.ContentTime = time
    data.Modality, data.SeriesNumber, data.InstanceNumber = "US", 1, 1
    data.SeriesDescription = "Simulated ultrasound (SlicerUSSim)"
    data.DerivationDescription = "Simulated from images of the patient, not acquired by a scanner"
    data.ImageType = ["DERIVED", "SECONDARY", "", "0001"]  # a two-dimensional image
    data.Manufacturer, data.ManufacturerModelName, data.SoftwareVersions = "SlicerUSSim", "Simulator", __version__
    data.BurnedInAnnotation, data.LossyImageCompression = "YES", "00"
    data.SamplesPerPixel = 1 if is_grey else 3
    data.PhotometricInterpretation = "MONOCHROME2" if is_grey else "RGB"
    if not is_grey:
        data.PlanarConfiguration = 0
    if not is_single:
        data.NumberOfFrames, data.FrameTime = len(frames), f"{frame_ms:.6g}"
        data.FrameIncrementPointer = 0x00181063  # FrameTime
        data.RecommendedDisplayFrameRate = max(round(1e3 / frame_ms), 1)
    _, data.Rows, data.Columns, _ = frames.shape
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 8, 8, 7, 0
    place = Dataset()
    place.RegionSpatialFormat, place.RegionDataType, place.RegionFlags = 1, 1, 0  # two-dimensional, tissue, opaque
    place.RegionLocationMinX0, place.RegionLocationMinY0 = region[:2]
    place.RegionLocationMaxX1, place.RegionLocationMaxY1 = region[2:]
    place.PhysicalUnitsXDirection = place.PhysicalUnitsYDirection = 3  # cm
    place.PhysicalDeltaX, place.PhysicalDeltaY = 0.1 * mm[0], 0.1 * mm[1]
    data.SequenceOfUltrasoundRegions = [place]
    pixels = np.ascontiguousarray(frames[..., 0] if is_grey else frames).tobytes()
    data.PixelData = pixels + b"\0" * (len(pixels) % 2)
    data.file_meta = meta = FileMetaDataset()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = data.SOPClassUID, data.SOPInstanceUID
    buffer = io.BytesIO()
    data.save_as(buffer, enforce_file_format=True)
    return buffer.getvalue()
