"""MRI phantoms of brains whose tissues are known.

An image is the sum of the share of every tissue in a voxel times the tissue's mean, as in the BrainWeb phantoms
(Collins et al., IEEE TMI 17(3), 1998), times a smooth bias field, with Rician noise (Gudbjartsson and Patz, Magnetic
Resonance in Medicine 34(6), 1995). Noise is relative to the brightest healthy tissue, as in BrainWeb: 3 % is a good
scan, 7 % a poor one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import mni152

#: Truth labels of the tissues, from 1
TISSUES = ("csf", "grey matter", "white matter", "enhancing", "necrosis", "oedema")
#: Mean of every tissue. T1 healthy: the means of MNI152 where a map says 95 % or more. The others are typical ratios of
#: a clinical 3 T scanner (T1 times of Wansapura et al., JMRI 9(4), 1999, for order), not measurements.
MEANS = {
    "t1": (68.0, 167.0, 222.0, 222.0, 85.0, 150.0),
    "t1gd": (68.0, 167.0, 222.0, 330.0, 85.0, 150.0),
    "t2": (240.0, 120.0, 85.0, 135.0, 220.0, 180.0),
    "flair": (40.0, 160.0, 125.0, 180.0, 80.0, 230.0),
}
#: Where Debian's package mricron-data keeps the Colin27 head and its brain
COLIN27 = Path("/usr/share/mricron/templates")
#: Class means of Colin27's brain (ch2bet): the two modes of its histogram, and the middle of the ventricles
_COLIN27_MEANS = (38.0, 86.0, 113.0)


@dataclass(frozen=True, eq=False)
class TissueMaps:
    """The share of every tissue in every voxel of a brain."""

    name: str
    #: (3 or more, k, j, i) float32, in the order of TISSUES; sums to 1 in the mask and is 0 outside
    shares: np.ndarray
    #: (k, j, i) bool
    mask: np.ndarray
    #: (4, 4) voxel (i, j, k, 1) to RAS mm
    ijk_to_ras: np.ndarray
    #: Shares by which the image looks, if they differ from the tissues: deep nuclei are grey matter, and bright in T1
    appearance: np.ndarray | None = None
    #: (k, j, i) bool, where the tissue is known; None: in the whole mask
    judged: np.ndarray | None = None

    @property
    def csf(self) -> np.ndarray:
        """(k, j, i) float32 share of CSF."""
        return self.shares[0]

    @property
    def grey(self) -> np.ndarray:
        """(k, j, i) float32 share of grey matter."""
        return self.shares[1]

    @property
    def white(self) -> np.ndarray:
        """(k, j, i) float32 share of white matter."""
        return self.shares[2]

    def coarser(self, factor: int) -> TissueMaps:
        """On voxels `factor` times as large, with the partial volumes that such voxels have (block means)."""
        shape = [size // factor for size in self.mask.shape]
        crop = tuple(slice(0, size * factor) for size in shape)
        blocks = [value for size in shape for value in (size, factor)]
        mask = self.mask[crop].reshape(blocks).mean(axis=(1, 3, 5)) >= 0.5
        shares = np.stack([share[crop].reshape(blocks).mean(axis=(1, 3, 5)) for share in self.shares])
        shares = np.where(mask, shares / np.maximum(shares.sum(axis=0), 1e-6), 0.0).astype(np.float32)
        to_fine = np.diag([factor, factor, factor, 1.0])
        to_fine[:3, 3] = 0.5 * (factor - 1)
        return TissueMaps(f"{self.name}, {factor} mm", shares, mask, self.ijk_to_ras @ to_fine)

    def warped(self, millimetres: float = 4.0, seed: int = 1) -> TissueMaps:
        """Another brain: turned by 8 degrees, and bent by cubic B-splines with random displacements of this deviation.

        For methods that are led by an atlas: on the atlas's own brain they would know the truth.
        """
        import SimpleITK as sitk

        rng = np.random.default_rng(seed)
        images = [Volume(share, self.ijk_to_ras).to_sitk() for share in self.shares]
        bend = sitk.BSplineTransformInitializer(images[0], [6, 6, 6])
        bend.SetParameters(rng.normal(0.0, millimetres, len(bend.GetParameters())).tolist())
        turn = sitk.Euler3DTransform()
        turn.SetCenter(images[0].TransformContinuousIndexToPhysicalPoint([0.5 * n for n in images[0].GetSize()]))
        turn.SetRotation(*np.radians(rng.permutation([8.0, -4.0, 3.0])).tolist())
        both = sitk.CompositeTransform([bend, turn])
        shares = np.stack([sitk.GetArrayFromImage(sitk.Resample(each, each, both, sitk.sitkLinear)) for each in images])
        total = shares.sum(axis=0)
        shares = np.where(total > 0.5, shares / np.maximum(total, 1e-6), 0.0).astype(np.float32)
        return TissueMaps(f"{self.name}, warped", shares, total > 0.5, self.ijk_to_ras)


def tissue_maps(name: str) -> TissueMaps | None:
    """The maps of a brain: "mni152" or "colin27"; None without Debian's mricron-data, which has the latter.

    mni152: the published maps of the MNI152 2009a template (Fonov et al., NeuroImage 54(1), 2011).

    colin27: an average of 27 scans of one person (Holmes et al., J. Comput. Assist. Tomogr. 22(2), 1998), from Debian's
    mricron-data. No share maps are published with it, so that they come from its intensity, which has little noise:
    linear between the means of CSF, grey and white matter, pure beyond the outer two. A phantom of it has the anatomy
    of one person, and its truth depends on none of the methods that are judged by it. It is not the truth about
    that person: tissue between grey and white in intensity, such as deep nuclei, is partly white here.

    Raises SimulationError for another name.
    """
    require(name in ("mni152", "colin27"), f"tissue maps {name!r} are unknown, expected mni152 or colin27")
    if name == "colin27":
        return _colin27()
    atlas = mni152()
    shares = np.stack([atlas.csf.array, atlas.grey.array, atlas.white.array])
    return TissueMaps("MNI152", shares, atlas.t1.array > 0, atlas.t1.ijk_to_ras)


def _colin27() -> TissueMaps | None:
    path = COLIN27 / "ch2bet.nii.gz"
    if not path.exists():
        return None
    brain = Volume.read(path)
    mask = brain.array > 0
    intensity = brain.array.astype(np.float32)
    csf, grey, white = _COLIN27_MEANS
    shares = np.stack(
        [
            np.interp(intensity, (csf, grey), (1.0, 0.0)),
            np.interp(intensity, (csf, grey, white), (0.0, 1.0, 0.0)),
            np.interp(intensity, (grey, white), (0.0, 1.0)),
        ]
    )
    return TissueMaps("Colin27", np.where(mask, shares, 0.0).astype(np.float32), mask, brain.ijk_to_ras)


def with_ring_tumour(
    maps: TissueMaps, centre_ras_mm: tuple[float, float, float] = (28.0, -22.0, 28.0), radius_mm: float = 12.0
) -> TissueMaps:
    """The same brain with a glioblastoma: a rim that enhances, 3 mm thick, around necrosis, in oedema.

    The oedema reaches 10 mm beyond the rim, only where there is white matter, as it spreads in life. The default
    centre lies in the white matter of the right hemisphere of both brains.
    """
    within = _lobed(maps, centre_ras_mm)
    outer, core = within(radius_mm), within(radius_mm - 3.0)
    oedema = np.maximum(within(radius_mm + 10.0) - outer, 0.0) * maps.white
    shares = np.zeros((len(TISSUES), *maps.mask.shape), np.float32)
    shares[:3] = maps.shares[:3] * (1.0 - outer)
    shares[2] = np.maximum(shares[2] - oedema, 0.0)
    shares[3], shares[4], shares[5] = outer - core, core, oedema
    shares = np.where(maps.mask, shares / np.maximum(shares.sum(axis=0), 1e-6), 0.0).astype(np.float32)
    return replace(maps, name=f"{maps.name}, ring tumour", shares=shares)


def with_low_grade_tumour(
    maps: TissueMaps, centre_ras_mm: tuple[float, float, float] = (28.0, -22.0, 28.0), radius_mm: float = 12.0
) -> TissueMaps:
    """The same brain with a tumour that does not enhance, as watery as oedema, also where grey matter was."""
    inside = _lobed(maps, centre_ras_mm)(radius_mm)
    shares = np.zeros((len(TISSUES), *maps.mask.shape), np.float32)
    shares[:3] = maps.shares[:3] * (1.0 - inside)
    shares[5] = inside
    return replace(maps, name=f"{maps.name}, low-grade tumour", shares=shares)


def _lobed(maps: TissueMaps, centre_ras_mm: tuple[float, float, float]) -> Callable[[float], np.ndarray]:
    """(k, j, i) float32 share of each voxel within a radius, as a function of it; lobed, so that no method profits from
    a sphere."""
    k, j, i = np.indices(maps.mask.shape, np.float32)
    ijk = np.stack([i, j, k], axis=-1)
    ras = ijk @ maps.ijk_to_ras[:3, :3].T.astype(np.float32) + maps.ijk_to_ras[:3, 3].astype(np.float32)
    offset = ras - np.asarray(centre_ras_mm, np.float32)
    x, y, z = np.moveaxis(offset, -1, 0)
    angle, height = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    distance = np.linalg.norm(offset, axis=-1) / (1.0 + 0.12 * np.sin(3.0 * angle) * np.cos(2.0 * height))
    return lambda radius: np.clip(radius - distance + 0.5, 0.0, 1.0) * maps.mask


# ---- images ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BrainPhantom:
    """An MRI of a brain whose tissues are known."""

    name: str
    #: float32, 0 outside the brain
    mri: Volume
    #: uint8, 1 in the region to segment
    mask: Volume
    #: uint8, the label in TISSUES with the largest share, within the mask; 0 outside and where it is not known
    truth: Volume
    #: Maps, bias field and noise it was made from. (k, j, i) float32 factor; standard deviation in the image's unit
    maps: TissueMaps
    bias: np.ndarray
    noise: float


#: Parts of a brain as MRIs of operations and single slabs show them: from and to, of its extent along R, A and S
PARTS = {
    "coronal slab": ((0.0, 1.0), (0.45, 0.52), (0.0, 1.0)),
    "part of a coronal slab": ((0.2, 1.0), (0.62, 0.69), (0.2, 1.0)),
    "axial slab": ((0.0, 1.0), (0.0, 1.0), (0.45, 0.75)),
    "sagittal slab": ((0.55, 0.7), (0.0, 1.0), (0.0, 1.0)),
    "quarter": ((0.5, 1.0), (0.3, 0.9), (0.4, 1.0)),
}


def part_of(case: BrainPhantom, part: str) -> BrainPhantom:
    """One of PARTS of a phantom, cut out along its voxels; its maps stay those of the whole brain.

    Raises SimulationError for an unknown part.
    """
    require(part in PARTS, f"part is {part!r}, expected one of {', '.join(PARTS)}")
    box = part_box(case.mask, PARTS[part])
    mri, mask, truth = (cut_to(volume, box) for volume in (case.mri, case.mask, case.truth))
    return replace(case, name=f"{case.name}, {part}", mri=mri, mask=mask, truth=truth, bias=case.bias[box])


def part_box(mask: Volume, part: Sequence[tuple[float, float]], margin: int = 0) -> tuple[slice, ...]:
    """(k, j, i) voxels of a part of a brain: from and to, of the extent of its `mask` along R, A and S.

    With a margin in voxels around the brain where the part reaches its end.
    """
    whole = ndimage.find_objects((mask.array > 0).astype(np.uint8))[0]
    inside = list(whole)
    for row, (low, high) in zip(mask.ijk_to_ras, part, strict=False):
        column = int(np.abs(row[:3]).argmax())
        if row[column] < 0.0:
            low, high = 1.0 - high, 1.0 - low
        side, size = whole[2 - column], whole[2 - column].stop - whole[2 - column].start
        start = side.start + int(low * size) - (margin if low == 0.0 else 0)
        stop = side.start + int(high * size) + (margin if high == 1.0 else 0)
        inside[2 - column] = slice(max(start, 0), min(stop, mask.array.shape[2 - column]))
    return tuple(inside)


def cut_to(volume: Volume, box: tuple[slice, ...]) -> Volume:
    """A volume's voxels in a box (k, j, i), where they are in the patient."""
    matrix = volume.ijk_to_ras.copy()
    matrix[:3, 3] = (matrix @ [*(side.start for side in reversed(box)), 1.0])[:3]
    return Volume(np.ascontiguousarray(volume.array[box]), matrix)


