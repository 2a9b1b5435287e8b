"""Check that images are continuous in the pose: a probe that moves little changes little (docs/physics.md#continuity).

What is compared is one simulation with another; the claim is of proportion alone, and needs no model of the images.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic.imaging.found_sheets import with_their_tissue
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.mri.samples import demo_mri
from SlicerUSSim.Logic.mri.segmentation import segment_mri
from SlicerUSSim.Logic.mri.sheets import find_sheets
from SlicerUSSim.Logic.probe.arrays import PROBES as SHIPPED, Probe
from SlicerUSSim.Logic.probe.poses import craniotomy_pose
from SlicerUSSim.Logic.tissue.table import TissueTable
from validation.checks import PROBES, Check, Outcome, Row
from validation.measurement import EVEN
from validation.phantoms import uniform_speckle
from validation.speckle import SPECKLE

ARRAYS: dict[str, Probe] = {name: replace(probe, scan_lines=96) for name, probe in PROBES.items()}
ARRAYS["steered"] = replace(PROBES["linear"], scan_lines=96, steering_deg=12.0)
ARRAYS["matrix"] = replace(SHIPPED["matrix"], scan_lines=96)
#: mm, of which the first two are compared with the last, and twice that for gradients
STEPS_MM = (1e-4, 1e-3, 1e-2)
#: Along an axis of the probe, or about one
MOTIONS = ("lateral", "axial", "elevational", "about lateral", "about axial", "about elevational")
#: Part of the signal by which it changes where nothing moves: depths are float32, 7 nm or 3e-4 radians at 100 mm
ROUNDING = 1.2e-4
#: mm, from the surface of a brain into it. Where edge lines cross the coupling beside it, nothing is proportional.
_INSIDE_MM = 8.0
#: Envelopes below this part of their surroundings' RMS are near zeros, whose logarithms have no gradient over 10 um
_NEAR_ZERO = 0.3
#: mm below the face, where 10 um are a part of the sector that begins there
_AT_FACE_MM = 2.0


def motion(kind: str, distance_mm: float, depth_mm: float) -> np.ndarray:
    """(4, 4) motion of the probe along an axis, or about one, by which half of the image depth moves the distance."""
    moved, axis = np.eye(4), MOTIONS.index(kind.removeprefix("about "))
    if kind.startswith("about "):
        moved[:3, :3] = Rotation.from_rotvec(np.eye(3)[axis] * distance_mm / (0.5 * depth_mm)).as_matrix()
    else:
        moved[axis, 3] = distance_mm
    return moved


def changes(simulator: UltrasoundSimulator, probe: Probe, pose: np.ndarray, kind: str) -> np.ndarray:
    """(3,) RMS change of the signal over the steps, relative to its RMS."""
    frames = [simulator.simulate(probe, pose @ motion(kind, mm, probe.depth_mm), EVEN) for mm in (0.0, *STEPS_MM)]
    here, *there = (frame.iq[:, int(_AT_FACE_MM / frame.sample_interval_mm) :] for frame in frames)
    return np.sqrt([(np.abs(moved - here) ** 2).mean() / (np.abs(here) ** 2).mean() for moved in there])


def gradients_agree(simulator: UltrasoundSimulator, probe: Probe, pose: np.ndarray, kind: str) -> float:
    """Correlation of the central differences of the envelope's logarithm over the last step and twice that."""
    frame = simulator.simulate(probe, pose, EVEN)
    power = np.abs(frame.iq) ** 2
    surroundings = uniform_filter1d(uniform_filter1d(power, 9, 0), 65, 1)
    counts = power > _NEAR_ZERO**2 * surroundings
    counts[:, : int(_AT_FACE_MM / frame.sample_interval_mm)] = False
    found = []
    for step in (STEPS_MM[-1], 2.0 * STEPS_MM[-1]):
        back, forth = (
            np.abs(simulator.simulate(probe, pose @ motion(kind, side * step, probe.depth_mm), EVEN).iq)
            for side in (-1.0, 1.0)
        )
        found.append(np.log((forth[counts] + 1e-9) / (back[counts] + 1e-9)))
    return float(np.corrcoef(*found)[0, 1])


def rows_of(
    simulator: UltrasoundSimulator, poses: Mapping[str, np.ndarray], motions: Sequence[str] = MOTIONS,
    walls: Mapping[str, float] = MappingProxyType({}),
) -> Iterator[Row]:  # fmt: skip
    """For the array of every pose and every motion: proportion of changes, in octaves, and gradients.

    `walls` is by how much gradients of an array may agree less, by its walls.
    """
    for name, pose in poses.items():
        for kind in motions:
            *small, large = changes(simulator, ARRAYS[name], pose, kind)
            for step, change in zip(STEPS_MM, small, strict=False):
                ratio = np.hypot(change, ROUNDING) / np.hypot(large * step / STEPS_MM[-1], ROUNDING)
                what = f"change {change:.1e} at {1e3 * step:g} um re 10 um, {kind}, {name}"
                yield Row(what, "octaves", 0.0, float(np.log2(ratio)), 1.0)
            agree = gradients_agree(simulator, ARRAYS[name], pose, kind)
            least = walls.get(name, 0.0)
            yield Row(f"gradients at 10 and 20 um, {kind}, {name}", "", 0.95, agree, least, "at least")


def even(rotation: np.ndarray, device) -> Outcome:
    """Homogeneous tissue."""
    phantom = uniform_speckle(SPECKLE, rotation)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, device=device)
    return Outcome(tuple(rows_of(simulator, dict.fromkeys(ARRAYS, phantom.probe_to_ras))))


def brain(rotation: np.ndarray, device) -> Outcome:
    """The MNI152 template with the sheets found in it; the probe is turned about its axis by the rotation's angle."""
    mri = demo_mri()[0]
    found = segment_mri(mri, thin_sulci=True, device=device)
    sheets = find_sheets(mri, found, contrast="t1").surfels
    tissues = with_their_tissue(TissueTable.brain(found.tissue_names), sheets)
    simulator = UltrasoundSimulator(found.labels, tissues, device=device, sheets=sheets)
    turn = motion("about axial", Rotation.from_matrix(rotation).magnitude(), 2.0)
    poses = {
        name: craniotomy_pose(found.labels, probe) @ motion("axial", _INSIDE_MM, probe.depth_mm) @ turn
        for name, probe in ARRAYS.items()
    }
    # The matrix array has the thinnest slice: rays across it begin and cease to meet a border within 10 um. Without
    # walls its gradients agree to 0.94 and more, with them to 0.75 to 0.88.
    return Outcome(tuple(rows_of(simulator, poses, walls={"matrix": 0.2})))


CHECKS = (
    Check("continuity", "Over 0.1, 1 and 10 um the signal changes in proportion to the probe's motion.", even),
    Check("continuity in a brain", "The same in the MNI152 template with sheets.", brain),
)
