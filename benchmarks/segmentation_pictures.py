"""The picture of docs/segmentation.md: Colin27 (Debian's mricron-data), the border of its brain, and its tissues.

python -m benchmarks.segmentation_pictures docs/images
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch
from scipy import ndimage

from SlicerUSSim.Logic import Segmentation, Volume, segment_mri
from validation.brain_phantoms import COLIN27

#: Every tissue's colour
COLOURS = {
    "": "#101010",
    "csf": "#3f7fbf",
    "grey matter": "#8c8c8c",
    "white matter": "#f3ead6",
    "enhancing": "#d33f36",
    "tumour": "#d33f36",
    "leptomeninges": "#29a39a",
}
_NAMES = list(COLOURS)


def coloured(labels: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Labels as indices of COLOURS."""
    return np.array([0, *(_NAMES.index(name) for name in names)], np.uint8)[labels]


def anatomical(volume: Volume, array: np.ndarray) -> np.ndarray:
    """(S, A, R) axes of an image, each rising; for pictures, without resampling."""
    matrix = volume.ijk_to_ras[:3, :3]
    axis_of = [int(np.abs(matrix[row]).argmax()) for row in range(3)]  # voxel axis (i, j, k) nearest R, A, S
    turned = np.transpose(array, [2 - axis_of[row] for row in (2, 1, 0)])
    falling = [2 - row for row in range(3) if matrix[row, axis_of[row]] < 0]
    return np.flip(turned, tuple(falling))


def draw(path: Path, rows: list[tuple[str, Volume, Segmentation]]) -> None:
    """An axial and a coronal slice of every MRI, with the contour of the brain, and of its tissues."""
    figure, axes = plt.subplots(len(rows), 4, figsize=(11.0, 3.1 * len(rows)), squeeze=False, facecolor="white")
    used: set[int] = set()
    for row, (title, mri, found) in zip(axes, rows, strict=True):
        image = anatomical(mri, mri.array)
        mask = anatomical(mri, found.brain.mask.array > 0)
        tissues = anatomical(mri, coloured(found.labels.array, found.tissue_names))
        used |= set(np.unique(tissues).tolist())
        middle = np.round(ndimage.center_of_mass(mask)).astype(int)
        white = np.percentile(image[mask], 99.5)
        spacing = anatomical_spacing(mri)
        for column, (axis, offset) in enumerate(((0, 6), (1, -6))):
            plane = int(middle[axis] + offset / spacing[axis])
            across = [n for n in range(3) if n != axis]
            shape = {"aspect": spacing[across[0]] / spacing[across[1]], "origin": "lower"}
            picture, inside, labels = (np.take(each, plane, axis)[:, ::-1] for each in (image, mask, tissues))
            row[2 * column].imshow(picture, cmap="gray", vmin=0, vmax=white, **shape)
            row[2 * column].contour(inside, [0.5], colors="#ffb000", linewidths=0.7)
            row[2 * column + 1].imshow(
                labels, cmap=palette(), vmin=0, vmax=len(_NAMES), interpolation="nearest", **shape
            )
        row[0].set_title(title, fontsize=9, loc="left")
    finish(figure, axes, used, path)


def anatomical_spacing(volume: Volume) -> list[float]:
    """Voxel size along S, A, R, mm."""
    matrix = volume.ijk_to_ras[:3, :3]
    return [float(volume.spacing_mm[int(np.abs(matrix[row]).argmax())]) for row in (2, 1, 0)]


def palette() -> ListedColormap:
    """The colours of coloured()."""
    return ListedColormap([*COLOURS.values(), "#000000"])


def finish(figure, axes, used: set[int], path: Path) -> None:
    """Legend and file."""
    for axis in np.ravel(axes):
        axis.axis("off")
    handles = [Patch(color=COLOURS[_NAMES[n]], label=_NAMES[n]) for n in sorted(used) if n]
    figure.legend(handles=handles, loc="lower center", ncol=len(handles), frameon=False, fontsize=9)
    figure.tight_layout(rect=(0, 0.04 if len(axes) > 1 else 0.08, 1, 1))
    figure.savefig(path, dpi=80, pil_kwargs={"optimize": True})
    plt.close(figure)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    mri = Volume.read(COLIN27 / "ch2.nii.gz")
    found = segment_mri(mri, thin_sulci=True)
    print(found.brain.message)
    draw(folder / "tissues-colin27.png", [("Colin27, whole head", mri, found)])


if __name__ == "__main__":
    main()
