"""Levels of speckle along lines, of images and of wave propagation, relative to a medium of one speed of sound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import PhasedProbe, Probe
from SlicerUSSim.Logic.tissue.table import TissueTable
from validation.measurement import EVEN
from validation.wave import Map

_Result = TypeVar("_Result")


def levels_db(
    labels: Volume, tissues: TissueTable, baseline: TissueTable, probe: Probe, pose: np.ndarray, device,
    *, beam: str, edges_mm: np.ndarray, lines: slice, seeds: int, reflections: bool = True,
) -> np.ndarray:  # fmt: skip
    """(lines,) power of speckle between the edges of blocks of depth, relative to the tissues of `baseline`.

    Parameters as in levels_and_widths.
    """
    return levels_and_widths(
        labels,
        tissues,
        baseline,
        probe,
        pose,
        device,
        beam=beam,
        edges_mm=edges_mm,
        lines=lines,
        seeds=seeds,
        reflections=reflections,
    )[0]


def levels_and_widths(
    labels: Volume, tissues: TissueTable, baseline: TissueTable, probe: Probe, pose: np.ndarray, device,
    *, beam: str, edges_mm: np.ndarray, lines: slice, seeds: int, reflections: bool = True,
    wavefront_curvature: bool = True,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Speckle between the edges of blocks of depth relative to the tissues of `baseline`: levels and widths.

    (lines,) power in dB, the mean over blocks of their changes, whatever the gain of depths is; and (lines, blocks) the
    width of the beam, from the correlation between a line and the next one, exp(-d^2 / 4 sigma^2) for Gaussian beams a
    distance d apart. With `wavefront_curvature` that is the length of its speckle. Over `seeds` speckle averages.
    """
    settings = SimulationSettings(
        beam=beam, interfaces=False, reflections=reflections, wavefront_curvature=wavefront_curvature
    )
    simulator = UltrasoundSimulator(labels, tissues, settings, device)
    following = slice(lines.start + 1, lines.stop + 1, lines.step)
    powers, decays = [], []
    for table in (tissues, baseline):
        simulator.set_tissues(table)
        own = other = common = 0.0
        for seed in range(seeds):
            simulator.settings = replace(settings, seed=seed)
            frame = simulator.simulate(probe, pose, EVEN)
            starts = (edges_mm / frame.sample_interval_mm).astype(int)
            first, second = (frame.iq[part, : starts[-1]].astype(np.complex128) for part in (lines, following))
            own, other, common = (
                total + np.add.reduceat(product, starts[:-1], axis=1)
                for total, product in (
                    (own, abs(first) ** 2),
                    (other, abs(second) ** 2),
                    (common, first * second.conj()),
                )
            )
        powers.append(own)
        decays.append(-np.log(abs(common) / np.sqrt(own * other)))
    return 10.0 * np.log10(np.mean(powers[0] / powers[1], axis=1)), np.sqrt(decays[1] / decays[0])


def along_line(probe: Probe, position: float, to_ijk: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Function of x and depth (mm, both (points,)) in the frame of a line: (4, points) voxel indices i, j, k and 1.

    `to_ijk` (4, 4) is from the probe's frame.
    """
    origin, direction = (v[:2] for v in probe.line_at(position))
    across = np.array([direction[1], -direction[0]])

    def ijk(x: np.ndarray, depth: np.ndarray) -> np.ndarray:
        points = origin[:, None] + np.outer(across, x) + np.outer(direction, depth)
        return to_ijk @ np.stack([*points, 0.0 * x, 0.0 * x + 1.0])

    return ijk


def beam_of_line(
    propagated: Callable[..., _Result], probe: Probe, position: float, depths_mm: np.ndarray, reference_m_s: float
) -> Callable[[Map | None], _Result]:
    """A function of wave.py with the beam of a line; its argument is the speed of sound, or None."""
    fields = {
        "frequency_mhz": probe.frequency_mhz, "aperture_mm": probe.aperture_mm, "f_number": probe.receive_f_number,
        "focus_mm": probe.focus_mm, "reference_m_s": reference_m_s,
        "steering_rad": float(position) if isinstance(probe, PhasedProbe) else 0.0,
    }  # fmt: skip

    def beam(speed: Map | None) -> _Result:
        if speed is None:
            return undisturbed(propagated, tuple(depths_mm), **fields)
        return propagated(speed, depths_mm=depths_mm, **fields)

    return beam


@lru_cache(maxsize=512)
def undisturbed(propagated: Callable[..., Any], depths_mm: tuple[float, ...], **beam: float) -> Any:
    """`propagated`, a function of wave.py, without a medium: the same for many lines and views."""
    found = propagated(None, depths_mm=np.array(depths_mm), **beam)
    for array in found if isinstance(found, tuple) else (found,):
        array.flags.writeable = False
    return found