def phantom(
    maps: TissueMaps,
    contrast: str = "t1",
    *,
    noise: float = 0.03,
    bias: float = 0.2,
    seed: int = 0,
    mask: str = "full",
) -> BrainPhantom:
    """The MRI of a brain with these tissues.

    Parameters
    ----------
    contrast : "t1", "t1gd", "t2" or "flair".
    noise : standard deviation of the noise in either channel, relative to the mean of the brightest healthy tissue.
    bias : the field is between 1 - bias and 1 + bias in the brain; see bias_field.
    seed : of noise and bias field. Two contrasts of one patient need different ones.
    mask : "full": all of the maps. "tight": without the CSF around the brain, as brain extraction often leaves it:
        grey and white matter closed by 4 mm, filled; ventricles and narrow sulci remain.

    Raises SimulationError for an unknown contrast or mask.
    """
    require(contrast in MEANS, f"contrast is {contrast!r}, expected one of {', '.join(MEANS)}")
    require(mask in ("full", "tight"), f"mask is {mask!r}, expected full or tight")
    rng = np.random.default_rng(seed)
    means = np.array(MEANS[contrast], np.float32)
    shares = maps.shares if maps.appearance is None else maps.appearance
    signal = np.tensordot(means[: len(shares)], shares, 1)
    field = bias_field(maps.mask, bias, rng)
    deviation = noise * float(max(MEANS[contrast][:3]))
    real = signal * field + deviation * rng.standard_normal(signal.shape, np.float32)
    imaginary = deviation * rng.standard_normal(signal.shape, np.float32)
    image = np.where(maps.mask, np.hypot(real, imaginary), 0.0).astype(np.float32)
    inside = maps.mask if mask == "full" else tight_mask(maps)
    known = inside if maps.judged is None else inside & maps.judged
    truth = np.where(known, maps.shares.argmax(axis=0) + 1, 0).astype(np.uint8)
    words = [f"{noise:.0%} noise", *([f"{bias:.0%} bias"] if bias else []), f"{mask} mask"]
    mri, inside, truth = (Volume(array, maps.ijk_to_ras) for array in (image, inside.astype(np.uint8), truth))
    return BrainPhantom(f"{maps.name} {contrast}, {', '.join(words)}", mri, inside, truth, maps, field, deviation)


