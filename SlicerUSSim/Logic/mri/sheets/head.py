"""The head in which sheets are found: its MRI around the brain, without bias field, and its place in the atlas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require, required
from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas_registration import AtlasFit
from SlicerUSSim.Logic.mri.coarse import largest_component, widened, with_thin_slices
from SlicerUSSim.Logic.mri.refinement import closed, on_grid
from SlicerUSSim.Logic.mri.segmentation import Segmentation

#: Voxels of the grid on which sheets are found; an image whose voxels differ by less than the share from the nearest of
#: these is not resampled
_FINEST_MM, _COARSEST_MM, _NEAR = 0.8, 1.0, 0.15
#: Along each axis of that grid
LEAST_VOXELS = 3
#: Around the brain
_MARGIN_MM = 10.0
#: Across which sulci are closed, so that depth is counted from the hull of the brain
_HULL_MM = 8.0
#: Of the bias field that is continued beyond the brain, and the spacing at which that is done
_FIELD_MM, _FIELD_STEP_MM = 8.0, 4.0
_CONTRASTS = ("t1", "t1gd", "t2")


def require_contrast(contrast: str) -> None:
    """Raise SimulationError for a contrast in which sheets are not found."""
    require(
        contrast in _CONTRASTS,
        f"sheets are not found in contrast {contrast!r}, expected one of: {', '.join(_CONTRASTS)} (in a FLAIR, "
        "intensities do not rise or fall from CSF over grey to white matter)",
    )


@dataclass(frozen=True, eq=False)
class Head:
    """What all sheets are found from. Intensities rise from CSF to grey to white matter: those of a T2 are negated."""

    #: (k, j, i) float32 without the bias field, also around the brain
    image: Volume
    #: (k, j, i) True in the brain, on the grid of the image
    brain: np.ndarray
    #: Mean intensities of the tissues, and deviation by noise of each
    csf: float
    grey: float
    white: float
    noise: float
    #: Whether vessels and dura enhance
    is_enhanced: bool
    #: None for a part of a brain: the search then works without the atlas
    registered: AtlasFit | None

    @classmethod
    def of(cls, mri: Volume, segmentation: Segmentation, contrast: str) -> Head:
        """Raises SimulationError for a FLAIR, and for an MRI of another grid."""
        require_contrast(contrast)
        mri = with_thin_slices(mri)
        require(
            mri.array.shape == segmentation.labels.array.shape
            and bool(np.allclose(mri.ijk_to_ras, segmentation.labels.ijk_to_ras, atol=1e-3)),
            f"the MRI has {mri.array.shape} voxels (k, j, i) and its segmentation {segmentation.labels.array.shape}, "
            "expected one grid",
        )
        sign = -1.0 if contrast == "t2" else 1.0
        names = segmentation.tissue_names
        tissues = ("csf", "grey matter", "white matter")
        csf, grey, white = (sign * float(segmentation.means[names.index(tissue)]) for tissue in tissues)
        require(
            csf < grey < white,
            f"CSF, grey and white matter have means {sign * csf:.4g}, {sign * grey:.4g}, {sign * white:.4g}, expected "
            f"the order of {contrast}",
        )
        box = _box(segmentation.brain.mask, _MARGIN_MM)
        images = (mri, segmentation.brain.mask, mri.with_array(segmentation.corrected))
        part, mask, corrected = (_part(image, box).along() for image in images)
        inside = mask.array > 0
        image = part.with_array(np.float32(sign) * _without_field(part, corrected.array, inside))
        noise = float(segmentation.standard_deviations[names.index("white matter")])
        head = cls.of_part(image, inside, (csf, grey, white), noise, contrast == "t1gd")
        return replace(head, registered=segmentation.atlas)

    @classmethod
    def of_part(
        cls, image: Volume, brain: np.ndarray, means: Sequence[float], noise: float, is_enhanced: bool
    ) -> Head:  # fmt: skip
        """The head in which an atlas does not lead: `image` without bias field, (k, j, i) bool `brain` on its grid.

        `means` of CSF, grey and white matter, which rise.
        """
        csf, grey, white = map(float, means)
        grid = _working_grid(image)
        if grid is not image:
            brain = on_grid(image.with_array(brain.astype(np.float32)), grid) > 0.5
        return cls(grid, brain, csf, grey, white, noise, is_enhanced, None)

    @property
    def atlas(self) -> AtlasFit:
        """Raises SimulationError without one."""
        return required(
            self.registered,
            "this needs the atlas, which did not lead the segmentation (see its notes), expected a whole brain",
        )

    @property
    def spacing(self) -> np.ndarray:
        """(3,) mm along k, j, i."""
        return self.image.spacing_mm[::-1]

    @property
    def voxel_mm3(self) -> float:
        return float(np.prod(self.spacing))

    @cached_property
    def grid_to_atlas(self) -> np.ndarray:
        """(4, 4) from i, j, k to millimetres of the atlas."""
        return self.atlas.patient_to_atlas @ self.image.ijk_to_ras

    @cached_property
    def in_atlas(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(k, j, i) float32 x, y, z of every voxel in millimetres of the atlas."""
        k, j, i = np.ogrid[tuple(map(slice, self.brain.shape))]
        x, y, z = ((row[0] * i + row[1] * j + row[2] * k + row[3]).astype(np.float32) for row in self.grid_to_atlas[:3])
        return x, y, z

    @cached_property
    def depth(self) -> np.ndarray:
        """(k, j, i) float32 mm inside the hull of the brain; 0 or less outside.

        Where the image cuts the brain, the brain continues as at the cut.
        """
        radius = _HULL_MM / float(self.spacing.mean())
        n = 2 * int(radius) + 2
        thinnest = min(self.brain.shape)
        require(
            thinnest >= LEAST_VOXELS,
            f"the image is {thinnest} voxels of {self.image.spacing_mm.min():.2g} mm thick, expected at least "
            f"{LEAST_VOXELS} to find sheets in it",
        )
        # On another grid than the image's, the outermost voxels are outside.
        inner = self.brain[1:-1, 1:-1, 1:-1]
        hull = closed(np.pad(inner, n + 1, mode="edge"), radius)
        return -distance_to(hull, self.image.spacing_mm)[n:-n, n:-n, n:-n]

    @cached_property
    def white_matter(self) -> np.ndarray:
        """(k, j, i) bool, by intensity: the largest connected part."""
        smooth = self.smoothed(0.5)
        inside = (smooth > 0.5 * (self.grey + self.white)) & (smooth < self.white + 4.0 * self.noise) & self.brain
        return largest_component(inside)

    @cached_property
    def white_distance(self) -> np.ndarray:
        """(k, j, i) float32 mm to the white matter, 0 or less in it."""
        return distance_to(self.white_matter, self.image.spacing_mm)

    def around(self, region: np.ndarray, margin_mm: float) -> tuple[Head, np.ndarray]:
        """(the part of the head that holds a region (k, j, i), the region there)."""
        box = _box(self.image.with_array(region.astype(np.uint8)), margin_mm)
        return replace(self, image=_part(self.image, box), brain=self.brain[box]), region[box]

    def smoothed(self, deviation_mm: float) -> np.ndarray:
        """(k, j, i) float32 image after a Gaussian filter."""
        return ndimage.gaussian_filter(self.image.array, deviation_mm / self.spacing)

    def fluid(self, values: np.ndarray) -> np.ndarray:
        """Share of CSF in voxels of some intensities, between grey matter and CSF."""
        return np.clip((self.grey - values) / (self.grey - self.csf), 0.0, 1.0)

    def at(self, points: np.ndarray, array: np.ndarray | None = None, order: int = 1) -> np.ndarray:
        """(n,) values of an array (k, j, i), or of the image, at (n, 3) RAS mm; 0 outside."""
        matrix = self.image.ras_to_ijk
        index = (points @ matrix[:3, :3].T + matrix[:3, 3])[:, ::-1].T
        source = self.image.array if array is None else array
        return ndimage.map_coordinates(source, index, order=order, mode="constant", output=np.float32)

    def to_ras(self, kji: np.ndarray) -> np.ndarray:
        """(n, 3) RAS mm of (n, 3) places k, j, i."""
        return kji[:, ::-1] @ self.image.ijk_to_ras[:3, :3].T + self.image.ijk_to_ras[:3, 3]

    def to_atlas(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) millimetres of the atlas of (n, 3) RAS mm."""
        return points @ self.atlas.patient_to_atlas[:3, :3].T + self.atlas.patient_to_atlas[:3, 3]

    def from_atlas(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) RAS mm of (n, 3) millimetres of the atlas."""
        back = np.linalg.inv(self.atlas.patient_to_atlas)
        return points @ back[:3, :3].T + back[:3, 3]

    def carried(self, array: np.ndarray) -> np.ndarray:
        """(k, j, i) float32 values of an array on the atlas's grid, by the affine transform."""
        source = Volume(array, np.linalg.inv(self.atlas.patient_to_atlas) @ self.atlas.atlas.t1.ijk_to_ras)
        return on_grid(source, self.image)


