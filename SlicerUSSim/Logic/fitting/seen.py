"""What the images show of the patient: which parameters "tissues" stands for in a fit to them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping

import numpy as np

from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.fitting.parameters import ATTENUATION, TISSUES, Bounds, FreeParameters
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.poses import slice_under_probe
from SlicerUSSim.Logic.tissue.sheet_looks import DURA, DURA_KINDS, dura_label
from SlicerUSSim.Logic.tracked.images import TrackedImages

_log = logging.getLogger(__name__)

#: A tissue of less than this part of the imaged fields is too small to show its parameters.
_LEAST_SHARE = 0.002
#: Mean path through a tissue, mm, from which its attenuation shows: at 5 MHz a change by the parameter's tolerance,
#: 0.1 dB/(cm MHz), then changes what lies behind by 0.3 dB.
_LEAST_PATH_MM = 3.0
#: Surfels are 1 mm apart: a sheet that crosses an image has some this near to its plane.
_BESIDE_MM = 1.0


def shares(simulator: UltrasoundSimulator, tracked: TrackedImages) -> dict[str, float]:
    """{tissue: its part of the imaged fields, 0 to 1}, without what lies outside the labels."""
    medium = simulator.medium
    count = np.zeros(256, int)
    for pose in tracked.poses:
        labels = slice_under_probe(medium.labels, tracked.grid, pose, order=0)[tracked.mask]
        count += np.bincount(labels.astype(int), minlength=256)
    found: dict[str, float] = {}
    for label, tissue in medium.tissues.items():
        found[tissue.name] = found.get(tissue.name, 0.0) + float(count[label]) / max(int(count.sum()), 1)
    return found


def _shows_dura(simulator: UltrasoundSimulator, tracked: TrackedImages) -> bool:
    """Whether a sheet of the dura that was found in the MRI crosses the imaged field of one of the images."""
    medium = simulator.medium
    if medium.sheets is None or dura_label(medium.tissues) < 0:
        return False
    place = medium.sheets.of_kind(*DURA_KINDS).place
    for pose in tracked.poses:
        across, down, aside = ((place - pose[:3, 3]) @ pose[:3, :3]).T
        if (tracked.probe.holds(across, down) & (np.abs(aside) < _BESIDE_MM)).any():
            return True
    return False


def parameters_seen(
    free: Iterable[str] | Mapping[str, Bounds | None], simulator: UltrasoundSimulator, tracked: TrackedImages
) -> dict[str, Bounds | None]:
    """The free parameters with "tissues" replaced by those that the images can show.

    These are the echogenicity of every tissue in the imaged fields, of the membrane, and of the dura where sheets of it
    were found there, and the attenuation of tissues through which the beams pass for some millimetres. Other names stay
    as they are.
    """
    entries = dict(free) if isinstance(free, Mapping) else dict.fromkeys([free] if isinstance(free, str) else free)
    if TISSUES not in entries or entries[TISSUES] is not None:
        return entries
    table = simulator.medium.tissues
    thin = {DURA} if _shows_dura(simulator, tracked) else set()
    if table.membrane is not None:
        thin.add(table.membrane.tissue.name)
    part, depth = shares(simulator, tracked), tracked.probe.depth_mm
    chosen: dict[str, Bounds | None] = {}
    left_out = []
    for parameter in FreeParameters.of([TISSUES], table, DisplaySettings()):
        tissue = str(parameter.tissue)
        share = part.get(tissue, 0.0)
        is_path = parameter.attribute == ATTENUATION
        shows = share * depth >= _LEAST_PATH_MM if is_path else share >= _LEAST_SHARE or tissue in thin
        if shows:
            chosen[parameter.name] = None
        else:
            left_out.append(parameter.name)
    if left_out:
        _log.info("the images show too little of these to fit them: %s", ", ".join(left_out))
    result: dict[str, Bounds | None] = {}
    for name, bounds in entries.items():
        result.update(chosen if name == TISSUES else {name: bounds})
    return result
