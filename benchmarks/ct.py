"""Agreement of segment_ct with phantoms whose tissues are known, and the picture of docs/ct.md.

    python -m benchmarks.ct [--picture docs/images/ct-phantoms.png] [--only-picture]

The table has the Dice coefficient of every tissue in voxels of 1 mm and of 0.7 x 0.7 x 2.5 mm, with 20 and 40 HU of
noise; what the numbers alone cannot tell apart is one tissue (liver is muscle, an enhancing kidney is blood). The
picture is made with rays (beam="ray").
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import process_time

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap

from SlicerUSSim.Logic import (
    ConvexProbe,
    DisplaySettings,
    LinearProbe,
    SimulationSettings,
    TissueTable,
    UltrasoundSimulator,
    segment_ct,
)
from SlicerUSSim.Logic.probe import pose_looking_at
from SlicerUSSim.Logic.probe.poses import slice_under_probe
from SlicerUSSim.Logic.tissue import LabelMapping, read_label_map
from SlicerUSSim.Logic.tissue.presets import colour_of
from validation.ct_phantoms import BY_NUMBER, NAMES, CtPhantom, lower_chest, lumbar_spine

_CONVEX = ConvexProbe(radius_mm=50, field_of_view_deg=60, depth_mm=100, frequency_mhz=4.0, focus_mm=50)
_LINEAR = LinearProbe(width_mm=50, depth_mm=55, frequency_mhz=7.0, focus_mm=30)
#: Title, phantom, probe, place of the face, what it looks at, and its lateral axis, RAS mm
_VIEWS = (
    ("L3, spinous process and laminae", "spine", _CONVEX, (0, -69, -3), (0, 0, -3), (1, 0, 0)),
    ("L3/L4, both facet joints", "spine", _CONVEX, (0, -69, -17), (0, 0, -17), (1, 0, 0)),
    ("Facet joint, linear", "spine", _LINEAR, (26, -67, -17), (17, -30, -17), (1, 0, 0)),
    ("Articular processes, sagittal", "spine", _CONVEX, (15, -69, 0), (15, 0, 0), (0, 0, -1)),
    ("Ribs and lung, linear", "chest", _LINEAR, (121, 0, 46), (0, 0, 46), (0, 0, -1)),
    ("Liver and kidney", "chest", _CONVEX, (108, -42, 8), (50, -30, -12), (0, 0, -1)),
)


def dices(phantom: CtPhantom) -> dict[str, float]:
    """{tissue: Dice}, and the seconds of the processor."""
    start = process_time()
    found = segment_ct(phantom.ct)
    result = {}
    for name, number in zip(found.tissue_names, range(1, 99)):  # noqa: B905
        alike = [label for label, own in enumerate(NAMES, 1) if BY_NUMBER.get(own, own) == name]
        truth, labelled = np.isin(phantom.truth.array, alike), found.labels.array == number
        if truth.any():
            result[name] = 2.0 * float((truth & labelled).sum()) / float(truth.sum() + labelled.sum())
    return {**result, "seconds": process_time() - start}


def table() -> None:
    for spacing in ((1.0, 1.0, 1.0), (0.7, 0.7, 2.5)):
        for noise in (20.0, 40.0):
            for make in (lumbar_spine, lower_chest):
                values = dices(make(spacing, noise))
                text = "  ".join(f"{name} {value:.3f}" for name, value in values.items())
                print(f"{make.__name__:13} {'x'.join(f'{mm:g}' for mm in spacing)} mm, {noise:.0f} HU: {text}")


def picture(path: Path) -> None:
    figure, axes = plt.subplots(len(_VIEWS), 3, figsize=(11, 3.6 * len(_VIEWS)), facecolor="white")
    phantoms = {"spine": lumbar_spine(), "chest": lower_chest()}
    organs = read_label_map(phantoms["chest"].organs, mapping=LabelMapping.of(["totalsegmentator"]))
    found = {"spine": segment_ct(phantoms["spine"].ct), "chest": segment_ct(phantoms["chest"].ct, organs=organs)}
    for row, (title, name, probe, face, target, lateral) in zip(axes, _VIEWS, strict=True):
        labels, names = found[name].labels, found[name].tissue_names
        simulator = UltrasoundSimulator(
            labels, TissueTable.named(names), SimulationSettings(beam="ray"), texture=found[name].texture()
        )
        pose = pose_looking_at(face, target, lateral)
        frame = simulator.simulate(probe, pose, DisplaySettings(dynamic_range_db=65.0))
        ct = slice_under_probe(phantoms[name].ct, frame.grid, pose)
        tissues = slice_under_probe(labels, frame.grid, pose, order=0)
        colours = ListedColormap([(0, 0, 0), *(colour_of(tissue) for tissue in names)])
        row[0].imshow(ct, cmap="gray", vmin=-250, vmax=450)
        row[1].imshow(tissues, cmap=colours, vmin=-0.5, vmax=len(names) + 0.5, interpolation="nearest")
        row[2].imshow(frame.image, cmap="gray", vmin=0, vmax=255)
        row[0].set_title(title, loc="left", fontsize=10)
        for axis in row:
            axis.set_axis_off()
    figure.tight_layout(pad=0.3)
    figure.savefig(path, dpi=70)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Agreement of segment_ct with phantoms")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--only-picture", action="store_true")
    options = parser.parse_args()
    if options.picture is not None:
        picture(options.picture)
    if not options.only_picture:
        table()
