"""The acoustic medium on the host, from a label map and a tissue table (docs/physics.md#2-interfaces)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, special

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.sheets.surfels import Surfels
from SlicerUSSim.Logic.opencl.layout import CONSTANTS, TISSUE
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import TISSUE_PARAMETERS
from tests.reference.drawn import DrawnPlanes
from tests.reference.elementary import f32, ramp
from tests.reference.flat_borders import layer_borders
from tests.reference.sheets import Sheets
from tests.reference.smoothed_borders import SmoothGrid

WIDE_SIGMA, HALVED_SIGMA = 3.0, 4.0  # of the Gaussians for smoothing the indicators, voxels of their grids
_LOSSY = 2.0  # dB/(cm MHz) of tissues that are groups of their own
_FARTHEST = 2.2  # limit of the fluid distance in standard deviations; it has eight bits
_SHARES = 65535  # steps of its share
_MOST_GROUPS, _MOST_VALUES = 6, 100_000_000  # of the smoothed indicators of acoustic groups


class HostMedium:
    """Labels, fluid distance, acoustic groups with their smoothed indicators, and a record per tissue.

    Parameters
    ----------
    labels : Volume of tissue labels.
    tissues : TissueTable with a tissue for every label.
    membership, sheets : as in Medium.
    """

    def __init__(
        self,
        labels: Volume,
        tissues: TissueTable,
        membership: tuple[np.ndarray, np.ndarray] | None = None,
        sheets: Surfels | None = None,
    ) -> None:
        self.tissues = tissues
        #: (k, j, i) with a voxel of coupling medium on every side
        self.label = np.pad(labels.array.astype(np.uint8), 1)
        #: The sheets found in the MRI; None without
        self.drawn = DrawnPlanes.of(sheets, labels, self.label, tissues)
        if self.drawn is not None:
            self.label = self.drawn.label
        self.dims = np.array(self.label.shape[::-1])
        columns = labels.ijk_to_ras[:3, :3]
        spacing = np.sqrt((columns**2).sum(axis=0))
        self.voxel_mm = spacing.min()
        #: (3, 4) from RAS mm to indices (i, j, k) of the padded volume
        rotation = np.linalg.inv(columns)
        self.ras_to_voxel = np.column_stack([rotation, 1.0 - rotation @ labels.ijk_to_ras[:3, 3]])
        values, counts = np.unique(labels.array, return_counts=True)
        present = [int(values[n]) for n in np.argsort(-counts, kind="stable")]
        #: (MAX_TISSUES,) layout.TISSUE
        self.rows = _tissue_rows(tissues, present)
        #: (k, j, i) uint8
        self.group = self.rows["group"].astype(np.uint8)[self.label]
        # Tissues are smoothed as if they went on beyond the volume.
        continued = np.pad(self.group[1:-1, 1:-1, 1:-1], 1, mode="edge")
        if membership is None:
            second, part = continued, np.zeros(continued.shape)
        else:
            second = self.rows["group"].astype(np.uint8)[np.pad(membership[0], 1, mode="edge")]
            part = np.pad(membership[1], 1, mode="edge") / 255.0
            if self.drawn is not None:
                part[self.drawn.closed] = 0.0
        groups = np.union1d(self.group, second[part > 0.0])
        self.smooth_groups = int(min(groups.max() + 1, _MOST_GROUPS, max(_MOST_VALUES // self.label.size, 2)))
        #: (groups, k, j, i) uint16, 65535 for 1; and at half the resolution
        self.smooth = np.zeros((self.smooth_groups, *self.label.shape), np.uint16)
        self.smoother = np.zeros((self.smooth_groups, *((n + 1) // 2 for n in self.label.shape)), np.uint16)
        if len(groups) > 1:
            for number in groups[groups < self.smooth_groups]:
                member = (1.0 - part) * (continued == number) + part * (second == number)
                share = ndimage.gaussian_filter(member.astype(np.float32), WIDE_SIGMA, mode="nearest", truncate=2.5)
                self.smooth[number] = np.rint(65535.0 * np.clip(share, 0.0, 1.0))
                half = np.pad(self.smooth[number], [(0, n % 2) for n in self.label.shape], mode="edge") / 65535.0
                for axis in range(3):
                    even, odd = (half.take(range(start, half.shape[axis], 2), axis) for start in (0, 1))
                    half = 0.5 * (even + odd)
                share = ndimage.gaussian_filter(half.astype(np.float32), HALVED_SIGMA, mode="nearest", truncate=3.5)
                self.smoother[number] = np.rint(65535.0 * np.clip(share, 0.0, 1.0))
        #: The planes of thin sheets of the membrane's own tissue, if there are any
        self.sheets = self._sheets(spacing)
        #: (k, j, i) uint8 about 127.5, and half the membrane in its unit; None and -1 without a membrane
        self.distance, self.membrane_reach = self._fluid_distance(spacing)

    def _sheets(self, spacing_mm: np.ndarray) -> Sheets | None:
        membrane = self.tissues.membrane
        if membrane is None or membrane.thickness_mm == 0:
            return None
        for label, tissue in self.tissues.items():
            if tissue.name == membrane.tissue.name and tissue.name in membrane.fluids:
                return Sheets(self.label, label, spacing_mm) if (self.label == label).any() else None
        return None

    def _fluid_distance(self, spacing_mm: np.ndarray) -> tuple[np.ndarray | None, float]:
        """The fraction Phi(d / sigma) of a Gaussian is behind a plane at distance d from its centre."""
        membrane = self.tissues.membrane
        if membrane is None or membrane.thickness_mm == 0:
            return None, -1.0
        fluids = [label for label, tissue in self.tissues.items() if tissue.name in membrane.fluids]
        fluid = np.isin(self.label, fluids)
        if fluid.all() or not fluid.any():
            return None, -1.0
        sigma_mm = 0.75 * np.prod(spacing_mm) ** (1.0 / 3.0)
        if self.sheets is not None:
            fluid &= ~self.sheets.is_thin
        share = ndimage.gaussian_filter(
            fluid.astype(np.float32), sigma_mm / spacing_mm[::-1], mode="nearest", truncate=3.0
        )
        per_sigma = 127.5 / _FARTHEST
        steps = np.rint(np.clip(share, 0.0, 1.0) * _SHARES) / _SHARES
        sigmas = np.clip(special.ndtri(steps), -_FARTHEST, _FARTHEST)
        distance, reach = np.rint(127.5 + per_sigma * sigmas), 0.5 * membrane.thickness_mm / sigma_mm * per_sigma
        self._flatten(distance, fluids, spacing_mm, per_sigma / 0.75)
        # Outside the volume, where look-ups find its margin, there is no membrane.
        margin = np.ones(distance.shape, bool)
        margin[1:-1, 1:-1, 1:-1] = False
        below, above = (np.clip(127.5 + sign * (reach + 2.0), 0.0, 255.0) for sign in (-1.0, 1.0))
        distance[margin & (distance < 127.5)] = np.minimum(distance, np.floor(below))[margin & (distance < 127.5)]
        distance[margin & (distance > 127.5)] = np.maximum(distance, np.floor(above))[margin & (distance > 127.5)]
        return distance.astype(np.uint8), reach

    def _flatten(self, distance: np.ndarray, fluids: list[int], spacing_mm: np.ndarray, per_voxel: float) -> None:
        """Where a fluid's border is flat it is placed by the wide Gaussians, which do not see the voxels' steps."""
        group, labels = self.rows["group"], {0, *np.unique(self.label[1:-1, 1:-1, 1:-1]).tolist()}
        counts = {label: (self.label[1:-1, 1:-1, 1:-1] == label).sum() for label in labels}
        alone = [
            label for label in labels
            if label in fluids and counts[label] and {n for n in labels if group[n] == group[label]} <= set(fluids)
        ]  # fmt: skip
        if not alone or spacing_mm.max() > 1.02 * spacing_mm.min():
            return
        fluid = int(group[max(alone, key=lambda label: counts[label])])
        if fluid >= self.smooth_groups:
            return
        at = np.flatnonzero((distance > 0) & (distance < 255))
        voxel = np.stack(np.unravel_index(at, distance.shape)[::-1], -1).astype(np.float32)
        narrow = f32((distance.ravel()[at] - 127.5) / per_voxel)
        found = narrow
        full = SmoothGrid(self.smooth, 8.91, 0.9, 2.5)
        halved = SmoothGrid(self.smoother, 18.29, 0.99, 1.25)
        for grid, place, scale in ((full, voxel, 1), (halved, f32(0.5) * voxel - f32(0.25), 2)):
            border = grid.border_of(place, np.full(len(at), fluid))
            layer = layer_borders(border, float(grid.farthest))
            wide, of_layer = f32(-scale) * border.overshoot, f32(-scale) * layer.overshoot
            sure = border.confidence * (f32(1) - ramp(0.6, 0.9, np.abs(wide - narrow)))
            sure_layer = layer.confidence * (f32(1) - ramp(0.6, 0.9, np.abs(of_layer - narrow)))
            is_isolated = sure >= sure_layer
            wide, sure = np.where(is_isolated, wide, of_layer), np.where(is_isolated, sure, sure_layer)
            found = found + sure * (wide - found)
        distance.ravel()[at] = np.rint(np.clip(127.5 + per_voxel * found, 0.0, 255.0))


def _tissue_rows(tissues: TissueTable, present: list[int]) -> np.ndarray:
    """Tissues of equal speed and impedance form a group, very lossy ones another, by decreasing frequency of labels."""
    members = {label: tissues[label] for label in present}
    members.update((label, tissue) for label, tissue in tissues.items() if label not in members)
    fluids: tuple[str, ...] = ()
    if tissues.membrane is not None:
        members[CONSTANTS["MEMBRANE_LABEL"]] = tissues.membrane.tissue
        fluids = tissues.membrane.fluids
    rows = np.zeros(CONSTANTS["MAX_TISSUES"], TISSUE)
    rows["label_of_group"] = -1
    known: list[tuple[float, float, bool]] = []
    for label, tissue in members.items():
        acoustics = tissue.speed_of_sound_m_s, tissue.impedance_mrayl, tissue.attenuation_db_cm_mhz > _LOSSY
        if acoustics not in known:
            known.append(acoustics)
        row = rows[label]
        for parameter in TISSUE_PARAMETERS:
            if parameter.name in (TISSUE.names or ()):
                row[parameter.name] = getattr(tissue, parameter.name)
        share = special.ndtr(-tissue.mu1)
        row["scatterer_share"], row["group"] = share, known.index(acoustics)
        rows[known.index(acoustics)]["label_of_group"] = label
        row["scatterer_variance"] = share * (1.0 - share) * tissue.mu0**2 + share * tissue.sigma0**2
        row["is_fluid"] = label in tissues and tissue.name in fluids
    return rows
