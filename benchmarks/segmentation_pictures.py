"""The pictures of docs/segmentation.md: MRI and tissues of every example, and a plane of the real sweep.

    python -m benchmarks.segmentation_pictures docs/images [mni152 colin27 remind022 plane]

Colin27 needs Debian's mricron-data, and ReMIND-022 and the sweep need ../shared; missing data are left out. Brain
extraction takes up to 90 s per head; its masks are kept in --keep.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch
from scipy import ndimage

from benchmarks.brain_extraction import SHARED
from SlicerUSSim.Logic import Segmentation, TrackedSequence, Volume, segment_mri
from SlicerUSSim.Logic.mri import demo_mri
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


def plane(path: Path) -> None:
    """Image 4 of the real sweep, the plane of the patient's MRI in which it lies, and that plane's tissues."""
    folder = SHARED / "brain_sweep"
    mri, mask = (Volume.read(folder / f"{name}_plane_04.nii.gz") for name in ("mri", "mask"))
    found = segment_mri(mri, contrast="t1gd", mask=mask, thin_sulci=True)
    sweep = TrackedSequence.read(folder / "brain_sweep.igs.mha")
    image = sweep.images[4]
    row, column = np.indices(image.shape)
    ras = np.stack([column, row, np.zeros_like(row), np.ones_like(row)], -1) @ sweep.pose(4, "ImageToReference").T
    k, j, i = np.moveaxis(ras @ mri.ras_to_ijk.T, -1, 0)[2::-1]
    seen = image > 0
    window = tuple(slice(int(where.min()), int(where.max()) + 1) for where in np.nonzero(seen))
    shown = ndimage.map_coordinates(mri.array.astype(np.float32), [k, j, i], order=1)[window]
    tissues = ndimage.map_coordinates(coloured(found.labels.array, found.tissue_names), [k, j, i], order=0)[window]
    figure, axes = plt.subplots(1, 3, figsize=(11.0, 3.5), facecolor="white")
    axes[0].imshow(shown, cmap="gray", vmin=0, vmax=np.percentile(shown, 99))
    axes[1].imshow(tissues, cmap=palette(), vmin=0, vmax=len(_NAMES), interpolation="nearest")
    axes[2].imshow(image[window], cmap="gray")
    for axis, title in zip(axes, ("MRI, T1 with contrast", "tissues", "ultrasound"), strict=True):
        axis.set_title(title, fontsize=9)
    finish(figure, axes, set(np.unique(tissues).tolist()), path)


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("what", nargs="*", default=["mni152", "colin27", "remind022", "plane"])
    parser.add_argument("--keep", type=Path, help="folder for brain masks")
    arguments = parser.parse_args()

    def segmented(name: str, mri: Volume, **options: Any) -> Segmentation:
        keep_at = arguments.keep / f"{name}-mask.nii.gz" if arguments.keep else None
        found = segment_mri(mri, thin_sulci=True, keep_mask_at=keep_at, **options)
        counts = np.bincount(found.labels.array.ravel(), minlength=len(found.tissue_names) + 1)[1:]
        shares = ", ".join(f"{t} {n / counts.sum():.0%}" for t, n in zip(found.tissue_names, counts, strict=True))
        print(f"{name}: {found.brain.message}; {shares}")
        return found

    if "mni152" in arguments.what:
        mri = demo_mri()[0]
        draw(arguments.folder / "tissues-mni152.png", [("MNI152", mri, segmented("mni152", mri))])
    if "colin27" in arguments.what and (COLIN27 / "ch2.nii.gz").exists():
        mri = Volume.read(COLIN27 / "ch2.nii.gz")
        draw(arguments.folder / "tissues-colin27.png", [("Colin27, whole head", mri, segmented("colin27", mri))])
    if "remind022" in arguments.what and (SHARED / "remind022").is_dir():
        t1, t2 = (Volume.read(SHARED / f"remind022/{name}.nii.gz") for name in ("t1_contrast", "t2"))
        both: Mapping[str, Any] = {"contrast": "t1gd", "others": {"t2": t2}}
        draw(
            arguments.folder / "tissues-remind022.png",
            [
                ("T1 with contrast", t1, segmented("remind022-t1", t1, contrast="t1gd")),
                ("T2", t2, segmented("remind022-t2", t2, contrast="t2")),
                ("both (T1 shown)", t1, segmented("remind022-t1", t1, **both)),
            ],
        )
    if "plane" in arguments.what and (SHARED / "brain_sweep").is_dir():
        plane(arguments.folder / "tissues-sweep-plane.png")


if __name__ == "__main__":
    main()
