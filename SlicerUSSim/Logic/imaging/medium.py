"""The acoustic medium on the device: buffers with labels, membrane, smoothed borders and tissue parameters.

A voxel has two bytes. The low byte has the label and flags for cells (the cube between eight voxel centres) whose
corners agree, so that most look-ups need one load. The high byte has the *fluid distance* of the voxel from the border
of the membrane's fluids, positive inside. It is computed from their indicator, smoothed by a Gaussian: for a planar
border at distance d this is Phi(d / sigma), so d = sigma Phi^-1 of it. With linear interpolation between voxels, a
layer thinner than a voxel is located without steps. Thin layers of the membrane's own tissue, such as a sulcus whose
two borders meet, are sheets instead: planes fitted to their voxels (sheets.py), like sheets that were found in the MRI
(found_sheets.py).
"""

from __future__ import annotations

import logging
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.borders import smoothed_indicators, smoothed_members
from SlicerUSSim.Logic.imaging.found_sheets import FoundSheets, cells_around, found_sheets, with_their_tissue
from SlicerUSSim.Logic.imaging.labelled_sheets import sheet_planes
from SlicerUSSim.Logic.opencl.device import Device, divisible
from SlicerUSSim.Logic.opencl.layout import CONSTANTS, TISSUE
from SlicerUSSim.Logic.tissue.sheet_looks import looks_of
from SlicerUSSim.Logic.tissue.surfels import Surfels
from SlicerUSSim.Logic.tissue.table import MAX_LABEL, TissueTable
from SlicerUSSim.Logic.tissue.tissue import Membrane

if TYPE_CHECKING:
    from pyopencl import Buffer

_log = logging.getLogger(__name__)

_FARTHEST_SIGMAS = 2.2  # limit of the stored distance
# Smoothed indicators need two bytes per voxel and group. Limits of groups and of all values; at least two groups.
_MOST_SMOOTHED_GROUPS = 6
_SMOOTHED_VOXELS = 100_000_000
_TISSUE_ATTRIBUTES = tuple(name for name in TISSUE.names or () if name not in ("group", "label_of_group", "is_fluid"))
#: Attenuation (dB/(cm MHz)) from which tissues may be LOSSY_PER_MM at some frequency and have borders by that alone
_LOSSY = 2.0
_PAD = 1  # one voxel of coupling medium around the volume, for clamped look-ups outside


