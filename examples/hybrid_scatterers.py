"""Hybrid scatterers compared: labels alone (the paper), partial volume, MRI intensity, both.

    python examples/hybrid_scatterers.py [-o hybrid.png]

Top: one image each of the MNI152 brain. Bottom: the mean of 24 patients that differ only in their scatterers,
which shows the expected echo level.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from SlicerUSSim.Logic import SimulationSettings, TissueTable, UltrasoundSimulator, segment_mri
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.probe import PROBES, ImageGrid, craniotomy_pose, slice_under_probe

VARIANTS = {
    "labels alone (paper)": {"partial_volume": False},
    "partial volume": {"partial_volume": True},
    "MRI, 3 dB per deviation": {"partial_volume": False, "mri_modulation_db": 3.0},
    "both": {"partial_volume": True, "mri_modulation_db": 3.0},
}
REGION_MM = (-40.0, 40.0, 15.0, 95.0)  # left, right, top, bottom: sulci, ventricles, nuclei


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("-o", "--out", default="hybrid.png")
    parser.add_argument("--patients", type=int, default=24)
    arguments = parser.parse_args()

    mri, _ = demo_mri()
    segmentation = segment_mri(mri, thin_sulci=True)
    tissues, texture = TissueTable.brain(segmentation.tissue_names), segmentation.texture()
    probe = PROBES["convex"]
    pose = craniotomy_pose(segmentation.labels, probe)

    figure = Figure(figsize=(3.0 * (len(VARIANTS) + 1), 6.4), layout="constrained")
    axes = figure.subplots(2, len(VARIANTS) + 1)
    for column, (name, changes) in enumerate(VARIANTS.items(), 1):
        simulator = UltrasoundSimulator(segmentation.labels, tissues, SimulationSettings(**changes), texture=texture)
        images = []
        for seed in range(arguments.patients):
            simulator.settings = replace(simulator.settings, seed=seed)
            images.append(simulator.simulate(probe, pose).image)
        show(axes[0, column], images[0], probe, name)
        show(axes[1, column], np.mean(images, axis=0), probe, "expected level", 30, 150)
    under = slice_under_probe(mri, ImageGrid.for_probe(probe, None), pose)
    show(axes[0, 0], 255.0 * under / under.max(), probe, "MRI")
    axes[1, 0].axis("off")
    figure.savefig(arguments.out, dpi=90)


def show(axis, image: np.ndarray, probe, title: str, black: float = 0, white: float = 255) -> None:
    left, right, top, bottom = probe.image_bounds_mm()
    axis.imshow(image, cmap="gray", vmin=black, vmax=white, extent=(left, right, bottom, top))
    axis.set_xlim(REGION_MM[0], REGION_MM[1])
    axis.set_ylim(REGION_MM[3], REGION_MM[2])
    axis.set_title(title, fontsize=10)
    axis.tick_params(labelsize=7)


if __name__ == "__main__":
    main()
