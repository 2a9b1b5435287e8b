"""Checks of walls, plane interfaces that are not square to the beam (docs/physics.md#3-rays)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import PROBES, LinearProbe, Probe
from SlicerUSSim.Logic.tissue.table import TissueTable
from validation.apertures import mirror_echo_db
from validation.beams import BEHIND
from validation.checks import Check, Outcome, Row
from validation.measurement import EVEN, depth_window
from validation.phantoms import FLUID, Phantom, layered, reflection_coefficient, thin_slab
from validation.pictures import Curve, Plot, draw_plots

_DEPTH_MM = 25.0
#: Levels in dB relative to a perpendicular wall: predictions hold down to the first; below it, levels stay below the
#: second
_FLOOR_DB, _CEILING_DB = -30.0, -28.0
_SETTINGS = SimulationSettings(scattering=False, specular_exponent=0.0)
#: Echo of a smooth plane re perpendicular in dB, by its tilt in degrees: two-dimensional finite-difference simulation
#: of pulse and echo at f/2, both ways (fourth order, perfectly matched layer, delay and sum). At 15 degrees it has
#: -20.5, where sums over the ways of the apertures have -28.6.
_FULL_WAVE = {0.0: 0.0, 4.0: -0.9, 8.0: -6.3, 12.0: -14.3, 20.0: -30.8, 30.0: -43.5}
_IMAGED_MM = 40.0  # deeper samples are not looked at
#: The shipped probes; their lens is focused at the wall, since the phantom is only 12 mm thick.
_PROBES: dict[str, Probe] = {
    name: replace(probe, elevation_focus_mm=_DEPTH_MM, depth_mm=min(probe.depth_mm, _IMAGED_MM))
    for name, probe in PROBES.items()
}
#: Shipped probes with their own foci: depth of the wall, tilts
_OWN_FOCI = ("linear", 20.0, (4.0, 8.0, 15.0)), ("linear_15", 14.0, (4.0, 8.0))
_FULL_WAVE_PROBE = LinearProbe(36.0, 40.0, scan_lines=145, focus_mm=_DEPTH_MM, aperture_mm=12.5, receive_f_number=2.0,
                               elevation_focus_mm=_DEPTH_MM)  # fmt: skip


def _wall(rotation: np.ndarray, device, depth_mm: float = _DEPTH_MM) -> tuple[UltrasoundSimulator, Phantom]:
    phantom = layered([FLUID, BEHIND], [depth_mm], rotation, spacing_mm=0.15, half_width_mm=12.0)
    # The fluid continues around the phantom, which is narrower than some apertures.
    tissues = TissueTable({**phantom.tissues, 0: FLUID})
    return UltrasoundSimulator(phantom.labels, tissues, _SETTINGS, device), phantom


def _level_db(
    simulator: UltrasoundSimulator, phantom: Phantom, probe: Probe, tilt_deg: float, turn_deg: float = 0.0,
    depth_mm: float = _DEPTH_MM,
) -> float:  # fmt: skip
    """Level of the wall on the middle line of a probe that is tilted about the wall's point on its axis.

    The tilt is in the image plane, or in a plane turned about the axis of the probe.
    """
    tilt, turn = np.radians(tilt_deg), np.radians(turn_deg)
    motion, about_axis = np.eye(4), np.eye(4)
    motion[:2, :2] = [[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]]
    about_axis[::2, ::2][:2, :2] = [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    motion = motion @ about_axis
    motion[:3, 3] = [0.0, depth_mm, 0.0] - motion[:3, :3] @ [0.0, depth_mm, 0.0]
    frame = simulator.simulate(probe, phantom.probe_to_ras @ motion, EVEN)
    middle = depth_window(frame, depth_mm, 3.0)[probe.scan_lines // 2]
    return float(20 * np.log10(np.abs(middle).max() + 1e-12))


def _level_row(quantity: str, predicted: float, measured: float) -> Row:
    if predicted >= _FLOOR_DB:
        return Row(quantity, "dB", predicted, measured, 3.0)
    return Row(quantity, "dB", _CEILING_DB, measured, 0.0, "at most")


def oblique_walls(rotation: np.ndarray, device) -> Outcome:
    """A plane tilted in the image plane and half out of it: every shipped probe, at its own frequency and at 5 MHz."""
    simulator, phantom = _wall(rotation, device)
    rows, curves = [], []
    level = [_level_db(simulator, phantom, _FULL_WAVE_PROBE, tilt) for tilt in _FULL_WAVE]
    measured = np.array(level) - level[0]
    for (tilt, expected), value in zip(_FULL_WAVE.items(), measured, strict=True):
        rows.append(_level_row(f"{tilt:.0f} degrees, full wave at f/2", expected, float(value)))
    tilts = np.array(list(_FULL_WAVE))
    curves.append(Curve("f/2, full wave", tilts, measured, tilts, np.array(list(_FULL_WAVE.values()))))
    for name, shipped in _PROBES.items():
        for frequency in dict.fromkeys((shipped.frequency_mhz, 5.0)):
            probe = replace(shipped, scan_lines=shipped.scan_lines // 2 * 2 + 1, frequency_mhz=frequency)
            square = _level_db(simulator, phantom, probe, 0.0)
            for turn, tilts in ((0.0, (4.0, 8.0, 12.0, 20.0, 28.0, 40.0)), (45.0, (4.0, 16.0, 30.0))):
                predicted = mirror_echo_db(probe, tilts, _DEPTH_MM, turn)
                for tilt, expected in zip(tilts, predicted, strict=True):
                    where = f"{tilt:.0f} degrees{' diagonally' if turn else ''}, {name} {frequency:g} MHz"
                    measured_db = _level_db(simulator, phantom, probe, tilt, turn) - square
                    rows.append(_level_row(where, float(expected), measured_db))
    for name, depth, tilts in _OWN_FOCI:
        probe = replace(PROBES[name], scan_lines=PROBES[name].scan_lines // 2 * 2 + 1)
        simulator, phantom = _wall(rotation, device, depth)
        square = _level_db(simulator, phantom, probe, 0.0, depth_mm=depth)
        for tilt, expected in zip(tilts, mirror_echo_db(probe, tilts, depth), strict=True):
            level = _level_db(simulator, phantom, probe, tilt, depth_mm=depth) - square
            rows.append(Row(f"{tilt:g} degrees at {depth:g} mm, {name} as shipped", "dB", float(expected), level, 2.0))
    plot = Plot("oblique wall", "tilt [degrees]", "echo [dB]", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


def walls_and_lines(rotation: np.ndarray, device) -> Outcome:
    """The same wall drawn with more and more scan lines."""
    simulator, phantom = _wall(rotation, device)
    rows = []
    for name, shipped in _PROBES.items():
        for tilt, turn in ((0.0, 0.0), (4.0, 0.0), (8.0, 0.0), (12.0, 0.0), (20.0, 0.0), (30.0, 0.0), (9.0, 40.0)):
            levels = np.array(
                [
                    _level_db(simulator, phantom, replace(shipped, scan_lines=lines), tilt, turn)
                    for lines in (97, 193, 385)
                ]
            )
            if tilt == 0.0:
                square = levels[1]
            change = float(np.ptp(np.maximum(levels - square, _CEILING_DB)))
            where = f"{tilt:.0f} degrees{f' in a plane turned by {turn:.0f}' if turn else ''}, {name}"
            rows.append(Row(f"change at {where}", "dB", 2.5, change, 0.0, "at most"))
    return Outcome(tuple(rows))


def sheets(rotation: np.ndarray, device) -> Outcome:
    """Sheets thinner than the pulse: the echoes of both faces, of opposite sign, interfere."""
    probe = LinearProbe(8.0, 24.0, scan_lines=41, frequency_mhz=2.5, focus_mm=15.0, elevation_focus_mm=15.0)
    r = float(reflection_coefficient(FLUID, BEHIND))
    front = 20 * np.log10(r) + _SETTINGS.interface_gain_db
    depth, sigma = np.linspace(-3.0, 3.0, 6001), probe.axial_sigma_mm
    rows = []
    for thickness in (0.1, 0.15, 0.3, 0.45):
        phantom = thin_slab(thickness, rotation)
        simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, _SETTINGS, device)
        frame = simulator.simulate(probe, phantom.probe_to_ras, EVEN)
        measured = 20 * np.log10(np.abs(depth_window(frame, 15.0, 2.0)[probe.scan_lines // 2]).max()) - front
        back = (1 - r * r) * np.exp(-2j * np.pi * probe.cycles_per_mm * thickness)
        echo = np.exp(-0.5 * (depth / sigma) ** 2) - back * np.exp(-0.5 * ((depth - thickness) / sigma) ** 2)
        predicted = float(20 * np.log10(np.abs(echo).max()))
        rows.append(Row(f"sheet of {thickness:g} mm relative to one border", "dB", predicted, float(measured), 2.0))
    return Outcome(tuple(rows))


CHECKS = (
    Check(
        "oblique walls",
        "The echo of a tilted plane agrees with its mirror images: sums over the ways between points of the apertures; "
        "below -30 dB it stays below -28 dB.",
        oblique_walls,
    ),
    Check("walls and lines", "A wall does not depend on the number of scan lines.", walls_and_lines),
    Check("sheets", "The two borders of a sheet have echoes of opposite sign.", sheets),
)
