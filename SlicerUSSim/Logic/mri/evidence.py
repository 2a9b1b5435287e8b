"""What a segmentation knows about every voxel beyond its label: lesions are found and grown from this."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.mixture import TISSUES

if TYPE_CHECKING:
    from SlicerUSSim.Logic.mri.atlas_registration import AtlasFit

_CSF, _GREY, _WHITE = range(len(TISSUES))
#: Of two tissues, the share at which a voxel counts as the second; of tissue in CSF that is bright, as in T2, where
#: oedema may be half-way to it
_MIDDLE, _MIDDLE_BRIGHT = 0.5, 0.35


@dataclass(frozen=True, eq=False)
class Evidence:
    """The images in the box of the brain, without bias field and noise, and what healthy tissue looks like in them."""

    #: "t1", "t1gd", "t2" or "flair", one for each channel
    contrasts: tuple[str, ...]
    #: (channels, k, j, i) float32
    images: np.ndarray
    #: (k, j, i) bool: the brain
    inside: np.ndarray
    #: (4, 4) voxel (i, j, k, 1) of the box to RAS mm
    ijk_to_ras: np.ndarray
    #: First voxel (k, j, i) of the box, and (k, j, i) size of the MRI
    start: tuple[int, int, int]
    shape: tuple[int, int, int]
    #: (3, channels) mean of CSF, grey and white matter; (channels,) standard deviation of the remaining noise
    means: np.ndarray
    deviations: np.ndarray
    #: The registered atlas; None without one
    atlas: AtlasFit | None

    @property
    def grid(self) -> Volume:
        """The box, with the brain as its array."""
        return Volume(self.inside.astype(np.uint8), self.ijk_to_ras)

    @property
    def spacing_mm(self) -> np.ndarray:
        """(3,) along k, j, i."""
        return np.linalg.norm(self.ijk_to_ras[:3, :3], axis=0)[::-1]

    @property
    def csf(self) -> np.ndarray:
        """(channels,) mean."""
        return self.means[_CSF]

    @property
    def grey(self) -> np.ndarray:
        """(channels,) mean."""
        return self.means[_GREY]

    @property
    def white(self) -> np.ndarray:
        """(channels,) mean."""
        return self.means[_WHITE]

    def channel(self, *contrasts: str) -> int | None:
        """The first channel of one of these contrasts."""
        return next((n for n, contrast in enumerate(self.contrasts) if contrast in contrasts), None)

    def is_fluid(self, images: np.ndarray) -> np.ndarray:
        """(k, j, i) bool of images (channels, k, j, i): at least half as CSF, in every channel.

        In T2 oedema is between grey matter and CSF, and in T1 it is as grey matter.
        """
        result = np.ones(images.shape[1:], bool)
        for image, csf, *tissues in zip(images, self.csf, self.grey, self.white, strict=True):
            nearest = min(tissues, key=lambda mean, csf=csf: abs(mean - csf))
            middle = np.float32(csf + (_MIDDLE_BRIGHT if csf > nearest else _MIDDLE) * (nearest - csf))
            result &= image > middle if csf > nearest else image < middle
        return result

    @cached_property
    def fluid(self) -> np.ndarray:
        """(k, j, i) bool: the brain's voxels of is_fluid."""
        return self.is_fluid(self.images) & self.inside

    def to_whole(self, array: np.ndarray) -> np.ndarray:
        """An array of the box on the grid of the MRI, 0 elsewhere."""
        result = np.zeros(self.shape, array.dtype)
        box = tuple(slice(first, first + size) for first, size in zip(self.start, array.shape, strict=True))
        result[box] = array
        return result

    def index_of(self, ras_mm: np.ndarray) -> np.ndarray:
        """(3,) k, j, i in the box, with fractions."""
        return (np.linalg.inv(self.ijk_to_ras) @ [*np.asarray(ras_mm, float), 1.0])[2::-1]

    # ---- by the atlas ------------------------------------------------------------------------------------------

    @cached_property
    def sideways_mm(self) -> np.ndarray | None:
        """(k, j, i) float32 distance from the midline in the frame of the atlas, positive to the right."""
        if self.atlas is None:
            return None
        row = (self.atlas.patient_to_atlas @ self.ijk_to_ras)[0]
        k, j, i = np.ogrid[tuple(map(slice, self.inside.shape))]
        return (row[0] * i + row[1] * j + row[2] * k + row[3]).astype(np.float32)

    @cached_property
    def expected(self) -> np.ndarray | None:
        """(3, k, j, i) float32 share of CSF, grey and white matter that the atlas expects."""
        if self.atlas is None:
            return None
        result = np.zeros((len(TISSUES), *self.inside.shape), np.float32)
        result[:, self.inside] = self.atlas.prior(self.grid, self.inside)
        return result

    @cached_property
    def between_hemispheres(self) -> np.ndarray:
        """(k, j, i) bool: at the midline, where the atlas expects no white matter: fissure and falx.

        Nowhere without an atlas.
        """
        if self.sideways_mm is None or self.expected is None:
            return np.zeros(self.inside.shape, bool)
        near = np.abs(self.sideways_mm) < max(0.75 * float(self.spacing_mm.max()), 1.0)
        return near & (self.expected[_WHITE] < _MIDDLE)