def _box(mask: Volume, margin_mm: float) -> tuple[slice, ...]:
    found = ndimage.find_objects((mask.array > 0).astype(np.uint8))[0]
    more = np.ceil(margin_mm / mask.spacing_mm[::-1]).astype(int)
    return tuple(slice(max(side.start - int(n), 0), side.stop + int(n)) for side, n in zip(found, more, strict=True))


def _part(volume: Volume, box: tuple[slice, ...]) -> Volume:
    matrix = volume.ijk_to_ras.copy()
    matrix[:3, 3] = (matrix @ [*(side.start for side in reversed(box)), 1.0])[:3]
    return Volume(np.ascontiguousarray(volume.array[box], np.float32), matrix)


def _without_field(part: Volume, corrected: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(k, j, i) float32 image without the field that was taken out of the brain, continued beyond it."""
    usable = inside & (part.array > np.percentile(part.array[inside], 5.0)) & (corrected != 0)
    gain = np.divide(corrected, part.array, where=usable, out=np.zeros_like(corrected))
    step = max(round(_FIELD_STEP_MM / float(part.spacing_mm.mean())), 1)
    some = (slice(None, None, step),) * 3
    sizes = _FIELD_MM / (step * part.spacing_mm[::-1])
    amount = ndimage.gaussian_filter(usable[some].astype(np.float32), sizes, truncate=8.0)
    smooth = ndimage.gaussian_filter(gain[some], sizes, truncate=8.0) / np.maximum(amount, 1e-9)
    smooth = np.where(amount > 1e-6, smooth, np.median(gain[usable]))
    around = part.array * widened(smooth, step, part.array.shape)
    return np.where(inside, corrected, around).astype(np.float32)


def _working_grid(image: Volume) -> Volume:
    """The image on voxels of 0.8 to 1 mm, by cubic interpolation where its own are not such."""
    import SimpleITK as sitk

    spacing = np.clip(image.spacing_mm.min(), _FINEST_MM, _COARSEST_MM)
    if bool((np.abs(image.spacing_mm / spacing - 1.0) < _NEAR).all()):
        return image
    source = image.to_sitk()
    # Voxels finer than the grid's are averaged.
    wide = np.where(image.spacing_mm < 0.8 * spacing, 0.4 * spacing, 0.0)
    for axis, sigma in enumerate(wide):
        if sigma > 0.0:
            source = sitk.RecursiveGaussian(source, float(sigma), direction=axis)
    size = np.floor((np.array(source.GetSize()) - 1) * image.spacing_mm / spacing).astype(int) + 1
    resampled = sitk.Resample(
        source, size.tolist(), sitk.Transform(), sitk.sitkBSpline, source.GetOrigin(), [float(spacing)] * 3,
        source.GetDirection(), 0.0, sitk.sitkFloat32,
    )  # fmt: skip
    return Volume.from_sitk(resampled, image.name)
