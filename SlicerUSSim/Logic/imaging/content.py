"""What a file is, by its content: the recognisers of labels, CTs, brains, sequences and settings, asked in turn."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.files import read_json
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.preset import SECTIONS
from SlicerUSSim.Logic.mri.ct_unit import why_ct
from SlicerUSSim.Logic.mri.markups import is_markup_name
from SlicerUSSim.Logic.mri.recognition import stripped_brain
from SlicerUSSim.Logic.tissue.label_files import TABLE_SUFFIXES, names_of_file
from SlicerUSSim.Logic.tissue.label_maps import as_whole
from SlicerUSSim.Logic.tissue.label_sources import is_label_file
from SlicerUSSim.Logic.tissue.probability_maps import combined_probability_maps
from SlicerUSSim.Logic.tissue.schemes import Scheme, recognised
from SlicerUSSim.Logic.tracked.sequence import is_tracked_sequence

#: More numbers, or more millilitres, are the labels of a brain or a body, and not of a lesion and its surroundings
_MOST_OF_LESION, _MOST_LESION_ML = 4, 400.0


class Kind(Enum):
    """What can be opened."""

    MRI = "an MRI"
    CT = "a CT"
    LABELS = "a label map"
    #: Label maps that may be laid over a patient: one region, and lesions as BraTS numbers them
    MASK = "a mask"
    LESIONS = "lesions"
    SEQUENCE = "tracked ultrasound"
    SHEETS = "thin sheets"
    SCENE = "a scene"
    PRESET = "a preset"
    TABLE = "a table of labels"
    TRANSFORM = "a transform"
    POSE = "a pose of the probe"
    POINTS = "points of 3D Slicer"


@dataclass(frozen=True)
class Content:
    """What a file was recognised as."""

    kind: Kind
    #: In words: "an MRI of a whole head, 181x217x181 voxels of 1x1x1 mm"
    what: str
    #: That was read for this, if it is an image
    volume: Volume | None = None
    #: Names of the files of which it consists, if they are several: those of the three tissues; the first is this one
    files: tuple[str, ...] = ()
    #: Numberings that a label map may have, if they are several
    schemes: tuple[Scheme, ...] = ()


def content_of(path: Path) -> Content:
    """What a file is; takes up to seconds. Raises SimulationError, naming the file, if it is nothing that is known."""
    name = path.name.lower()
    if path.is_dir():  # of a DICOM series, and called as it is described
        return of_volume(path, Volume.read(path))
    if name.endswith(".json"):
        return _of_json(path)
    if is_markup_name(path):
        return Content(Kind.POINTS, "points of 3D Slicer")
    if name.endswith((".mrb", ".zip")):
        return Content(Kind.SCENE, "a scene of 3D Slicer or of this page")
    if name.endswith(".vtp"):
        return Content(Kind.SHEETS, "thin sheets")
    if name.endswith((".xml", ".xfm", ".tag", ".tfm", ".h5", ".hdf5", ".mat")):
        return Content(Kind.TRANSFORM, _TRANSFORMS.get(path.suffix.lower(), "a transform"))
    if path.suffix.lower() in TABLE_SUFFIXES:
        is_matrix = _has_16_numbers(path)
        return Content(Kind.TRANSFORM, "a 4x4 matrix") if is_matrix else Content(Kind.TABLE, "a table of labels")
    if is_tracked_sequence(path) or ".igs." in name:
        return Content(Kind.SEQUENCE, "tracked ultrasound")
    return of_volume(path, Volume.read(path))


def of_volume(path: Path, volume: Volume) -> Content:
    """What an image is. Raises SimulationError for damaged label maps and for ultrasound without poses."""
    size = f"{volume.size_text} voxels of {'x'.join(f'{mm:.3g}' for mm in volume.spacing_mm)} mm"
    if is_label_file(path, volume):
        return _of_labels(path, volume, size)
    why = why_ct(volume)
    if why is not None:
        return Content(Kind.CT, f"a CT ({why}), {size}", volume)
    if stripped_brain(volume) is not None:
        return Content(Kind.MRI, f"an MRI of a brain without skull, {size}", volume)
    return Content(Kind.MRI, f"an MRI of a whole head, {size}", volume)


def _of_labels(path: Path, volume: Volume, size: str) -> Content:
    """Which labels a label map has, in the words of the program whose numbers they are."""
    try:
        labels = as_whole(volume, path.name)
    except SimulationError:  # probabilities, which become labels
        maps = combined_probability_maps(path, volume)
        files = () if maps is None else (path.name, *(name for name in maps.files if name != path.name))
        if files and files[0] != sorted(files)[0]:
            files = ()  # the first of them stands for all
        return Content(Kind.LABELS, f"tissue probabilities, {size}", volume, files)
    values = np.flatnonzero(np.bincount(labels.array.ravel())).tolist()
    values = [value for value in values if value]
    names, millilitres = names_of_file(path, volume)[0], float((labels.array > 0).sum() * labels.voxel_ml)
    if len(values) <= 1:
        of_what = f" called {names[values[0]]!r}" if values and values[0] in names else ""
        return Content(Kind.MASK, f"a mask of one region{of_what}, {millilitres:.3g} ml, {size}", volume)
    if any(value in names for value in values):
        called = ", ".join(names[value] for value in values[:4] if value in names)
        more = ", ..." if len(values) > 4 else ""
        return Content(Kind.LABELS, f"a label map of {len(values)} labels by name ({called}{more}), {size}", volume)
    scheme, choices = recognised(values)
    if scheme is not None and scheme.is_lesion:
        return Content(Kind.LESIONS, f"lesions as {scheme.title} numbers them, {size}", volume)
    if scheme is not None:
        return Content(Kind.LABELS, f"a label map: {scheme.title}, {len(values)} labels, {size}", volume)
    listed = ", ".join(map(str, values[:6])) + (", ..." if len(values) > 6 else "")
    may_be_lesion = len(values) <= _MOST_OF_LESION and millilitres <= _MOST_LESION_ML
    kind = Kind.LESIONS if may_be_lesion else Kind.LABELS
    which = " or ".join(choice.title for choice in choices) or "no known program"
    return Content(kind, f"a label map with the labels {listed} of {which}, {size}", volume, schemes=tuple(choices))


# ---- texts -----------------------------------------------------------------------------------------------------------

_TRANSFORMS = {".xml": "a configuration of Plus", ".tag": "landmarks of MNI"}


def _of_json(path: Path) -> Content:
    values = read_json(path)
    if isinstance(values, dict):
        if "markups" in values:
            return Content(Kind.POINTS, "points of 3D Slicer")
        if values.keys() & {"probe", *SECTIONS}:
            return Content(Kind.PRESET, "a preset (probe, display, settings)")
        if "probe_to_ras" in values:
            return Content(Kind.POSE, "a pose of the probe")
        if "tissues" in values:
            return Content(Kind.TABLE, "the tissue table")
        if values and all(str(key).isdecimal() for key in values):
            return Content(Kind.TABLE, "a table of labels")
    if isinstance(values, list) and np.shape(values) == (4, 4):
        return Content(Kind.TRANSFORM, "a 4x4 matrix")
    return Content(Kind.PRESET, "a preset")


def _has_16_numbers(path: Path) -> bool:
    """Whether a text is a 4x4 matrix, or an ITK transform."""
    with path.open("rb") as file:
        start = file.read(4096)
    if start.startswith(b"#Insight"):
        return True
    try:
        return len([float(word) for word in start.decode("utf-8-sig").replace(",", " ").split()]) == 16
    except (UnicodeDecodeError, ValueError):
        return False
