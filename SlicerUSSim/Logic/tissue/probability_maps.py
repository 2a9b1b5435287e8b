"""Probability maps of grey matter, white matter and CSF, each a separate file, combined into a label map.

SPM and CAT12 write c1, p1 (grey matter), c2, p2 (white matter) and c3, p3 (CSF) before the name of the MRI (SPM12
manual, chapter "Segment"); FSL's FAST *_pve_0, _1 and _2, by increasing brightness, of a T1 CSF, grey and white matter
(https://fsl.fmrib.ox.ac.uk/fsl/docs/structural/fast).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.names import BRAIN_TISSUES

#: {regular expression of a file's name with the part that differs as a group: that part of each of BRAIN_TISSUES}
_SETS = {r"[mrws0]*[cp]([123])[^0-9].*": "312", r".+_pve_([0-9])\..+": "012"}
#: A voxel is labelled if the tissues are together more probable than nothing.
_INSIDE = 0.5


@dataclass(frozen=True, eq=False)
class CombinedMaps:
    """A label map from probability maps."""

    #: uint8, numbered as BRAIN_TISSUES from 1
    labels: Volume
    #: What was recognised and combined, one line
    message: str
    #: File names of the maps of labels 1, 2, 3
    files: tuple[str, ...]


def combined_probability_maps(path: Path, volume: Volume) -> CombinedMaps | None:
    """The label map of a tissue's probability map, 0 to 1, and those of the other two beside it; None if it is not one.

    Each voxel becomes the most probable tissue, where all together exceed one half.

    Raises SimulationError if its name and numbers are of a probability map but the others are missing, more than three
    or have another grid.
    """
    matches = ((re.fullmatch(pattern, path.name), parts) for pattern, parts in _SETS.items())
    found, parts = next(((found, parts) for found, parts in matches if found), (None, ""))
    if found is None or not _is_share(volume.array):
        return None
    paths = [path.with_name(path.name[: found.start(1)] + part + path.name[found.end(1) :]) for part in (*parts, "3")]
    require(
        found[1] in parts and (parts != "012" or not paths[3].exists()),
        f"{path}: is one of four or more probability maps of FSL's FAST, expected three: CSF, grey and white matter; "
        "run FAST with 3 classes (-n 3), or give its label map (NAME_seg) and tissues with --map LABEL=TISSUE",
    )
    missing = [other.name for other in paths[:3] if not other.exists() and other != path]
    if missing and parts == "312" and not any(other.exists() for other in paths[:3] if other != path):
        return None  # an MRI that is called so
    require(not missing, f"{path}: is a tissue probability map, expected {' and '.join(missing)} beside it")
    volumes = [volume if other == path else Volume.read(other) for other in paths[:3]]
    for other, read in zip(paths, volumes, strict=False):
        is_same = read.array.shape == volume.array.shape and np.allclose(read.ijk_to_ras, volume.ijk_to_ras, atol=1e-3)
        require(is_same, f"{other}: has another grid than {path.name}, expected maps of one segmentation")
        require(_is_share(read.array), f"{other}: is not a probability map, expected values from 0 to 1")
    shares = [read.array for read in volumes]
    inside = np.sum(shares, axis=0) > _INSIDE
    require(inside.any(), f"{path}: no tissue is probable anywhere, expected values up to 1")
    labels = volume.with_array(np.where(inside, np.argmax(shares, axis=0) + 1, 0).astype(np.uint8))
    files = tuple(other.name for other in paths[:3])
    named = ", ".join(f"{file} {tissue}" for file, tissue in zip(files, BRAIN_TISSUES, strict=True))
    return CombinedMaps(labels, f"{path}: tissue probability maps: {named}", files)


def _is_share(array: np.ndarray) -> bool:
    """Whether these are numbers from 0 to 1, some between."""
    is_inside = np.issubdtype(array.dtype, np.floating) and array.min() >= -1e-3 and 0.5 < array.max() <= 1.001
    return bool(is_inside and np.any((array > 0.01) & (array < 0.99)))
