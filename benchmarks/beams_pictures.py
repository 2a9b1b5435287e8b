"""Beams, walls and sheets against single rays and even layers, side by side: docs/images/beams-before-after.png.

    python -m benchmarks.beams_pictures docs/images/beams-before-after.png [--sheet VIEWS.png] [--device NAME]

Above, lines are single rays (`beam="ray"`, as in the paper) and the membrane is an even layer of a millimetre, as in
tables from before it was a rough sheet; below are the defaults. From the left: a layer oblique to the voxels, a cyst,
and of Colin27 (Debian's mricron-data) and the MNI152 template a coronal view of the ventricles and a random
view each. What is not installed is left out. With --sheet also 24 random views of Colin27, with the defaults.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks.contact_sheet import COLUMNS, GAP
from benchmarks.streaks import PROBES
from SlicerUSSim.Logic import (
    DisplaySettings,
    PhasedProbe,
    SimulationSettings,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    segment_mri,
)
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.probe import Probe, craniotomy_pose
from SlicerUSSim.Logic.tissue import TISSUES
from validation import phantoms
from validation.brain_phantoms import COLIN27
from validation.brain_views import random_pose

_SIZE = 396
#: The random view of each head: one with streaks by single rays
_VIEW = {"Colin27": 3, "MNI152": 1}
_OF_PHANTOMS = PhasedProbe(75, 45, scan_lines=192, focus_mm=25, elevation_focus_mm=25)


def even_layer(tissues: TissueTable) -> TissueTable:
    """The table with the membrane as it was before it was rough."""
    if tissues.membrane is None:
        return tissues
    layer = replace(tissues.membrane, thickness_mm=1.0, roughness_mm=0.0, diffuse_db=0.0, diffuse_exponent=0.0)
    return tissues.with_membrane(layer)


def heads(device) -> Iterator[tuple[str, UltrasoundSimulator]]:
    """The brains on this machine, segmented."""
    colin27 = COLIN27 / "ch2bet.nii.gz"
    mris = {"Colin27": Volume.read(colin27)} if colin27.exists() else {}
    mri, source = demo_mri()
    if source.startswith("MNI152"):
        mris["MNI152"] = mri
    for name, image in mris.items():
        found = segment_mri(image, thin_sulci=True, device=device)
        table = TissueTable.brain(found.tissue_names)
        yield name, UltrasoundSimulator(found.labels, table, device=device, texture=found.texture())


def random_poses(labels: Volume, count: int) -> list[np.ndarray]:
    """Those of contact_sheet.py."""
    rng = np.random.default_rng(11)
    return [random_pose(labels, rng) for _ in range(count)]


def before_and_after(simulator: UltrasoundSimulator, probe: Probe, pose: np.ndarray) -> list[np.ndarray]:
    """Two images, grey levels."""
    tissues, images = simulator.medium.tissues, []
    display = DisplaySettings(image_size=(round(0.82 * _SIZE), _SIZE))
    for beam, table in (("ray", even_layer(tissues)), ("aperture", tissues)):
        simulator.settings = SimulationSettings(beam=beam)
        simulator.set_tissues(table)
        images.append(simulator.simulate(probe, pose, display).image)
    return images


def of_phantoms(device) -> Iterator[tuple[str, list[np.ndarray]]]:
    """A layer of CSF in brain, tilted to the beam by 6 degrees, in voxels of a millimetre; a cyst of CSF."""
    turn = Rotation.from_euler("xyz", [5, 33, 3], degrees=True).as_matrix()
    csf, brain = TISSUES["csf"], TISSUES["white matter"]
    plane = phantoms.layered([brain, csf, brain], [20.0, 30.0], turn, tilt_deg=6.0, spacing_mm=1.0)
    cyst = phantoms.speed_cyst(rotation=turn, radius_mm=5.0)
    membrane = TissueTable.brain(["csf", "white matter"]).membrane
    plane_table = TissueTable({**plane.tissues, 0: brain}, membrane)
    cyst_table = TissueTable({0: brain, 1: brain, 2: csf}, membrane)
    for name, phantom, table in (("plane", plane, plane_table), ("cyst", cyst, cyst_table)):
        simulator = UltrasoundSimulator(phantom.labels, table, device=device)
        yield name, before_and_after(simulator, _OF_PHANTOMS, phantom.probe_to_ras)


def contact_sheet(simulator: UltrasoundSimulator, views: int = 24) -> np.ndarray:
    """Random views with the defaults."""
    poses = random_poses(simulator.medium.labels, views)
    images = [np.pad(simulator.simulate(PROBES["phased"], pose).image, GAP) for pose in poses]
    return np.vstack([np.hstack(images[n : n + COLUMNS]) for n in range(0, views, COLUMNS)])


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("picture", type=Path, help="PNG to write")
    parser.add_argument("--sheet", type=Path, help="PNG to write with 24 views of Colin27")
    parser.add_argument("--device", help="see `ussim devices`")
    arguments = parser.parse_args()
    columns = dict(of_phantoms(arguments.device))
    for name, simulator in heads(arguments.device):
        labels, probe = simulator.medium.labels, PROBES["phased"]
        columns[f"{name}, ventricles"] = before_and_after(simulator, probe, craniotomy_pose(labels, probe))
        view = _VIEW[name]
        columns[f"{name}, view {view}"] = before_and_after(simulator, probe, random_poses(labels, view + 1)[view])
        if arguments.sheet and name == "Colin27":
            Image.fromarray(contact_sheet(simulator)).save(arguments.sheet, optimize=True)
            print(arguments.sheet)
    rows = [np.hstack([np.pad(images[row], GAP) for images in columns.values()]) for row in (0, 1)]
    Image.fromarray(np.vstack(rows)).save(arguments.picture, optimize=True)
    print(f"{arguments.picture}: {', '.join(columns)}; {arguments.picture.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
