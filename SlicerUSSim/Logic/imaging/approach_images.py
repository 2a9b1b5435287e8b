"""Images of the candidates of an approach, and the contrast of the target in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.placement.approach import Approach, Target, opened_for
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.poses import sample
from SlicerUSSim.Logic.tissue.names import OUTSIDE, labels_of

#: (rows, columns) of the images
_PIXELS = (256, 256)
#: The brain around a target is that so far from it, mm
_AROUND_MM = (2.0, 10.0)
#: Fewer samples are no mean
_FEWEST = 30


def simulated_approach(
    approach: Approach, simulator: UltrasoundSimulator, probe: Probe, display: DisplaySettings | None = None
) -> Approach:
    """The candidates with their images and the contrasts of the target, from one batch of drafts.

    `simulator` is that of the closed head, or of the brain alone; it stays as it is. All openings are made in one label
    map, which the batch shares. A contrast is None where target or brain around it are not in the field.
    """
    labels, tissues = simulator.medium.labels, simulator.medium.tissues
    names = tissues.names_by_label()
    settings = replace(simulator.settings, quality="draft", contact_gap_mm=None)  # saline fills the openings
    drafts = UltrasoundSimulator(
        opened_for(labels, names, approach.candidates), tissues, settings, simulator.device, simulator.texture,
        simulator.medium.sheets,
    )  # fmt: skip
    shown = replace(display or DisplaySettings(), image_size=_PIXELS, persistence=0.0)
    poses = [candidate.probe_to_ras for candidate in approach.candidates]
    batch = drafts.simulate_batch(probe, poses, display=shown, outputs=("image", "envelope"))
    brain = labels.with_array(np.isin(labels.array, labels_of(names, OUTSIDE), invert=True) & (labels.array > 0))
    seen = [
        replace(candidate, image=image, contrast_db=_contrast_db(envelope, probe, candidate.probe_to_ras, approach.target,
                                                                 brain))
        for candidate, image, envelope in zip(approach.candidates, batch["image"], batch["envelope"], strict=True)
    ]  # fmt: skip
    return replace(approach, candidates=tuple(seen))


def _contrast_db(
    envelope: np.ndarray, probe: Probe, probe_to_ras: np.ndarray, target: Target, brain: Volume
) -> float | None:
    """Mean power of an envelope (scan_lines, samples) in the target above that in the brain around it, dB."""
    lines, samples = envelope.shape
    origin, direction = probe.line_at(replace(probe, scan_lines=lines).line_positions())
    along = (np.arange(samples) + 0.5) * probe.displayed_mm / samples
    points = origin[:, None] + along[:, None] * direction[:, None]
    ras = points @ probe_to_ras[:3, :3].T + probe_to_ras[:3, 3]
    near = np.linalg.norm(ras - target.centre_ras, axis=-1) <= target.size_mm + _AROUND_MM[1]
    power, places = envelope[near].astype(float) ** 2, ras[near]
    if not len(places):
        return None
    away = KDTree(target.points_ras).query(places)[0]
    inside = away <= target.gap_mm
    low, high = _AROUND_MM
    around = (away > target.gap_mm + low) & (away <= target.gap_mm + high) & (sample(brain, places, order=0) > 0)
    if inside.sum() < _FEWEST or around.sum() < _FEWEST or not power[around].any():
        return None
    return float(10.0 * np.log10(power[inside].mean() / power[around].mean()))
