"""Twin experiments: patients whose true parameters are known, to see what an optimisation finds.

A twin's "real" images are simulated with parameters, speckle and noise of their own from the true segmentation; what
is fitted to them starts from the presets and has a slightly wrong segmentation: white matter and fluid grown or shrunk
by about half a voxel, and everything 0.5 mm off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.device import Device
from SlicerUSSim.Logic.placement import craniotomy_pose, elevational_motion, tilt_sweep
from SlicerUSSim.Logic.probe import PhasedProbe, Probe
from SlicerUSSim.Logic.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.tissues import Tissue, TissueTable
from SlicerUSSim.Logic.volume import Volume

#: What is fitted, and what a twin has of its own, four parameters each.
TISSUE = "white matter"
#: The paper's 196 lines and 73 mm.
TWIN_PROBE = PhasedProbe(field_of_view_deg=75.0, depth_mm=73.0, scan_lines=196)
_OFFSET_MM = 0.5


@dataclass(frozen=True, eq=False)
class Twin:
    """One patient with known parameters."""

    seed: int
    #: Where the optimisation starts: the presets on the slightly wrong segmentation
    simulator: UltrasoundSimulator
    display: DisplaySettings
    probe: Probe
    poses: list[np.ndarray]
    #: (rows, columns) uint8 each
    references: list[np.ndarray]
    #: What drew the references
    labels: Volume
    true_tissues: TissueTable
    true_display: DisplaySettings


def make_twin(
    labels: Volume,
    tissues: TissueTable,
    seed: int,
    *,
    probe: Probe = TWIN_PROBE,
    frames: int = 3,
    display: DisplaySettings | None = None,
    display_is_known: bool = False,
    device: str | Device | None = None,
) -> Twin:
    """Patient number `seed` on true `labels`, seen in `frames` images of a tilted probe.

    `display` is where the optimisation starts; with `display_is_known` the references have it too.
    """
    random = np.random.default_rng(1000 + seed)
    display = display or DisplaySettings()
    true_tissues = tissues.with_tissue(_own_tissue(random, next(t for t in tissues.values() if t.name == TISSUE)))
    own_display = _own_display(random, display)
    true_display = display if display_is_known else own_display
    pose = craniotomy_pose(labels, probe, tilt_deg=random.uniform(22.0, 40.0))
    pose = pose @ elevational_motion(random.uniform(-8.0, 8.0), random.uniform(-6.0, 6.0))
    poses = tilt_sweep(pose, 24.0, frames)
    real = UltrasoundSimulator(labels, true_tissues, SimulationSettings(seed=50_000 + seed), device)
    references = [frame.image for frame in real.sweep(probe, poses, true_display)]
    mistaken = mistaken_labels(labels, tissues, random)
    simulator = UltrasoundSimulator(mistaken, tissues, SimulationSettings(seed=seed), device)
    return Twin(seed, simulator, display, probe, poses, references, labels, true_tissues, true_display)


def mistaken_labels(labels: Volume, tissues: TissueTable, random: np.random.Generator) -> Volume:
    """A segmentation as it may come out: borders of white matter and CSF moved by about 0.4 voxels, 0.5 mm off."""
    array = labels.array.copy()
    for name in (TISSUE, "csf"):
        label, other = tissues.label_of(name), tissues.label_of("grey matter")
        share = ndimage.gaussian_filter((labels.array == label).astype(np.float32), 1.0)
        threshold = 0.5 + random.choice([-0.15, 0.15])  # a border moves by 0.39 sigma
        movable = np.isin(labels.array, (label, other))
        array[movable & (share > threshold)] = label
        array[movable & (share <= threshold) & (labels.array == label)] = other
    direction = random.normal(size=3)
    shift = np.eye(4)
    shift[:3, 3] = _OFFSET_MM * direction / np.linalg.norm(direction)
    return Volume(array, shift @ labels.ijk_to_ras)


def _own_tissue(random: np.random.Generator, tissue: Tissue) -> Tissue:
    """Within about one standard deviation of the paper's Table 1."""
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
