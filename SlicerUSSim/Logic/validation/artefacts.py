"""Checks of the artefacts of the paper's Fig. 2 (PHYSICS section 7), and of a wire and cyst phantom."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from SlicerUSSim.Logic.frame import Frame
from SlicerUSSim.Logic.measurement import echo_near, region_level_db
from SlicerUSSim.Logic.phantoms import (
    Echo,
    LevelChange,
    Phantom,
    attenuating_block,
    curved_mirror,
    mirror,
    parallel_plates,
    refracting_wedge,
    speed_block,
    wires_and_cysts,
)
from SlicerUSSim.Logic.probe import Probe
from SlicerUSSim.Logic.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.validation import PROBES, Check, Outcome, Row
from SlicerUSSim.Logic.validation.pictures import View, draw_views

_SEARCH_MM = 1.5  # around the predicted place; five times the widest tolerance
_SETTINGS = SimulationSettings(reflection_threshold=1e-2)
# Wide enough to show a mirror's and a speckle's echoes at once; the phantoms attenuate by 0.5 dB/(cm MHz) or less.
_DISPLAY = DisplaySettings(dynamic_range_db=70.0, tgc_db_cm_mhz=0.5, noise_db=None)


def _images(
    phantom: Phantom, device, probes: dict[str, Probe], settings=_SETTINGS, reference: bool = False
) -> dict[str, Frame]:
    """What each probe sees of the phantom, or of its reference."""
    tissues = phantom.reference if reference else phantom.tissues
    simulator = UltrasoundSimulator(phantom.labels, tissues, settings, device)
    return {name: simulator.simulate(probe, phantom.probe_to_ras, _DISPLAY) for name, probe in probes.items()}


def shadow_and_enhancement(rotation: np.ndarray, device) -> Outcome:
    """A block that attenuates more than its surroundings, and one that attenuates less."""
    rows, views = [], []
    for kind, attenuation in (("shadow", 1.2), ("enhancement", 0.1)):
        phantom = attenuating_block(attenuation, rotation)
        frames, plain = _images(phantom, device, PROBES), _images(phantom, device, PROBES, reference=True)
        for name, probe in PROBES.items():
            (change,) = phantom.expected(probe)
            levels = [region_level_db(f[name], probe, change.region_mm) for f in (frames, plain)]
            rows.append(Row(f"level behind, {kind}, {name}", "dB", change.change_db, levels[0] - levels[1], 0.5))
        views.append(View(kind, phantom, PROBES["linear"], frames["linear"]))
    return Outcome(tuple(rows), partial(draw_views, views=views))


def range_distortion(rotation: np.ndarray, device) -> Outcome:
    """A wire behind a slow block and behind a fast one."""
    rows, views = [], []
    for kind, speed in (("slow", 1450.0), ("fast", 1650.0)):
        phantom = speed_block(speed, rotation)
        frames, plain = _images(phantom, device, PROBES), _images(phantom, device, PROBES, reference=True)
        for name, probe in PROBES.items():
            (wire,) = phantom.expected(probe)
            shown = echo_near(frames[name], probe, wire.shown_mm, _SEARCH_MM)[1]
            undistorted = echo_near(plain[name], probe, wire.object_mm, _SEARCH_MM)[1]
            moved = wire.shown_mm[1] - wire.object_mm[1]
            tolerance = frames[name].sample_interval_mm + 0.05
            rows.append(Row(f"wire moves, {kind} block, {name}", "mm", moved, shown - undistorted, tolerance))
        views.append(View(f"{kind} block", phantom, PROBES["linear"], frames["linear"]))
    return Outcome(tuple(rows), partial(draw_views, views=views))


def _displacements(phantom: Phantom, device, tolerance_mm: float, picture: str, title: str) -> Outcome:
    """Rows for every echo of a phantom: how far from its predicted place it is shown."""
    frames = _images(phantom, device, PROBES)
    rows = []
    for name, probe in PROBES.items():
        for echo in phantom.expected(probe):
            if isinstance(echo, Echo):
                x, y, _ = echo_near(frames[name], probe, echo.shown_mm, _SEARCH_MM)
                rows += [
                    Row(f"{echo.name}, lateral, {name}", "mm", echo.shown_mm[0], x, tolerance_mm),
                    Row(f"{echo.name}, depth, {name}", "mm", echo.shown_mm[1], y, tolerance_mm),
                ]
    return Outcome(tuple(rows), partial(draw_views, views=[View(title, phantom, PROBES[picture], frames[picture])]))


def mirroring(rotation: np.ndarray, device) -> Outcome:
    """A rod before an oblique strong reflector."""
    return _displacements(mirror(rotation), device, 0.3, "linear", "mirror")


def curved_mirrors(rotation: np.ndarray, device) -> Outcome:
    """Speckle mirrored by a ball, a rod and a plane."""
    rows, views = [], []
    for kind, shape in (("ball", {}), ("rod", {"is_sphere": False}), ("plane", {"radius_mm": 1e6})):
        phantom = curved_mirror(rotation, **shape)
        seen = [_images(phantom, device, PROBES, replace(_SETTINGS, seed=n, interfaces=False)) for n in range(12)]
        for name, probe in PROBES.items():
            for level in phantom.expected(probe):
                powers = [10 ** (region_level_db(frame[name], probe, level.region_mm) / 10) for frame in seen]
                measured = 10 * np.log10(np.mean(powers))
                rows.append(Row(f"speckle {level.name} behind a {kind}, {name}", "dB", level.level_db, measured, 1.5))
        views.append(View(kind, phantom, PROBES["convex"], seen[0]["convex"]))
    return Outcome(tuple(rows), partial(draw_views, views=views))


def refraction(rotation: np.ndarray, device) -> Outcome:
    """Wires behind an oblique border between two speeds."""
    return _displacements(refracting_wedge(rotation), device, 0.3, "linear", "refracting wedge")


def reverberation(rotation: np.ndarray, device) -> Outcome:
    """Two parallel borders.

    At 2 MHz: borders taken from voxels waver by some hundredths of a millimetre, and an echo that has met several of
    them loses coherence where that is not small against the wavelength.
    """
    phantom = parallel_plates(rotation)
    probes = {name: replace(probe, frequency_mhz=2.0) for name, probe in PROBES.items()}
    frames = _images(phantom, device, probes, replace(_SETTINGS, reflection_threshold=1e-3))
    rows = []
    for name, probe in probes.items():
        echoes = phantom.expected(probe)
        found = [echo_near(frames[name], probe, echo.shown_mm, _SEARCH_MM) for echo in echoes]
        tolerance = frames[name].sample_interval_mm + 0.05
        for n in range(1, len(echoes)):
            apart = echoes[n].shown_mm[1] - echoes[n - 1].shown_mm[1]
            fall = echoes[n].level_db - echoes[n - 1].level_db
            rows += [
                Row(f"distance to {echoes[n].name}, {name}", "mm", apart, found[n][1] - found[n - 1][1], tolerance),
                Row(f"fall to {echoes[n].name}, {name}", "dB", fall, 20 * np.log10(found[n][2] / found[n - 1][2]), 0.5),
            ]
    return Outcome(
        tuple(rows), partial(draw_views, views=[View("parallel plates", phantom, probes["linear"], frames["linear"])])
    )


def wires_cysts_and_contrast(rotation: np.ndarray, device) -> Outcome:
    """A quality-assurance phantom: places of wires, levels of cysts and contrast targets."""
    phantom = wires_and_cysts(rotation)
    placed = _displacements(phantom, device, 0.3, "convex", "wires and cysts")
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, _SETTINGS, device)
    rows = list(placed.rows)
    for name, probe in PROBES.items():
        changes = [change for change in phantom.expected(probe) if isinstance(change, LevelChange)]
        levels = []
        for tissues in (phantom.tissues, phantom.reference):
            simulator.set_tissues(tissues)
            frame = simulator.simulate(probe, phantom.probe_to_ras, _DISPLAY)
            levels.append([region_level_db(frame, probe, change.region_mm) for change in changes])
        for change, seen, plain in zip(changes, *levels, strict=True):
            rows.append(Row(f"{change.name} target, {name}", "dB", change.change_db, seen - plain, 0.5))
        # Inside a cyst there is nothing but what the beam's edges see of its surroundings.
        black = region_level_db(frame, probe, (-13.5, -10.5, 18.5, 21.5))
        around = region_level_db(frame, probe, (-10.0, -8.0, 24.0, 34.0))
        rows.append(Row(f"cyst below its surroundings, {name}", "dB", -40.0, black - around, 0.0, "at most"))
    return Outcome(tuple(rows), placed.draw)


CHECKS = (
    Check(
        "shadow and enhancement",
        "Behind a block of thickness d the mean level changes by -2 (a_block - a_background) f d dB.",
        shadow_and_enhancement,
    ),
    Check(
        "range distortion",
        "An echo behind a block of thickness d and speed c moves by d (c_ref/c - 1).",
        range_distortion,
    ),
    Check("mirroring", "A target before an oblique mirror appears again at its mirror image.", mirroring),
    Check(
        "curved mirrors",
        "A convex mirror of radius r spreads what it shows at a distance l: by 1 + 2 l / r in each curved direction.",
        curved_mirrors,
    ),
    Check("refraction", "A target behind an oblique border is displaced as Snell's law says.", refraction),
    Check(
        "reverberation",
        "Between borders d apart: an echo every d c_ref/c, each weaker by 20 log10(r1 r2) dB.",
        reverberation,
    ),
    Check(
        "wires and cysts",
        "Wires are shown where they are, targets as bright as their scatterers, cysts black.",
        wires_cysts_and_contrast,
    ),
)
