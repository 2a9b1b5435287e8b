"""Sweep a phased array over the cortex of the demo brain and write every image: python examples/sweep_to_png.py OUT"""

import sys
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic import PhasedProbe, TissueTable, UltrasoundSimulator, segment_mri
from SlicerUSSim.Logic.imaging.figures import write_png
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.probe import craniotomy_pose

out = Path(sys.argv[1] if len(sys.argv) > 1 else "sweep")
out.mkdir(exist_ok=True)
segmentation = segment_mri(demo_mri()[0], thin_sulci=True)
tissues = TissueTable.brain(segmentation.tissue_names)
simulator = UltrasoundSimulator(segmentation.labels, tissues, texture=segmentation.texture())
probe = PhasedProbe(field_of_view_deg=80, depth_mm=90)
middle = craniotomy_pose(segmentation.labels, probe)
poses = []
for tilt_deg in np.linspace(-15, 15, 16):  # rock the probe about its lateral axis
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    poses.append(middle @ np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]]))
for number, frame in enumerate(simulator.sweep(probe, poses)):
    write_png(out / f"{number:02d}.png", frame.image)
print(f"wrote {len(poses)} images to {out}", file=sys.stderr)
