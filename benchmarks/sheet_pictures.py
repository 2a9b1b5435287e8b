"""The pictures of docs/sheets.md: sheets and structures on planes of an MRI, along the axes of the atlas.

    python -m benchmarks.sheet_pictures docs/images [colin27 remind022 mni152] [FILE=CONTRAST ...] [--keep FOLDER]

With --views PICTURE also a view of every head through a craniotomy, by its labels alone and, below, with the sheets.
Colin27 needs Debian's mricron-data, and ReMIND-022 ../shared; missing data are left out.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from PIL import Image

from benchmarks.brain_extraction import SHARED
from SlicerUSSim.Logic import Segmentation, TissueTable, UltrasoundSimulator, Volume, segment_mri
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.mri.pathology import add_tissues
from SlicerUSSim.Logic.mri.sheets import STRUCTURES, Sheets, find_sheets
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.probe import PROBES, craniotomy_pose
from SlicerUSSim.Logic.tissue import KINDS
from validation.brain_phantoms import COLIN27

#: Axis of MNI152 (0 is x) and place in mm of every plane
_PLANES = ((2, 18), (2, 45), (1, -60), (1, 8), (0, 1), (0, 25))
_LOW, _HIGH, _STEP_MM, _THICK_MM = np.array([-80, -115, -65]), np.array([80, 85, 90]), 0.5, 0.6
_SHEETS = dict(zip(KINDS, ("#ff8c1a", "#00e5ff", "#5c7cff", "#9dff57"), strict=True))
_BODIES = dict(zip(STRUCTURES, ("#ffe600", "#ff2020", "#ff40ff"), strict=True))


def draw(path: Path, head: Head, sheets: Sheets) -> None:
    """Every plane without and with what was found."""
    figure, axes = plt.subplots(4, 3, figsize=(12.0, 14.6), facecolor="white")
    places = head.to_atlas(sheets.surfels.place)
    for number, (axis, at) in enumerate(_PLANES):
        row, column = 2 * (number // 3), number % 3
        across = [n for n in range(3) if n != axis]
        ticks = [np.arange(_LOW[n], _HIGH[n], _STEP_MM) for n in across]
        points = np.zeros((len(ticks[1]), len(ticks[0]), 3))
        points[..., across[0]], points[..., across[1]], points[..., axis] = ticks[0], ticks[1][:, None], at
        ras = head.from_atlas(points.reshape(-1, 3))
        image = head.at(ras).reshape(points.shape[:2])
        extent = (ticks[0][0], ticks[0][-1], ticks[1][0], ticks[1][-1])
        for below in (0, 1):
            shown = axes[row + below, column]
            shown.imshow(image, cmap="gray", origin="lower", extent=extent, vmin=head.csf - 10, vmax=head.white * 1.3)
            shown.axis("off")
        shown = axes[row + 1, column]
        structures = sheets.structures
        index = np.rint(ras @ structures.ras_to_ijk[:3, :3].T + structures.ras_to_ijk[:3, 3]).astype(int)[:, ::-1]
        inside = ((index >= 0) & (index < structures.array.shape)).all(axis=1)
        labels = np.zeros(len(ras), np.uint8)
        labels[inside] = structures.array[tuple(index[inside].T)]
        for label, colour in enumerate(_BODIES.values(), 1):
            is_label = (labels == label).reshape(points.shape[:2])
            if is_label.any():
                shown.contour(is_label, [0.5], colors=colour, linewidths=0.8, extent=extent, origin="lower")
        near = np.abs(places[:, axis] - at) < _THICK_MM
        for kind, colour in _SHEETS.items():
            which = near & (sheets.surfels.kind == KINDS.index(kind))
            shown.scatter(
                places[which][:, across[0]], places[which][:, across[1]], c=colour, linewidths=0,
                s=2.5 * sheets.surfels.confidence[which],
            )  # fmt: skip
        shown.set_xlim(extent[:2])
        shown.set_ylim(extent[2:])
    handles = [Line2D([], [], color=c, marker=".", linestyle="", label=n) for n, c in _SHEETS.items()]
    handles += [
        Line2D([], [], color=colour, label=name)
        for label, (name, colour) in enumerate(_BODIES.items(), 1)
        if (sheets.structures.array == label).any()
    ]
    figure.legend(handles=handles, loc="lower center", ncol=len(handles), frameon=False, fontsize=9)
    figure.tight_layout(rect=(0, 0.02, 1, 1), pad=0.3)
    figure.savefig(path, dpi=75, pil_kwargs={"quality": 85} if path.suffix == ".jpg" else {"optimize": True})
    plt.close(figure)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def view(found: Segmentation, sheets: Sheets) -> np.ndarray:
    """(rows, columns) uint8: one image by the labels alone, below it one with sheets and structures."""
    probe = PROBES["neonatal"]
    pose = craniotomy_pose(found.brain.mask, probe)
    added = add_tissues(found.labels, found.tissue_names, sheets.masks(), has_brain_mask=True)
    images = []
    for labels, names, surfels in (
        (found.labels, found.tissue_names, None), (added.labels, added.tissue_names, sheets.surfels)
    ):  # fmt: skip
        simulator = UltrasoundSimulator(labels, TissueTable.brain(names), sheets=surfels)
        images.append(np.pad(simulator.simulate(probe, pose).image, 4))
    return np.vstack(images)


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("what", nargs="*", default=["colin27", "remind022", "mni152"])
    parser.add_argument("--keep", type=Path, help="folder for brain masks")
    parser.add_argument("--views", type=Path, help="picture of ultrasound images of the heads")
    arguments = parser.parse_args()
    heads: dict[str, tuple[Path | None, str]] = {
        "colin27": (COLIN27 / "ch2.nii.gz", "t1"),
        "remind022": (SHARED / "remind022/t1_contrast.nii.gz", "t1gd"),
        "mni152": (None, "t1"),
    }
    columns: list[np.ndarray] = []
    for name in arguments.what:
        if "=" in name:
            path, contrast = name.split("=")
            file, name = Path(path), Path(path).name.split(".")[0].lower()
        else:
            file, contrast = heads[name]
        if file is not None and not file.exists():
            continue
        mri = demo_mri()[0] if file is None else Volume.read(file)
        options: dict[str, Any] = {}
        if arguments.keep:
            options["keep_mask_at"] = arguments.keep / f"{name}-mask.nrrd"
        found = segment_mri(mri, contrast=contrast, **options, thin_sulci=False)
        sheets = find_sheets(mri, found, contrast=contrast)
        for line in sheets.notes:
            print(f"{name}: {line}")
        draw(arguments.folder / f"sheets-{name}.jpg", Head.of(mri, found, contrast), sheets)
        if arguments.views:
            columns.append(view(found, sheets))
    if arguments.views:
        Image.fromarray(np.hstack(columns)).save(arguments.views, "PNG")


if __name__ == "__main__":
    main()
