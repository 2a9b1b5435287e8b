"""Files of simulated images, with their records (TakenImage.about): pictures, images in the MRI, sequences."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.mrml.taken_image import TakenImage
from SlicerUSSim.Logic.tracked.sequence import SIMULATED, TrackedSequence

#: File formats of an image with its geometry.
FRAME_SUFFIXES = (".nrrd", ".mha", ".vti")
#: Key of a file's header under which is what its image is of, see TakenImage.about
ABOUT = "SlicerUSSim"


def png(taken: TakenImage) -> bytes:
    """An image as a PNG file, without scaling, with its record as a text."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    buffer, text = io.BytesIO(), PngInfo()
    text.add_itxt(ABOUT, json.dumps(taken.about()))
    Image.fromarray(taken.image).save(buffer, "PNG", pnginfo=text)
    return buffer.getvalue()


def frame_file(taken: TakenImage, suffix: str) -> bytes:
    """An image with its position in the patient, and its record, as a file.

    Raises SimulationError if `suffix` is not one of FRAME_SUFFIXES.
    """
    require(suffix in FRAME_SUFFIXES, f"the file type is {suffix!r}, expected {', '.join(FRAME_SUFFIXES)}")
    return written(suffix, lambda path: taken.volume().write(path, about={ABOUT: json.dumps(taken.about())}))


def written(suffix: str, write: Callable[[Path], object]) -> bytes:
    """The content of a file that `write` writes."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"file{suffix}"
        write(path)
        return path.read_bytes()


def sequence_file(images: Sequence[tuple[float, TakenImage]]) -> bytes:
    """Images with their times in s as a sequence metafile (.igs.mha), with their places in the MRI (RAS, mm).

    The file has the record of the last one (TakenImage.about).
    """
    seconds, taken = zip(*images, strict=True)
    transforms = tuple(
        {"ImageToProbe": image.grid.image_to_probe, "ProbeToReference": image.probe_to_world} for image in taken
    )
    fields = {SIMULATED: "cine", ABOUT: json.dumps(taken[-1].about())}
    array = np.stack([image.image for image in taken])
    return written(".igs.mha", TrackedSequence(array, transforms, np.array(seconds), fields=fields).write)
