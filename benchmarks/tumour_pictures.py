"""ReMIND-022's tumour and oedema, grown from a seed each, in ultrasound through three craniotomies.

    python -m benchmarks.tumour_pictures PICTURE [--mask FILE]

Above by the labels alone, in the middle with both, below the MRI in the plane of the image with the
published segmentation as a line. Needs ../shared; --mask is its brain mask, found if there is none.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.brain_extraction import SHARED
from SlicerUSSim.Logic import (
    DisplaySettings,
    SimulationSettings,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    grow_lesion,
    segment_mri,
)
from SlicerUSSim.Logic.mri.pathology import add_tissues
from SlicerUSSim.Logic.placement.craniotomy import disc_opening, opened, without_outside
from SlicerUSSim.Logic.probe import PROBES, pose_looking_at
from SlicerUSSim.Logic.probe.poses import slice_under_probe, surface_point

#: From the tumour to the opening: left-right, front-back, up
_OPENINGS = {"from above": (0.35, 0.0, 0.95), "from the side": (0.95, 0.0, 0.35), "from the front": (0.45, 0.6, 0.65)}
_DIAMETER_MM = 55.0
#: A point in the oedema
_OEDEMA_RAS = (940.3, 820.7, 471.4)


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("picture", type=Path)
    parser.add_argument("--mask", type=Path)
    arguments = parser.parse_args()
    folder = SHARED / "remind022"
    mri, truth = Volume.read(folder / "t1_contrast.nii.gz"), Volume.read(folder / "glioma.nii.gz")
    mask = None if arguments.mask is None else Volume.read(arguments.mask)
    found = segment_mri(
        mri,
        contrast="t1gd",
        others={"t2": Volume.read(folder / "t2.nii.gz")},
        mask=mask,
        outside=True,
        thin_sulci=False,
    )
    middle = truth.ijk_to_ras[:3] @ np.append(np.argwhere(truth.array > 0).mean(axis=0)[::-1], 1.0)
    seeds = {"oedema": _OEDEMA_RAS, "tumour": middle.tolist()}
    masks = [(tissue, grow_lesion(found, seed, tissue).mask(tissue), "grown") for tissue, seed in seeds.items()]
    with_tumour = add_tissues(found.labels, found.tissue_names, masks, has_brain_mask=True)
    brain, probe = without_outside(found.labels, found.tissue_names), PROBES["microconvex"]
    figure, axes = plt.subplots(3, len(_OPENINGS), figsize=(13.0, 8.6), facecolor="black")
    for column, (name, outward) in zip(axes.T, _OPENINGS.items(), strict=True):
        pose = pose_looking_at(surface_point(brain, middle, outward), middle, lateral_ras=(0.0, 1.0, 0.0))
        for shown, (labels, names) in zip(
            column, ((found.labels, found.tissue_names), (with_tumour.labels, with_tumour.tissue_names)), strict=False
        ):
            opening = disc_opening(labels, names, pose, _DIAMETER_MM)
            patient, millilitres = opened(labels, names, opening)
            simulator = UltrasoundSimulator(patient, TissueTable.brain(names), SimulationSettings())
            frame = simulator.simulate(probe, pose, DisplaySettings(gain_db=6.0))
            shown.imshow(frame.image, cmap="gray", vmin=0, vmax=255)
        print(f"{name}: {millilitres:.0f} ml of skin and skull removed")
        column[0].set_title(name, color="white")
        plane, glioma = (slice_under_probe(volume, frame.grid, pose) for volume in (mri, truth))
        labels = slice_under_probe(with_tumour.labels, frame.grid, pose, order=0)
        near = np.abs(np.arange(len(labels)) - np.argwhere(glioma > 0.5)[:, 0].mean()) < 0.12 * len(labels)
        for tissue in ("tumour", "oedema", "white matter"):
            of_tissue = (labels == with_tumour.tissue_names.index(tissue) + 1) & near[:, None] & (frame.image > 0)
            print(f"  {tissue}: grey level {frame.image[of_tissue].mean():.0f} at the depth of the tumour")
        column[2].imshow(plane, cmap="gray", vmin=0, vmax=np.percentile(mri.array[mri.array > 0], 99.5))
        for shown in column[1:]:
            shown.contour(glioma, [0.5], colors="orange", linewidths=1.0)
    for shown in axes.flat:
        shown.axis("off")
    figure.subplots_adjust(0.0, 0.0, 1.0, 0.96, 0.01, 0.01)
    figure.savefig(arguments.picture, dpi=100)


if __name__ == "__main__":
    main()