class Medium:
    """Labels and tissues on a device.

    Parameters
    ----------
    labels : Volume of whole numbers; 0 is the coupling medium.
    tissues : a Tissue for every label that occurs.
    texture : (k, j, i) uint32 of Texture.packed, if scatterers depend on more than labels.
    membership : (second label, the part of a voxel that it fills in 1/255), (k, j, i) uint8 each, as from
        Texture.membership, for borders between voxels.
    sheets : thin sheets that were found in the MRI, drawn where there is a membrane; None or none: those of the labels.

    Raises SimulationError for labels that are not whole numbers or have no tissue.
    """

    def __init__(
        self,
        labels: Volume,
        tissues: TissueTable,
        device: Device,
        texture: np.ndarray | None = None,
        membership: tuple[np.ndarray, np.ndarray] | None = None,
        sheets: Surfels | None = None,
    ) -> None:
        started = perf_counter()
        self.device = device
        self.labels = labels
        array = as_labels(labels.array)
        # By plane: bincount converts to eight bytes
        counts = sum((np.bincount(plane.ravel(), minlength=256) for plane in array), np.zeros(256, np.int64))
        self._counts = counts[: CONSTANTS["MAX_TISSUES"]]
        #: Labels that occur, the most frequent first
        self.present = np.argsort(-counts, kind="stable")[: np.count_nonzero(counts)]
        self.dims = np.array(array.shape[::-1]) + 2 * _PAD
        #: As given, or None
        self.sheets = sheets if sheets is not None and len(sheets) else None
        self._check(tissues)
        tissues = with_their_tissue(tissues, self.sheets)
        #: uint16 [k][j][i]: label, flags and fluid distance; uint8 [k][j][i]: acoustic groups; and their indicators
        self.voxel_buffer: Buffer
        self.group_buffer: Buffer
        self.smooth_buffer: Buffer
        #: Number of groups with a smoothed indicator
        self.smooth_groups: int
        #: Half the membrane in the unit of the fluid distance; negative: none
        self.membrane_reach: float
        #: uint32 [k][j][i] planes of thin sheets (sheets.cl), two words each if some were found in the MRI, or one
        #: element if there are none; and the label of those of labels, 64 without such, -1 for no sheets
        self.sheet_buffer: Buffer
        self.sheet_label: int
        #: The sheets found in the MRI on this grid; None without
        self.found: FoundSheets | None
        #: layout.TISSUE per label, as on the device
        self.rows = self._tissue_rows(tissues)
        #: As given
        self.membership = membership
        padded = self._laid_over(tissues)
        self._upload_groups(padded)
        self._upload(padded, tissues)
        self.has_texture = texture is not None
        self.texture_buffer = device.upload(
            np.zeros(1, np.uint32) if texture is None else np.pad(texture, _PAD, mode="edge")
        )
        self.tissue_buffer = device.upload(self.rows)
        #: Counts the changes of tissues
        self.version = 0
        #: As given; with falx and tentorium that were found, also their tissue
        self.tissues = tissues
        _log.debug(
            "acoustic medium: %s voxels, labels %s, %d acoustic groups of which %d smoothed, %s membrane, %s texture, "
            "%.0f ms", "x".join(map(str, array.shape[::-1])), " ".join(map(str, sorted(self.present))),
            len({int(group) for group in self.rows["group"][self.present]}), self.smooth_groups,
            "no" if self.membrane_reach < 0 else "a", "with" if self.has_texture else "no",
            (perf_counter() - started) * 1e3,
        )  # fmt: skip

    @property
    def ras_to_voxel(self) -> np.ndarray:
        """(3, 4) affine map from RAS mm to padded voxel indices (i, j, k)."""
        matrix = self.labels.ras_to_ijk[:3].copy()
        matrix[:, 3] += _PAD
        return matrix

    def quieter(self, factor: float) -> np.ndarray:
        """(labels,) bool: scatterers' variance below `factor` times the typical one.

        Typical is the mean over the volume, weighted by the variance itself: of what echoes come from.
        """
        variance = self.rows["scatterer_variance"].astype(float)
        power = self._counts * variance
        return variance < factor * float((power * variance).sum() / max(power.sum(), 1e-30))

    def set_tissues(self, tissues: TissueTable) -> None:
        """Change tissue parameters; voxels are uploaded only for a new membrane position or new acoustic groups."""
        self._check(tissues)
        tissues = with_their_tissue(tissues, self.sheets)
        groups_before, closed_before = self.rows["group"], self.found
        self.rows = self._tissue_rows(tissues)
        new_membrane = _membrane_shape(tissues) != _membrane_shape(self.tissues)
        new_groups = not np.array_equal(self.rows["group"], groups_before)
        if new_membrane or new_groups:
            _log.debug("the %s changed: voxels are uploaded again", "membrane" if new_membrane else "acoustic groups")
            padded = self._laid_over(tissues)
            if new_groups or self.found is not None or closed_before is not None:
                self._upload_groups(padded)
            self._upload(padded, tissues)
        elif self.sheets is not None and looks_of(tissues) != looks_of(self.tissues):
            _log.debug("what sheets are made of has changed: voxels are uploaded again")
            self._upload(self._laid_over(tissues), tissues)
        self.device.write(self.tissue_buffer, self.rows)
        self.version += 1
        self.tissues = tissues

    def _check(self, tissues: TissueTable) -> None:
        missing = [int(label) for label in sorted(self.present) if label not in tissues]
        require(
            not missing,
            f"label {', '.join(map(str, missing))} has no tissue; the table has {', '.join(map(str, tissues))}",
        )

    def _tissue_rows(self, tissues: TissueTable) -> np.ndarray:
        """layout.TISSUE per label. Acoustic groups are numbered by decreasing frequency; the first ones have a smoothed
        indicator."""
        rows = np.zeros(CONSTANTS["MAX_TISSUES"], TISSUE)
        rows["label_of_group"] = -1
        members = {int(label): tissues[label] for label in self.present} | dict(tissues)
        if tissues.membrane is not None:
            members[CONSTANTS["MEMBRANE_LABEL"]] = tissues.membrane.tissue
        groups: dict[tuple[float, float, bool], int] = {}
        for label, tissue in members.items():
            acoustics = (tissue.speed_of_sound_m_s, tissue.impedance_mrayl, tissue.attenuation_db_cm_mhz > _LOSSY)
            for name in _TISSUE_ATTRIBUTES:
                rows[label][name] = getattr(tissue, name)
            group = rows[label]["group"] = groups.setdefault(acoustics, len(groups))
            rows[group]["label_of_group"] = label
        if tissues.membrane is not None:
            rows["is_fluid"][list(_fluid_labels(tissues, tissues.membrane))] = 1
        return rows

    def _laid_over(self, tissues: TissueTable) -> np.ndarray:
        """(k, j, i) uint8 labels, padded by edge values: the volume's ends are not borders. Narrow gaps are closed
        where a sheet that was found represents them."""
        padded = np.pad(as_labels(self.labels.array), _PAD, mode="edge")
        membrane, self.found = tissues.membrane, None
        if self.sheets is None or membrane is None or membrane.thickness_mm == 0:
            return padded
        fluids = tuple(label for label in _fluid_labels(tissues, membrane) if label)
        found = found_sheets(self.sheets, padded, self.labels, fluids, tissues)
        if not len(found.voxels):
            _log.debug("no sheet that was found lies in the volume")
            return padded
        self.found = found
        _log.debug(
            "found sheets: planes beside %d voxels, %d voxels of narrow gaps closed", len(found.voxels),
            np.count_nonzero(found.closed),
        )  # fmt: skip
        return found.labels

    def _upload(self, padded: np.ndarray, tissues: TissueTable) -> None:
        same = _are_same(padded)
        label = _sheet_label(tissues)
        self.sheet_buffer, sheets = sheet_planes(self.device, padded, label, self.labels.spacing_mm)
        self.sheet_label = label if len(sheets) else -1
        if self.found is not None:
            self._add_planes(padded.shape, self.found, bool(len(sheets)))
        distance, self.membrane_reach = self._fluid_distance(padded, tissues, sheets)
        no_membrane = np.True_
        if distance is not None:
            lowest, highest = _cell_extremes(distance)
            no_membrane = (lowest > 127.5 + self.membrane_reach) | (highest < 127.5 - self.membrane_reach)
            for k, j, i in np.ndindex(2, 2, 2):  # the cells around these voxels
                no_membrane.ravel()[sheets - np.ravel_multi_index((k, j, i), padded.shape)] = False
        if self.found is not None:
            no_membrane = np.broadcast_to(no_membrane, padded.shape).copy()
            no_membrane.ravel()[cells_around(self.found.voxels[self.found.is_near], padded.shape)] = False
        flags = same.view(np.uint8) * np.uint8(CONSTANTS["SAME_LABEL"])
        flags |= no_membrane.view(np.uint8) * np.uint8(CONSTANTS["NO_MEMBRANE"])
        flags |= padded
        if distance is None:
            words = flags.astype("<u2")
        else:
            words = distance.astype("<u2")
            words <<= 8
            words |= flags
        self.voxel_buffer = self.device.upload(words)

    def _add_planes(self, shape: tuple[int, ...], found: FoundSheets, has_fitted: bool) -> None:
        """Lay the planes of sheets that were found over those fitted to labels, which get a second word of 0."""
        words = np.zeros((int(np.prod(shape)), 2), np.uint32)
        if has_fitted:
            words[:, 0] = self.device.download(self.sheet_buffer, len(words), np.uint32)
        words[found.voxels] = found.words
        self.sheet_buffer = self.device.upload(words)
        if not has_fitted:
            self.sheet_label = CONSTANTS["MAX_TISSUES"]

    def _upload_groups(self, padded: np.ndarray) -> None:
        """The acoustic group of every voxel, and smoothed indicators of the first groups, which give the most accurate
        normals on flat interfaces."""
        group_of = self.rows["group"].astype(np.uint8)
        group = np.zeros(padded.shape, np.uint8)
        for label in {0, *self.present}:  # faster than indices of eight bytes for every voxel
            group |= (padded == label).view(np.uint8) * group_of[label]
        # The coupling medium is at the probe's face even if its label does not occur.
        groups = {int(group_of[label]) for label in (0, *self.present)}
        room = max(_SMOOTHED_VOXELS // padded.size, 2)
        self.smooth_groups = min(max(groups) + 1, _MOST_SMOOTHED_GROUPS, room)
        membership = None
        if self.membership is not None:
            second, share = (np.pad(part, _PAD, mode="edge") for part in self.membership)
            if self.found is not None:
                share = np.where(self.found.closed, 0, share).astype(share.dtype)
            membership = group_of[second], share
            groups |= {int(group) for group in np.unique(membership[0][share > 0])}
        buffer = self.device.upload(np.pad(group.ravel(), (0, 16)))
        self.smooth_buffer = smoothed_indicators(self.device, buffer, self.dims, groups, self.smooth_groups, membership)
        self.device.mark()  # the device begins while the host continues
        words = group | np.uint8(CONSTANTS["SAME_GROUP"]) * _are_same(group)
        # Rows are read eight voxels at a time, including the last one.
        self.group_buffer = self.device.upload(np.pad(words.ravel(), (0, 8)))

    def _fluid_distance(
        self, padded: np.ndarray, tissues: TissueTable, sheets: np.ndarray
    ) -> tuple[np.ndarray | None, float]:
        """(distance as uint8 about 127.5, half the membrane in that unit), or (None, -1) without a membrane.

        `sheets` are the flat indices of voxels in thin sheets, which have no such border.
        """
        membrane = tissues.membrane
        if membrane is None or membrane.thickness_mm == 0:
            return None, -1.0
        fluids = _fluid_labels(tissues, membrane)
        is_fluid = np.zeros(padded.shape, bool)
        for label in fluids:
            is_fluid |= padded == label
        if is_fluid.all() or not is_fluid.any():
            return None, -1.0
        spacing = self.labels.spacing_mm[::-1]
        # Wide enough to smooth the steps between voxels, narrow enough to keep a sulcus of two voxels open.
        sigma_mm = 0.75 * float(np.cbrt(spacing.prod()))
        thickest = 2.0 * _FARTHEST_SIGMAS * sigma_mm
        require(
            membrane.thickness_mm < thickest,
            f"membrane thickness_mm is {membrane.thickness_mm:g}, expected less than {thickest:.2g} in voxels of "
            f"{'x'.join(f'{mm:.3g}' for mm in spacing[::-1])} mm: resample the labels to larger voxels, set a thinner "
            "membrane, or label it; check the voxel size in the header",
        )

        is_fluid.ravel()[sheets] = False
        smooth = smoothed_members(self.device, is_fluid, sigma_mm / spacing[::-1], 3.0)
        sigmas = np.clip(special.ndtri(np.arange(65536) / 65535.0), -_FARTHEST_SIGMAS, _FARTHEST_SIGMAS)
        unit = 127.5 / _FARTHEST_SIGMAS
        distance_of = np.rint(127.5 + unit * sigmas).astype(np.uint8)
        between = np.flatnonzero((distance_of > 0) & (distance_of < 255))
        points = np.flatnonzero((smooth >= between[0]) & (smooth <= between[-1]))
        distance = (smooth > between[-1]).view(np.uint8) * np.uint8(255)
        distance.ravel()[points] = distance_of[smooth.ravel()[points]]
        self._flatten(distance, points.astype(np.int32), fluids, unit / 0.75)
        reach = 0.5 * membrane.thickness_mm / sigma_mm * unit
        _keep_membrane_inside(distance, reach)
        return distance, reach

    def _flatten(self, distance: np.ndarray, points: np.ndarray, fluids: tuple[int, ...], per_voxel: float) -> None:
        """Place the border of (k, j, i) uint8 `distance` by the wide Gaussians of acoustic groups where it is flat.

        `points` are the flat indices, int32, of the voxels near it. The narrow Gaussian follows the steps of a plane
        between layers of voxels. Only for a group of fluids alone, and in voxels that are cubes.
        """
        spacing = self.labels.spacing_mm
        fluid = fluid_group(self.rows["group"], self.present, fluids)
        if not 0 <= fluid < self.smooth_groups or spacing.max() > 1.02 * spacing.min():
            return
        if not len(points):
            return
        before = ((distance.ravel()[points] - np.float32(127.5)) / np.float32(per_voxel)).astype(np.float32)
        flat = self.device.zeros(before.nbytes)
        self.device.write(flat, before)
        lanes = self.device.lanes
        self.device.run(
            self.device.kernels("membrane.cl", lanes)["flatten_membrane"], (divisible(-(-len(points) // lanes)),),
            self.smooth_buffer, *(np.int32(n) for n in self.dims), np.int32(self.smooth_groups), np.int32(fluid),
            self.device.upload(points), np.int32(len(points)), flat,
        )  # fmt: skip
        after = self.device.download(flat, len(points), np.float32)
        distance.ravel()[points] = np.rint(np.clip(127.5 + per_voxel * after, 0.0, 255.0)).astype(np.uint8)


def fluid_group(group_of: np.ndarray, present: np.ndarray, fluids: tuple[int, ...]) -> int:
    """The acoustic group of the first of `present` (labels) that is one of `fluids`, if all its labels are; else -1."""
    labels = [0, *(int(label) for label in present)]
    for label in present:
        if label in fluids and all(other in fluids for other in labels if group_of[other] == group_of[label]):
            return int(group_of[label])
    return -1


def as_labels(array: np.ndarray) -> np.ndarray:
    """`array` as uint8 labels. Raises SimulationError unless it holds whole numbers from 0 to MAX_LABEL."""
    if array.dtype == np.uint8:
        labels = array
    else:
        low, high = (array.min(), array.max()) if array.size else (0, 0)
        require(
            bool(np.isfinite(low) and np.isfinite(high)) and low >= 0 and high <= MAX_LABEL,
            f"label map has values from {low} to {high}, expected whole numbers from 0 to {MAX_LABEL}",
        )
        labels = array.astype(np.uint8)
        if not np.array_equal(labels, array):
            raise SimulationError("label map has fractions, expected whole numbers; segment the MRI first")
    require(int(labels.max()) <= MAX_LABEL, f"label map has label {labels.max()}, expected 0 to {MAX_LABEL}")
    return labels


def _cell_extremes(array: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest of the eight voxels at (k, j, i) + {0, 1}^3, for every (k, j, i)."""
    lowest, highest = array.copy(), array.copy()
    for here, there in _neighbours():
        # In place, in ascending memory order: `there` still has its old value when `here` is written.
        lowest[here] = np.minimum(lowest[here], lowest[there])
        highest[here] = np.maximum(highest[here], highest[there])
    return lowest, highest


def _are_same(array: np.ndarray) -> np.ndarray:
    """(k, j, i) bool: the eight voxels at (k, j, i) + {0, 1}^3 have the same value."""
    same = np.ones(array.shape, bool)
    for here, there in _neighbours():
        equal = array[here] == array[there]
        equal &= same[there]
        same[here] &= equal
    return same


def _neighbours() -> list[tuple[tuple[slice, ...], tuple[slice, ...]]]:
    """Indices of voxels and of those after them, along k, j and i; the last ones have none."""
    pairs = []
    for axis in range(3):
        here, there = [slice(None)] * 3, [slice(None)] * 3
        here[axis], there[axis] = slice(0, -1), slice(1, None)
        pairs.append((tuple(here), tuple(there)))
    return pairs


def _keep_membrane_inside(distance: np.ndarray, reach: float) -> None:
    """Move the margin of the fluid distance, (k, j, i) uint8, beyond the membrane, on its own side.

    Look-ups outside the volume find the margin: within the membrane, as in small voxels, it would fill all space.
    """
    below, above = np.clip([127.5 - reach - 2.0, 127.5 + reach + 2.0], 0.0, 255.0).astype(np.uint8)
    for axis in range(3):
        for end in (0, -1):
            face = np.moveaxis(distance, axis, 0)[end]
            face[:] = np.where(face < 128, np.minimum(face, below), np.maximum(face, above))


def _membrane_shape(tissues: TissueTable) -> tuple | None:
    membrane = tissues.membrane
    if membrane is None:
        return None
    return membrane.thickness_mm, _fluid_labels(tissues, membrane), _sheet_label(tissues)


def _sheet_label(tissues: TissueTable) -> int:
    """The label of the membrane's own tissue, if it is one of the fluids; -1 for none."""
    membrane = tissues.membrane
    if membrane is None or membrane.thickness_mm == 0:
        return -1
    return next((n for n in _fluid_labels(tissues, membrane) if tissues[n].name == membrane.tissue.name), -1)


def _fluid_labels(tissues: TissueTable, membrane: Membrane) -> tuple[int, ...]:
    return tuple(label for label, tissue in tissues.items() if tissue.name in membrane.fluids)