def bias_field(mask: np.ndarray, bias: float, rng: np.random.Generator) -> np.ndarray:
    """(k, j, i) float32: cosines of at most one period along each axis of the brain with random weights.

    Scaled so that it is exactly from 1 - bias to 1 + bias inside the mask.
    """
    if bias == 0.0:
        return np.ones(mask.shape, np.float32)
    box = ndimage.find_objects(mask.astype(np.uint8))[0]
    cosines = []
    for side, size in zip(box, mask.shape, strict=True):
        along = (np.arange(size, dtype=np.float32) - side.start) / (side.stop - side.start)
        cosines.append(np.stack([np.cos(np.pi * order * along) for order in range(3)]))
    weights = rng.standard_normal((3, 3, 3)).astype(np.float32)
    weights /= 1.0 + np.add.outer(np.add.outer(np.arange(3), np.arange(3)), np.arange(3)) ** 2  # smooth
    field = np.einsum("abc,ak,bj,ci->kji", weights, *cosines, optimize=True)
    low, high = float(field[mask].min()), float(field[mask].max())
    return (1.0 + bias * (2.0 * (field - low) / (high - low) - 1.0)).astype(np.float32)


def tight_mask(maps: TissueMaps) -> np.ndarray:
    """(k, j, i) bool: the brain without the CSF around it; see phantom."""
    import SimpleITK as sitk

    reach = max(round(4.0 / float(np.linalg.norm(maps.ijk_to_ras[:3, 0]))), 1)
    tissue = sitk.GetImageFromArray(((maps.csf < 0.5) & maps.mask).astype(np.uint8))
    closed = sitk.BinaryFillhole(sitk.BinaryMorphologicalClosing(tissue, [reach] * 3, sitk.sitkBall))
    return (sitk.GetArrayFromImage(closed) > 0) & maps.mask
