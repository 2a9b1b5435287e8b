"""Tissue probability maps of other programs, one file per tissue, combined into a label map.

SPM and CAT12 write c1 (grey matter), c2 (white matter) and c3 (CSF) before the name of the MRI (SPM12 manual, chapter
"Segment"); FSL's FAST *_pve_0, _1 and _2, by increasing intensity of a T1: CSF, grey and white matter
(https://fsl.fmrib.ox.ac.uk/fsl/docs/structural/fast); fMRIPrep label-CSF_probseg, label-GM_probseg and
label-WM_probseg (BIDS derivatives).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume

#: Tissues in the order of their labels
TISSUES_OF_MAPS = ("csf", "grey matter", "white matter")
#: (program, regular expression of a file name with the part that differs as group "part", {part: tissue})
_PATTERNS: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("SPM", r"(?:[mrws]*)c(?P<part>[1-6])(?=[^0-9]).+", {"1": "grey matter", "2": "white matter", "3": "csf"}),
    ("FSL FAST", r".+_(?:pve|prob)_(?P<part>[0-9])\..+", {"0": "csf", "1": "grey matter", "2": "white matter"}),
    (
        "fMRIPrep", r".+label-(?P<part>[A-Za-z]+)_probseg\..+",
        {"CSF": "csf", "GM": "grey matter", "WM": "white matter"},
    ),
)  # fmt: skip
#: Probabilities are nearly one in a share of what is above zero: 0.05 in the averaged grey matter of MNI152, more in
#: one person's; an MRI scaled to one has 0.00001. Without one of these names, more is demanded.
_CERTAIN, _CERTAIN_SHARE, _CERTAIN_SHARE_OF_NAMED = 0.95, 0.1, 0.01
#: A voxel is labelled if the tissues are together more probable than nothing.
_INSIDE = 0.5
_LARGEST = 1.0 + 1e-3


@dataclass(frozen=True, eq=False)
class CombinedMaps:
    """A label map from probability maps."""

    #: uint8, numbered as TISSUES_OF_MAPS from 1
    labels: Volume
    #: What was recognised and combined, one line
    message: str

    @property
    def names(self) -> Mapping[int, str]:
        """{label: tissue}."""
        return dict(enumerate(TISSUES_OF_MAPS, 1))


def combined_probability_maps(path: Path, volume: Volume) -> CombinedMaps | None:
    """The label map of a tissue's probability map and those of the other tissues beside it; None if it is not one.

    Each voxel becomes the most probable tissue, where all together exceed one half.

    Raises SimulationError if it is a probability map but the others are missing or have another grid.
    """
    if not _has_probabilities(volume):
        return None
    for program, pattern, tissues in _PATTERNS:
        found = re.fullmatch(pattern, path.name)
        if found is None:
            continue
        paths = _companions(path, found, tissues)
        if all(map(Path.exists, paths.values())) or _certain_share(volume) > _CERTAIN_SHARE_OF_NAMED:
            return _combined(path, volume, program, paths)
    if _certain_share(volume) < _CERTAIN_SHARE:
        return None
    raise SimulationError(
        f"{path}: a probability map (values from 0 to 1, most of them certain), not an MRI; the maps of the other "
        "tissues are not known from its name, expected c1, c2, c3 + NAME (SPM) or NAME_pve_0, _1, _2 (FSL FAST)"
    )


def _companions(path: Path, found: re.Match, tissues: dict[str, str]) -> dict[str, Path]:
    """{tissue: file}, in which the file itself has its own tissue, if it is one of the three."""
    start, end = found.span("part")
    return {tissue: path.with_name(path.name[:start] + part + path.name[end:]) for part, tissue in tissues.items()}


def _combined(path: Path, volume: Volume, program: str, paths: dict[str, Path]) -> CombinedMaps:
    own = "".join(f", {tissue}" for tissue, other in paths.items() if other == path)
    what = f"{path}: a tissue probability map ({program}{own})"
    missing = [other.name for other in paths.values() if not other.exists()]
    require(not missing, f"{what}, not an MRI; put {' and '.join(missing)} beside it, or give the MRI")
    maps = []
    for tissue in TISSUES_OF_MAPS:
        other = paths[tissue]
        read = volume if other == path else Volume.read(other)
        same = read.array.shape == volume.array.shape and np.allclose(read.ijk_to_ras, volume.ijk_to_ras, atol=1e-3)
        require(same, f"{other}: has another grid than {path.name}, expected maps of one segmentation")
        require(_has_probabilities(read), f"{other}: is no probability map, expected values from 0 to 1")
        maps.append(read.array.astype(np.float32))
    together = np.sum(maps, axis=0)
    labels = np.where(together > _INSIDE, np.argmax(maps, axis=0) + 1, 0).astype(np.uint8)
    require(labels.any(), f"{path}: no tissue is probable anywhere, expected values up to 1")
    names = ", ".join(other.name for other in paths.values() if other != path)
    return CombinedMaps(volume.with_array(labels), f"{what}, combined with {names} to 3 tissues")


def _has_probabilities(volume: Volume) -> bool:
    """Whether all values are from 0 to 1, and some are between."""
    array = volume.array
    if not np.issubdtype(array.dtype, np.floating):
        return False
    low, high = float(array.min()), float(array.max())  # NaN fails both comparisons
    return low >= -1e-3 and 0.5 < high <= _LARGEST and bool(np.any((array > 0.01) & (array < 0.99)))


def _certain_share(volume: Volume) -> float:
    above = volume.array[volume.array > 0.02]
    return float(np.mean(above > _CERTAIN)) if above.size else 0.0
