"""Twin experiments: simulated patients with known parameters, to measure the accuracy of an optimisation.

A twin's "real" images are simulated from the true segmentation with parameters, speckle and noise of their own. The fit
starts from the presets and has a slightly wrong segmentation: white matter grown or shrunk by 0.4 voxels, fluid by
less, and everything displaced by 0.5 mm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.opencl.device import DeviceChoice
from SlicerUSSim.Logic.probe.arrays import PhasedProbe, Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import craniotomy_pose, pose_looking_at, sample, surface_point, tilt_sweep
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import Tissue
from SlicerUSSim.Logic.tracked.sequence import SIMULATED, TrackedSequence

#: The tissue with four parameters that differ between twins and are fitted.
TISSUE = "white matter"
#: The paper's 196 lines and 73 mm.
TWIN_PROBE = PhasedProbe(field_of_view_deg=75.0, depth_mm=73.0, scan_lines=196)
_OFFSET_MM = 0.5
#: (tissue, sigma in voxels of its smoothed indicator, offset of the threshold from 1/2): a flat border moves by 0.39
#: voxels for white matter, and for CSF by so little that sulci and the midline of one voxel remain.
_MISTAKES = ((TISSUE, 1.0, 0.15), ("csf", 0.6, 0.08))
_PRESSED_MM = 3.0
_TILT_DEG = 24.0
#: Number of positions tried for a good acoustic window, and the depth of the window.
_PLACES, _WINDOW_MM = 8, 15.0


@dataclass(frozen=True, eq=False)
class Twin:
    """A simulated patient with known parameters."""

    seed: int
    #: Start of the optimisation: the presets on the slightly wrong segmentation
    simulator: UltrasoundSimulator
    display: DisplaySettings
    probe: Probe
    poses: list[np.ndarray]
    #: Reference images, (rows, columns) uint8 each
    references: list[np.ndarray]
    #: True labels, tissues and display of the reference images
    labels: Volume
    true_tissues: TissueTable
    true_display: DisplaySettings

    def sequence(self) -> TrackedSequence:
        """The reference images as a tracked sequence."""
        to_probe = ImageGrid.for_probe(self.probe, self.true_display.image_size).image_to_probe
        transforms = tuple({"ImageToProbe": to_probe, "ProbeToReference": pose} for pose in self.poses)
        times = 0.1 * np.arange(len(self.poses))
        return TrackedSequence(np.stack(self.references), transforms, times, fields={SIMULATED: f"twin {self.seed}"})


def make_twin(
    labels: Volume,
    tissues: TissueTable,
    seed: int,
    *,
    probe: Probe = TWIN_PROBE,
    frames: int = 3,
    crossing: bool = False,
    display: DisplaySettings | None = None,
    display_is_known: bool = False,
    device: DeviceChoice = None,
) -> Twin:
    """Patient number `seed` on true `labels` (1 is CSF), with `frames` images of a tilted probe.

    With `crossing` there are as many images again with the probe turned by 90 degrees about its axis.
    `display` is the start of the optimisation; with `display_is_known` the reference images have it too.
    """
    random = np.random.default_rng(1000 + seed)
    display = display or DisplaySettings()
    true_tissues = tissues.with_tissue(_own_tissue(random, next(t for t in tissues.values() if t.name == TISSUE)))
    own_display = _own_display(random, display)
    true_display = display if display_is_known else own_display
    poses = _own_view(random, labels, probe, frames)
    if crossing:
        turned = poses[frames // 2] @ np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])
        poses += tilt_sweep(turned, _TILT_DEG, frames)
    real = UltrasoundSimulator(labels, true_tissues, SimulationSettings(seed=50_000 + seed), device)
    # All images have the same noise, as in the published tables.
    references = [real.simulate(probe, pose, true_display).image for pose in poses]
    mistaken = mistaken_labels(labels, tissues, random)
    simulator = UltrasoundSimulator(mistaken, tissues, SimulationSettings(seed=seed), device)
    return Twin(seed, simulator, display, probe, poses, references, labels, true_tissues, true_display)


def mistaken_labels(labels: Volume, tissues: TissueTable, random: np.random.Generator) -> Volume:
    """A segmentation with typical errors: white matter and CSF slightly grown or shrunk, all displaced by 0.5 mm."""
    array = labels.array.copy()
    other = tissues.label_of("grey matter")
    for name, sigma, step in _MISTAKES:
        label = tissues.label_of(name)
        share = ndimage.gaussian_filter((labels.array == label).astype(np.float32), sigma)
        threshold = 0.5 + random.choice([-step, step])
        array[(labels.array == other) & (share > threshold)] = label
        array[(labels.array == label) & (share <= threshold)] = other
    direction = random.normal(size=3)
    shift = np.eye(4)
    shift[:3, 3] = _OFFSET_MM * direction / np.linalg.norm(direction)
    return Volume(array, shift @ labels.ijk_to_ras)


def _own_view(random: np.random.Generator, labels: Volume, probe: Probe, frames: int) -> list[np.ndarray]:
    """A tilt sweep about a randomly displaced craniotomy view, in contact with a gyrus.

    Over a sulcus the CSF in front of the face reflects and refracts the beam, and half a voxel changes its direction.
    A surgeon slides the probe to a good acoustic window.
    """
    places: list[tuple[float, list[np.ndarray]]] = []
    for _ in range(_PLACES):
        pose = craniotomy_pose(labels, probe, tilt_deg=random.uniform(24.0, 42.0))
        target = pose @ [random.uniform(-4.0, 4.0), 0.5 * probe.depth_mm, random.uniform(-12.0, 12.0), 1.0]
        outward = -pose[:3, 1]
        face = surface_point(labels, target[:3], outward) - _PRESSED_MM * outward
        poses = tilt_sweep(pose_looking_at(face, target[:3], lateral_ras=pose[:3, 0]), _TILT_DEG, frames)
        blocked = float(np.mean([_fluid_before(labels, pose, probe) for pose in poses]))
        places.append((blocked, poses))
    return min(places, key=lambda place: place[0])[1]


def _fluid_before(labels: Volume, pose: np.ndarray, probe: Probe) -> float:
    """The fraction of coupling medium and CSF in the first part of the field."""
    lines, along = np.meshgrid(np.linspace(probe.first_line, -probe.first_line, 41), np.linspace(0.5, _WINDOW_MM, 24))
    origin, direction = probe.line_at(lines)
    points = origin + along[..., None] * direction
    return float((sample(labels, points @ pose[:3, :3].T + pose[:3, 3], order=0) <= 1).mean())


def _own_tissue(random: np.random.Generator, tissue: Tissue) -> Tissue:
    """A tissue with random parameters within about one standard deviation of the paper's Table 1."""
    level = 10.0 ** (random.uniform(-4.0, 4.0) / 20.0)
    return replace(
        tissue,
        attenuation_db_cm_mhz=random.uniform(0.3, 0.7),
        mu0=tissue.mu0 * level,
        sigma0=tissue.sigma0 * level * random.uniform(0.6, 1.6),
        mu1=random.uniform(-0.2, 0.2),
    )


def _own_display(random: np.random.Generator, display: DisplaySettings) -> DisplaySettings:
    return replace(
        display,
        gain_db=display.gain_db + random.uniform(-6.0, 6.0),
        dynamic_range_db=random.uniform(48.0, 66.0),
        tgc_db_cm_mhz=random.uniform(0.35, 0.65),
        noise_db=random.uniform(-90.0, -65.0),
    )
