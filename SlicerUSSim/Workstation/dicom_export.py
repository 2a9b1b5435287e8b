"""DICOM ultrasound images from frames that a page has composed: image, banner, scale and measurements in the pixels."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping

import numpy as np
from PIL import Image

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.ultrasound_dicom import ultrasound_dicom
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
        require(3 * width * height * len(images) <= _MOST_BYTES, f"the frames are {len(images)}, expected fewer")
        frames = np.stack([np.asarray(image.convert("RGB")) for image in images])
    except (ValueError, LookupError, TypeError, OSError) as error:
        raise SimulationError(f"the frames of the page cannot be read ({error})") from None
    scale = mm_x, mm_y, frame_ms if len(images) > 1 else 1.0
    is_scale = all(0 < value < math.inf for value in scale)
    is_region = 0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height
    require(is_region and is_scale, f"the region of the image is {about}, expected one within {width}x{height} pixels")
    edges = tuple(map(round, (x0, y0, x1 - 1, y1 - 1)))
    return ultrasound_dicom(
        frames, edges, (mm_x, mm_y), patient=taken.patient, time=taken.time, frame_ms=scale[2], has_texts=True
    )
