"""Checks of thin sulci, sheets of the membrane's own tissue, and of a falx (docs/physics.md#5-scatterers)."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
from scipy import special
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import LinearProbe
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.sheet_looks import DURA, DURA_ISOTROPIC
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import Membrane
from validation.checks import Check, Outcome, Row
from validation.measurement import EVEN
from validation.phantoms import layered
from validation.pictures import Curve, Plot, draw_plots
from validation.rough import plane_of_dura

_DEPTH_MM, _BAND_MM = 15.0, 0.6  # of the sheet's middle; about it levels are means
_PROBE = LinearProbe(24.0, 30.0, scan_lines=97, frequency_mhz=5.0, focus_mm=_DEPTH_MM, elevation_focus_mm=_DEPTH_MM)
_GREY, _PIA, _DURA = (
    replace(TISSUES[name], attenuation_db_cm_mhz=0.0, texture_db=0.0, specks_per_mm3=0.0)
    for name in ("grey matter", "leptomeninges", DURA)
)
#: At the speed of the brain, so that its wall is seen where it is
_CSF = replace(_GREY, name="csf", mu0=0.0, sigma0=0.0)
_MEMBRANE = Membrane(_PIA)
_ANGLES_DEG = (0.0, 20.0, 40.0, 60.0, 75.0, 85.0)
_TURNS_DEG = ((0.0, 0.0), (7.0, 4.0), (26.0, 15.0))
_VOXELS = 1.5  # thickness of the sulcus as a label
#: Without what does not belong to the sheet
_SETTINGS = SimulationSettings(ring_down=False, side_lobes=False, interfaces=False)
_SEEDS = 2


def _levels_db(kind: str, rotation: np.ndarray, spacing_mm: float, device) -> np.ndarray:
    """(angles,) mean level about a sulcus, a wall or a falx re grey matter."""
    if kind == "sulcus":
        half = 0.5 * _VOXELS * spacing_mm
        layers, borders = [_GREY, _PIA, _GREY], [_DEPTH_MM - half, _DEPTH_MM + half]
    else:
        layers, borders = [_GREY if kind == DURA else _CSF, _GREY], [_DEPTH_MM]
    phantom = layered(layers, borders, rotation, spacing_mm=spacing_mm, half_width_mm=26.0, half_thickness_mm=26.0)
    tissues, sheets = TissueTable({**phantom.tissues, 0: layers[0]}, _MEMBRANE), None
    if kind == DURA:
        tissues = TissueTable({**tissues, max(tissues) + 1: _DURA}, _MEMBRANE)
        sheets = plane_of_dura(phantom.probe_to_ras, _DEPTH_MM)
    levels = []
    simulator = UltrasoundSimulator(phantom.labels, tissues, _SETTINGS, device, sheets=sheets)
    for angle in np.radians(_ANGLES_DEG):
        motion = np.eye(4)
        motion[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        motion[:3, 3] = [0.0, _DEPTH_MM, 0.0] - motion[:3, :3] @ [0.0, _DEPTH_MM, 0.0]
        power = []
        for seed in range(_SEEDS):
            simulator.settings = replace(_SETTINGS, seed=seed)
            frame = simulator.simulate(_PROBE, phantom.probe_to_ras @ motion, EVEN)
            depth = (np.arange(frame.iq.shape[1]) + 0.5) * frame.sample_interval_mm - _DEPTH_MM
            aside = _PROBE.line_positions()[:, None]
            across = np.sin(angle) * aside + np.cos(angle) * depth
            near = (np.abs(across) < 0.5 * _BAND_MM) & (np.abs(aside) < 9.0) & (np.abs(depth) < 9.0)
            power.append((np.abs(frame.iq[near]) ** 2).mean())
        levels.append(10.0 * np.log10(np.mean(power) / _GREY.scatterer_variance))
    return np.array(levels)


def _predicted_db(kind: str) -> np.ndarray:
    """(angles,) by cos^n i or the law of dura, and the part of the pulse and the beam that is in the sheet."""
    angle = np.radians(_ANGLES_DEG)
    lateral, _ = _PROBE.beam_sigma_mm(_DEPTH_MM)
    variance = 0.5 * ((np.cos(angle) * _PROBE.axial_sigma_mm) ** 2 + (np.sin(angle) * lateral) ** 2) + _BAND_MM**2 / 12
    inside = special.erf(0.5 * _MEMBRANE.thickness_mm / np.sqrt(2.0 * variance))
    falls = np.cos(angle) ** (2.0 * _MEMBRANE.diffuse_exponent)
    if kind == DURA:
        falls = DURA_ISOTROPIC + (1.0 - DURA_ISOTROPIC) * np.cos(angle) ** 2
    gain = 10.0 ** (_MEMBRANE.diffuse_db / 10.0) * falls
    around = 0.5 if kind == "wall" else 1.0
    tissue = _DURA if kind == DURA else _PIA
    sheet = gain * tissue.scatterer_variance / _GREY.scatterer_variance
    return 10.0 * np.log10(inside * sheet + (1.0 - inside) * around)


def thin_sulci(rotation: np.ndarray, device) -> Outcome:
    """Level against angle of a sulcus of one and a half voxels, of a falx, and of a ventricle's wall as a control."""
    rows, curves = [], []
    for spacing, kind in itertools.product((0.5, 1.0), ("sulcus", "wall", DURA)):
        predicted, levels = _predicted_db(kind), []
        for turn in _TURNS_DEG if kind != "wall" else _TURNS_DEG[:1]:
            turned = rotation @ Rotation.from_euler("xz", turn, degrees=True).as_matrix()
            levels.append(_levels_db(kind, turned, spacing, device))
        for n, angle in enumerate(_ANGLES_DEG):
            found = np.array(levels)[:, n]
            what = f"{kind} at {angle:.0f} degrees, {spacing:g} mm"
            if predicted[n] > 0.0:
                worst = float(found[np.abs(found - predicted[n]).argmax()])
                rows.append(Row(what, "dB", float(predicted[n]), worst, 3.0))
            else:  # where nothing is left of the sheet, no brighter than grey matter
                rows.append(Row(what, "dB", 0.0, float(found.max()), 0.5, "at most"))
        if kind != "wall":
            spread = float(np.ptp(levels, axis=0).max())
            rows.append(Row(f"change of {kind} with the grid, {spacing:g} mm", "dB", 3.0, spread, 0.0, "at most"))
        angles = np.array(_ANGLES_DEG)
        curves.append(Curve(f"{kind}, {spacing:g} mm", angles, np.mean(levels, axis=0), angles, predicted))
    plot = Plot("thin sulcus, wall and falx", "angle of incidence [degrees]", "level re grey matter [dB]", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


CHECKS = (
    Check(
        "thin sulci",
        "A sulcus of one to two voxels is one rough sheet: it fades with the angle of incidence as a wall does, in any "
        "grid; a falx by Lambert's law, except for a tenth of its power.",
        thin_sulci,
    ),
)
