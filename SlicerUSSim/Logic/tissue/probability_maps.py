"""Tissue probability maps of other programs, one file per tissue, combined into a label map.

SPM writes c1 (grey matter), c2 (white matter) and c3 (CSF) before the name of the MRI (SPM12 manual, chapter
"Segment"), CAT12 p1, p2 and p3; FSL's FAST *_pve_0, _1 and _2, by increasing intensity: of a T1 CSF, grey and white
matter, of a T2 the other way round (https://fsl.fmrib.ox.ac.uk/fsl/docs/structural/fast); fMRIPrep label-CSF_probseg,
label-GM_probseg and label-WM_probseg (BIDS derivatives). All are from 0 to 1; other programs export them as 0 to 100 or
0 to 255. An MRI has such numbers too, so that those are believed only if the three maps add up to the whole, or one is
nearly binary.

Whatever a file is called, amounts and places of the tissues have the last word, as for label maps: see require_order.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.brain_orders import BRAIN_TISSUES, BrainLabels
from SlicerUSSim.Logic.tissue.label_findings import options

#: (program, regular expression of a file name with the part that differs as group "part", {part: tissue})
_PATTERNS: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("SPM", r"(?:[mrws]*)c(?P<part>[1-6])(?=[^0-9]).+", {"1": "grey matter", "2": "white matter", "3": "csf"}),
    ("CAT12", r"(?:[mrws0]*)p(?P<part>[1-6])(?=[^0-9]).+", {"1": "grey matter", "2": "white matter", "3": "csf"}),
    ("FSL FAST", r".+_(?:pve|prob)_(?P<part>[0-9])\..+", {"0": "csf", "1": "grey matter", "2": "white matter"}),
    (
        "fMRIPrep", r".+label-(?P<part>[A-Za-z]+)_probseg\..+",
        {"CSF": "csf", "GM": "grey matter", "WM": "white matter"},
    ),
)  # fmt: skip
#: The program whose maps are in the order of brightness, which may be that of any contrast
_BY_BRIGHTNESS = "FSL FAST"
#: Probabilities are nearly one in a share of what is above zero: 0.05 in the averaged grey matter of MNI152, more in
#: one person's; an MRI scaled to one has 0.00001. Without one of these names, more is demanded.
_CERTAIN, _CERTAIN_SHARE, _CERTAIN_SHARE_OF_NAMED = 0.95, 0.1, 0.01
#: A voxel is labelled if the tissues are together more probable than nothing.
_INSIDE = 0.5
_LARGEST = 1.0 + 1e-3
#: What stands for certainty in maps with larger numbers, and how far below it the largest value may be
_SCALES, _TOP = (100.0, 255.0), 0.97
#: Three maps add up to the whole, within this much of it, in half of the brain or more, and nowhere to more.
_WHOLE = 0.03
#: One alone: shares of what is above zero that is nearly certain, and that is between 0.1 and 0.9. In MRIs 0.000 and
#: 0.86 or more; those of which half is cut off at the largest value have 0.53 to 0.60 and 0.28 to 0.42.
_CERTAIN_SHARE_OF_SCALED, _BETWEEN_SHARE = 0.65, 0.25
#: Different values between them; a label map in which one number prevails has fewer.
_FEWEST_LEVELS = 40


@dataclass(frozen=True, eq=False)
class CombinedMaps:
    """A label map from probability maps."""

    #: uint8, numbered as BRAIN_TISSUES from 1
    labels: Volume
    #: What was recognised and combined, one line
    message: str
    #: File names of the maps of labels 1, 2, 3
    files: tuple[str, ...]
    #: Whether the program numbers its maps by brightness, and not by tissue
    is_by_brightness: bool = False

    @property
    def names(self) -> Mapping[int, str]:
        """{label: tissue}."""
        return dict(enumerate(BRAIN_TISSUES, 1))

    def require_order(self, source: str) -> None:
        """Raise SimulationError if amounts and places of the tissues show that they are exchanged.

        Maps by brightness have to fit, as FAST's of a T2 do not; those by tissue are believed unless one other order,
        and only that, fits.
        """
        brain = BrainLabels.of(self.labels, (1, 2, 3))
        orders = [] if brain.fits(1, 2, 3) else brain.orders()
        if brain.fits(1, 2, 3) or (len(orders) != 1 and not self.is_by_brightness):
            return
        is_known = len(orders) == 1
        order = dict(sorted(orders[0].items())) if is_known else self.names
        maps = options(f"{label}={tissue.split()[0]}" for label, tissue in order.items())
        numbered = ", ".join(f"{label} {file}" for label, file in enumerate(self.files, 1))
        found = ", ".join(f"{label} {tissue} ({brain.shares[label]:.0%})" for label, tissue in order.items())
        is_of_t2 = self.is_by_brightness and list(order.values()) == [*reversed(BRAIN_TISSUES)]
        raise SimulationError(
            f"{source}: a tissue probability map, but by amounts and places its maps (labels {numbered}) are not "
            + (f"CSF, grey and white matter but {found}" if is_known else f"surely {found}")
            + (", as of a T2" if is_of_t2 else "")
            + f"; if that is right, say so with {maps}"
        )


def combined_probability_maps(path: Path, volume: Volume) -> CombinedMaps | None:
    """The label map of a tissue's probability map and those of the other tissues beside it; None if it is not one.

    Each voxel becomes the most probable tissue, where all together exceed one half.

    Raises SimulationError if it is a probability map but the others are missing, more than three or have another grid.
    """
    scaled = None if _has_probabilities(volume) else _scaled(path, volume)
    if scaled is not None:
        return scaled
    is_nearly_binary = _is_nearly_binary(volume)
    if not is_nearly_binary and not _has_probabilities(volume):
        return None
    for program, pattern, tissues in _PATTERNS:
        found = re.fullmatch(pattern, path.name)
        if found is None:
            continue
        paths = _companions(path, found, tissues)
        _require_three(path, program, found)
        if is_nearly_binary:
            _require_all(path, program, paths)
        elif all(map(Path.exists, paths.values())) or _certain_share(volume) > _CERTAIN_SHARE_OF_NAMED:
            return _combined(path, volume, program, paths)
    if not is_nearly_binary and _certain_share(volume) < _CERTAIN_SHARE:
        return None
    raise SimulationError(
        f"{path}: a probability map (values from 0 to {volume.array.max():.3g}, most of them certain), not an MRI; the "
        "maps of the other tissues are not known from its name, expected c1, c2, c3 + NAME (SPM) or NAME_pve_0, _1, _2 "
        "(FSL FAST)"
    )


def _has_fractions(array: np.ndarray) -> bool:
    return bool(np.any((array > 0.01) & (array < 0.99)))


def _scaled(path: Path, volume: Volume) -> CombinedMaps | None:
    """The same of maps from 0 to 100 or 255, if three of them add up to that."""
    if not _may_be_scaled(volume):
        return None
    for program, pattern, tissues in _PATTERNS:
        found = re.fullmatch(pattern, path.name)
        paths = {} if found is None else _companions(path, found, tissues)
        if found is None or not all(map(Path.exists, paths.values())) or path not in paths.values():
            continue
        volumes = [volume if other == path else Volume.read(other) for other in paths.values()]
        if not all(map(_may_be_scaled, volumes)) or not all(_same_grid(other, volume) for other in volumes):
            continue
        scale = _scale(max(float(other.array.max()) for other in volumes))
        if scale is None:
            continue
        _require_three(path, program, found)
        maps = {tissue: other.array / np.float32(scale) for tissue, other in zip(paths, volumes, strict=True)}
        together = np.sum(list(maps.values()), axis=0)
        inside = together[together > _INSIDE]
        if inside.size and inside.max() <= 1 + _WHOLE and np.mean(inside >= 1 - _WHOLE) >= 0.5:
            return _labelled(path, volume, program, paths, maps)
    return None


def _companions(path: Path, found: re.Match, tissues: dict[str, str]) -> dict[str, Path]:
    """{tissue: file}, in which the file itself has its own tissue, if it is one of the three."""
    start, end = found.span("part")
    return {tissue: path.with_name(path.name[:start] + part + path.name[end:]) for part, tissue in tissues.items()}


def _require_three(path: Path, program: str, found: re.Match) -> None:
    """Raise SimulationError for a fourth map by brightness: what its classes are is then not known."""
    if program != _BY_BRIGHTNESS:
        return
    start, end = found.span("part")
    beside = {part: path.with_name(path.name[:start] + str(part) + path.name[end:]) for part in range(10)}
    classes = [part for part, other in beside.items() if other.exists() or other == path]
    require(
        max(classes) < 3,
        f"{path}: a tissue probability map of {max(classes) + 1} classes ({program}, {beside[max(classes)].name}), "
        "expected 3: CSF, grey and white matter; run FAST with 3 classes (-n 3), or give its label map (NAME_seg) and "
        "the tissue of each class with --map LABEL=TISSUE",
    )


def _require_all(path: Path, program: str, paths: dict[str, Path]) -> None:
    missing = [other.name for other in paths.values() if not other.exists()]
    what = _described(path, program, paths)
    require(not missing, f"{what}, not an MRI; put {' and '.join(missing)} beside it, or give the MRI")


def _described(path: Path, program: str, paths: dict[str, Path]) -> str:
    own = "".join(f", {tissue}" for tissue, other in paths.items() if other == path)
    return f"{path}: a tissue probability map ({program}{own})"


def _combined(path: Path, volume: Volume, program: str, paths: dict[str, Path]) -> CombinedMaps:
    _require_all(path, program, paths)
    maps = {}
    for tissue, other in paths.items():
        read = volume if other == path else Volume.read(other)
        same = _same_grid(read, volume)
        require(same, f"{other}: has another grid than {path.name}, expected maps of one segmentation")
        require(_has_probabilities(read), f"{other}: is no probability map, expected values from 0 to 1")
        maps[tissue] = read.array.astype(np.float32)
    return _labelled(path, volume, program, paths, maps)


def _labelled(
    path: Path, volume: Volume, program: str, paths: dict[str, Path], maps: Mapping[str, np.ndarray]
) -> CombinedMaps:
    """The most probable of three tissues with maps from 0 to 1."""
    ordered = [maps[tissue] for tissue in BRAIN_TISSUES]
    together = np.sum(ordered, axis=0)
    labels = np.where(together > _INSIDE, np.argmax(ordered, axis=0) + 1, 0).astype(np.uint8)
    require(labels.any(), f"{path}: no tissue is probable anywhere, expected values up to 1")
    names = ", ".join(other.name for other in paths.values() if other != path)
    message = f"{_described(path, program, paths)}, combined with {names} to 3 tissues"
    files = tuple(paths[tissue].name for tissue in BRAIN_TISSUES)
    return CombinedMaps(volume.with_array(labels), message, files, program == _BY_BRIGHTNESS)


def _same_grid(a: Volume, b: Volume) -> bool:
    return a.array.shape == b.array.shape and np.allclose(a.ijk_to_ras, b.ijk_to_ras, atol=1e-3)


def _scale(largest: float) -> float | None:
    """What stands for certainty if this is the largest value of three maps."""
    return next((scale for scale in _SCALES if _TOP * scale <= largest <= _LARGEST * scale), None)


def _may_be_scaled(volume: Volume) -> bool:
    """Whether all values are from 0 to 255, some larger than one."""
    low, high = float(volume.array.min()), float(volume.array.max())
    return low >= 0 and 1 < high <= _LARGEST * max(_SCALES)


def _is_nearly_binary(volume: Volume) -> bool:
    """Whether most of a volume from 0 to 100 or 255 is at one of the two ends, but not all of it, as in a mask."""
    scale = _scale(float(volume.array.max())) if _may_be_scaled(volume) else None
    if scale is None:
        return False
    above = volume.array[volume.array > 0.02 * scale]
    if above.size > volume.array.size / 2 or np.mean(above > _CERTAIN * scale) < _CERTAIN_SHARE_OF_SCALED:
        return False
    between = above[(above > 0.1 * scale) & (above < 0.9 * scale)]
    return between.size <= _BETWEEN_SHARE * above.size and np.unique(between).size >= _FEWEST_LEVELS


def _has_probabilities(volume: Volume) -> bool:
    """Whether all values are from 0 to 1, and some are between."""
    array = volume.array
    if not np.issubdtype(array.dtype, np.floating):
        return False
    low, high = float(array.min()), float(array.max())  # NaN fails both comparisons
    return low >= -1e-3 and 0.5 < high <= _LARGEST and _has_fractions(array)


def _certain_share(volume: Volume) -> float:
    above = volume.array[volume.array > 0.02]
    return float(np.mean(above > _CERTAIN)) if above.size else 0.0
