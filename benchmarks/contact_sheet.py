"""Random views of a brain side by side in one picture, for the eye.

    python -m benchmarks.contact_sheet PICTURE.png [--views N] [--probe convex] [--brain MRI] [--table TISSUES.json]

The brain is Colin27 where Debian's mricron-data is installed, else the MNI152 template, or an MRI of your own. Two
pictures with different tables or versions show the same views.
"""

from __future__ import annotations

import argparse

import numpy as np
import SimpleITK as sitk

from benchmarks.streaks import PROBES
from SlicerUSSim.Logic import TissueTable, UltrasoundSimulator, Volume, segment_mri
from SlicerUSSim.Logic.mri import demo_mri
from validation.brain_phantoms import COLIN27
from validation.brain_views import random_pose

COLUMNS, GAP = 6, 4


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("picture", help="PNG to write")
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--probe", choices=tuple(PROBES), default="phased")
    parser.add_argument("--brain", help="T1 of a brain (default: Colin27 or MNI152)")
    parser.add_argument("--table", help="tissues, as `ussim segment` writes them")
    parser.add_argument("--device", help="see `ussim devices`")
    arguments = parser.parse_args()
    colin27 = COLIN27 / "ch2bet.nii.gz"
    path = arguments.brain or (colin27 if colin27.exists() else None)
    mri = Volume.read(path) if path else demo_mri()[0]
    found = segment_mri(mri, thin_sulci=True, device=arguments.device)
    table = TissueTable.read(arguments.table) if arguments.table else TissueTable.brain(found.tissue_names)
    simulator = UltrasoundSimulator(found.labels, table, device=arguments.device, texture=found.texture())
    rng = np.random.default_rng(11)
    probe = PROBES[arguments.probe]
    images = [simulator.simulate(probe, random_pose(found.labels, rng)).image for _ in range(arguments.views)]
    rows = -(-len(images) // COLUMNS)
    sheet = sitk.Tile([sitk.GetImageFromArray(np.pad(image, GAP)) for image in images], (COLUMNS, rows), 0)
    sitk.WriteImage(sheet, arguments.picture)
    print(f"{len(images)} views of {path or 'MNI152'} by {arguments.probe}: {arguments.picture}")


if __name__ == "__main__":
    main()
