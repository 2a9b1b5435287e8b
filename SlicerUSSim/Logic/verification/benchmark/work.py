"""How much work a frame is, stage by stage, from its ray tree and its geometry.

Bytes are counted once for everything a stage has to read or write, whatever a cache saves. Operations are those of the
kernels' source, per look-up, per scatterer and so on, additions, multiplications and integer operations alike: an
estimate to a few tens of percent, enough to tell a stage that is twice off its floor from one that is ten times off.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import trapezoid

from SlicerUSSim.Logic.imaging.bmode import pulse_taps
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.opencl.layout import HIT, SEGMENT
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.verification.benchmark.machine import Work

# Operations counted in the kernels
_PER_STEP = 35  # a look-up on the way: position, beam offset, clamp, index
_PER_BORDER = 5 * 60 + 12 * 15 + 49 * 8 * 10  # bisection; stencil of 12 rows; 7 x 7 rows of eight voxels
_BORDER_BYTES = 12 * 4 * 2 * 2 + 49 * 8  # the stencil's rows of two smoothed indicators; the voxels' groups
_PER_CELL = 180  # a lattice cell that is looked at: three hashes, place, pulse phase, amplitude
_PER_SCATTERER = 40  # one that counts: label, strength, four impulses
_PER_EDGE_PAIR = 16  # of the lateral beam, per sample
_PER_SAMPLE = 130  # noise, TGC, envelope, log compression
_PER_PIXEL = 80
_SAMPLE_BYTES = 8  # complex float32


def frame_work(simulator: UltrasoundSimulator, probe: Probe, pose: np.ndarray, grid: ImageGrid) -> dict[str, Work]:
    """{stage: Work} of one frame, with the names of Frame.timings_ms."""
    acquisition, tree = simulator.acquisition(probe, pose), simulator.trace(probe, pose)
    samples, traced, scanned = (int(acquisition[n]) for n in ("samples", "traced_lines", "scan_lines"))
    rays = 1 + int(acquisition["elevational_rays"])
    steps = float(tree.segments["length_mm"].sum()) * rays / (0.5 * float(acquisition["voxel_mm"]))
    borders = len(tree.hits) * rays / (rays - 1)
    scatterers, cells = scatterer_counts(simulator, probe, acquisition, tree.segments)
    taps = len(pulse_taps(simulator.axial_sigma_mm(probe) / float(acquisition["sample_mm"])))
    depth = np.arange(samples) * float(acquisition["sample_mm"])
    distance = probe.line_distance_mm(depth) / float(acquisition["lateral_rays"])
    pairs = np.minimum(simulator.settings.beam_cutoff * probe.beam_sigma_mm(depth)[0] / distance + 1, traced / 2)
    pixels, averaged = grid.rows * grid.columns, grid.pixel_spacing_mm[1] / float(acquisition["sample_mm"])
    return {
        "ray tree": Work(
            2 * steps + _BORDER_BYTES * borders + SEGMENT.itemsize * len(tree.segments) + HIT.itemsize * len(tree.hits),
            _PER_STEP * steps + _PER_BORDER * borders,
        ),
        "scatterers": Work(
            2 * scatterers + 2 * traced * samples * _SAMPLE_BYTES, _PER_CELL * cells + _PER_SCATTERER * scatterers
        ),
        "interfaces": Work((HIT.itemsize + 8 * _SAMPLE_BYTES) * len(tree.hits), 40 * len(tree.hits)),
        "beam": Work((2 * traced + scanned) * samples * _SAMPLE_BYTES, _PER_EDGE_PAIR * scanned * float(pairs.sum())),
        "pulse": Work(2 * scanned * samples * _SAMPLE_BYTES, 4 * taps * scanned * samples),
        "B-mode": Work((_SAMPLE_BYTES + 5) * scanned * samples, _PER_SAMPLE * scanned * samples),
        "scan conversion": Work(2 * scanned * samples + 9 * pixels, averaged * scanned * samples + _PER_PIXEL * pixels),
    }


def scatterer_counts(simulator: UltrasoundSimulator, probe: Probe, acquisition, segments) -> tuple[float, float]:
    """(scatterers inside the strips of all ray segments, lattice cells that have to be looked at for them)."""
    settings = simulator.settings
    ends = segments["path_mm"], segments["path_mm"] + segments["length_mm"]
    path = np.linspace(*ends, 17)  # (17, segments)
    width = probe.line_distance_mm(path) / float(acquisition["lateral_rays"])
    height = 2.0 * settings.beam_cutoff * probe.beam_sigma_mm(path)[1]
    # A scatterer is up to half a cell from its cell's centre along each axis of the lattice.
    slack = {
        name: float(acquisition["cell_mm"]) * np.abs(segments[name]).sum(axis=1) for name in ("lateral", "elevational")
    }
    deep = float(acquisition["cell_mm"]) * np.abs(segments["direction"]).sum(axis=1)
    chunk = simulator.device.chunk * float(acquisition["sample_mm"]) / segments["depth_per_mm"]
    along = 1.0 + deep / np.minimum(chunk, np.maximum(segments["length_mm"], 1e-3))
    density = settings.scatterers_per_mm3
    inside = trapezoid(width * height, path, axis=0)
    looked_at = along * trapezoid((width + slack["lateral"]) * (height + slack["elevational"]), path, axis=0)
    return float(density * inside.sum()), float(density * looked_at.sum())
