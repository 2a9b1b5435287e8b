"""Segments in the header of 3D Slicer's .seg.nrrd files, and their voxels where they overlap.

Segments that do not overlap share a layer, one component of each voxel, in which each has a number: Segment0_Name,
Segment0_Layer, Segment0_LabelValue and so on
(https://slicer.readthedocs.io/en/latest/developer_guide/modules/segmentations.html, "Segmentation file format").
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from SlicerUSSim.Logic.base.errors import require

_log = logging.getLogger(__name__)

#: SNOMED CT categories "Anatomical Structure" and "Tissue"
_HEALTHY = ("123037004", "85756007")
#: Names that programs give when the user gave none
_MEANINGLESS = re.compile(r"(label|segment|region|class|colou?r|unnamed|\(none\)|n/?a)?[ _-]*\d*", re.IGNORECASE)


@dataclass(frozen=True)
class Segment:
    """A segment of a file."""

    name: str
    #: Component of the voxels that holds it
    layer: int
    #: Its number there
    value: int
    #: Its label in one label map of all segments
    label: int
    #: Its SNOMED CT codes, as codes_of_entry returns them
    codes: tuple[str, ...] = ()


def segments_of(header: Mapping[str, object], name: str = "segments") -> list[Segment]:
    """The segments of a header, in their order; empty without.

    Labels are the numbers in the file, and count from 1 where segments in different layers have the same.
    Raises SimulationError for a layer or number that is not an integer.
    """
    numbers = sorted(int(found[1]) for key in header if (found := re.fullmatch(r"Segment(\d+)_Name", key)))

    def whole(key: str, default: int) -> int:
        text = str(header.get(key, default)).strip()
        require(text.isdecimal(), f"{name}: {key} is {text!r}, expected a whole number from 0")
        return int(text)

    segments = []
    for number in numbers:
        layer, value = whole(f"Segment{number}_Layer", 0), whole(f"Segment{number}_LabelValue", number + 1)
        entry = re.search(r"TerminologyEntry:([^|]*)", str(header.get(f"Segment{number}_Tags", "")))
        codes = codes_of_entry(entry[1]) if entry else ()
        segments.append(Segment(str(header[f"Segment{number}_Name"]), layer, value, value, codes))
    has_layers = len({segment.layer for segment in segments}) > 1
    if has_layers and len({segment.value for segment in segments}) < len(segments):
        return [replace(segment, label=place) for place, segment in enumerate(segments, 1)]
    return segments


def flattened(layers: np.ndarray, segments: list[Segment], voxel_ml: float, name: str) -> np.ndarray:
    """(k, j, i) labels of segments in layers (k, j, i, layer); where they overlap, the last is taken, with a warning.

    Raises SimulationError for a segment in a layer that does not exist.
    """
    labels = np.zeros(layers.shape[:3], np.int32)
    overlaps = []
    for segment in segments:
        require(
            segment.layer < layers.shape[3],
            f"{name}: segment {segment.name!r} is in layer {segment.layer}, expected less than {layers.shape[3]}",
        )
        inside = layers[..., segment.layer] == segment.value
        covered = float(np.count_nonzero(labels[inside]) * voxel_ml)
        if covered:
            overlaps.append(f"{segment.name!r} covers {covered:.3g} ml of earlier ones")
        labels[inside] = segment.label
    if overlaps:
        _log.warning("%s: segments overlap, the last is taken: %s", name, "; ".join(overlaps))
    return labels


def codes_of_entry(entry: str) -> tuple[str, ...]:
    """The SNOMED CT codes of an entry of 3D Slicer's terminologies, as ranked_codes returns them.

    An entry is context~category~type~modifier~context~region~modifier, each of them a scheme^code^meaning.
    """
    parts = [re.match(r"SCT\^(\w+)\^", part) for part in (*entry.split("~"), *[""] * 7)]
    category, kind, modifier, region = (part[1] if part else "" for part in (parts[1], parts[2], parts[3], parts[5]))
    return ranked_codes(category, kind, modifier, region)


def ranked_codes(category: str, kind: str, modifier: str, region: str) -> tuple[str, ...]:
    """Codes of a segment, the most special first: of the type's modifier, of the type, and of the anatomic region.

    The region counts for healthy tissue alone, as "white matter" of the type "brain": a mass in the liver is not liver.
    """
    return tuple(code for code in (modifier, kind, region if category in _HEALTHY else "") if code)


def is_meaningful(name: str | None) -> bool:
    """Whether a user gave this name, rather than a program ("Label 3", "Segment_1")."""
    return bool(name) and not _MEANINGLESS.fullmatch(str(name).strip())
