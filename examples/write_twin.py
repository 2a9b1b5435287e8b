"""Write a simulated patient with known parameters: labels and tracked ultrasound, as `ussim optimize` reads them.

    python examples/write_twin.py [FOLDER] [--seed N]
    ussim optimize FOLDER/labels.nii.gz --sequence FOLDER/tracked.igs.mha --probe FOLDER/probe.json \
        -o FOLDER/result.json --report FOLDER/report.html

The "real" images in tracked.igs.mha are simulated with the parameters in truth.json, other speckle and noise;
labels.nii.gz is the same brain with a slightly wrong segmentation (benchmarks/twins.py, in a checkout that was
installed with pip install -e).
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

from benchmarks.twins import make_twin
from SlicerUSSim.Logic import TissueTable, segment_mri
from SlicerUSSim.Logic.base import write_json
from SlicerUSSim.Logic.mri import demo_mri


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path("ussim-twin"))
    parser.add_argument("--seed", type=int, default=0, help="which patient")
    arguments = parser.parse_args()
    folder = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)

    segmentation = segment_mri(demo_mri()[0])
    twin = make_twin(segmentation.labels, TissueTable.brain(segmentation.tissue_names), arguments.seed)
    twin.simulator.medium.labels.write(folder / "labels.nii.gz")
    twin.simulator.medium.tissues.write(folder / "labels.json")
    twin.sequence().write(folder / "tracked.igs.mha")
    write_json(folder / "probe.json", twin.probe.to_dict())
    write_json(folder / "truth.json", {"display": asdict(twin.true_display), **twin.true_tissues.to_dict()})
    print(f"wrote labels.nii.gz, labels.json, tracked.igs.mha, probe.json, truth.json in {folder}", file=sys.stderr)


if __name__ == "__main__":
    main()
