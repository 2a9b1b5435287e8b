"""Checks of the artefacts of the paper's Fig. 2 (docs/physics.md#3-rays), and of a wire and cyst phantom."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import Probe
from validation.checks import PROBES, Check, Outcome, Row
from validation.measurement import echo_near, region_level_db
from validation.phantoms import (
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
from validation.pictures import View, draw_views

_SEARCH_MM = 1.5  # around the predicted place; five times the widest tolerance
_SETTINGS = SimulationSettings(reflection_threshold=1e-2)
# A dynamic range for both mirror echoes and speckle; the phantoms attenuate by 0.5 dB/(cm MHz) or less.
_DISPLAY = DisplaySettings(look="even", dynamic_range_db=70.0, tgc_db_cm_mhz=0.5, noise_db=None)


def _simulator(phantom: Phantom, device, settings: SimulationSettings = _SETTINGS) -> UltrasoundSimulator:
    return UltrasoundSimulator(phantom.labels, phantom.tissues, settings, device)


def _images(simulator: UltrasoundSimulator, phantom: Phantom, probes: dict[str, Probe] = PROBES) -> dict[str, Frame]:
    """The image of the phantom for each probe."""
    return {name: simulator.simulate(probe, phantom.probe_to_ras, _DISPLAY) for name, probe in probes.items()}


def _images_and_baseline(phantom: Phantom, device) -> tuple[dict[str, Frame], dict[str, Frame]]:
    """The images of the phantom and of its baseline for each probe."""
    assert phantom.baseline is not None, "needed for predictions of a change of level or position"
    simulator = _simulator(phantom, device)
    frames = _images(simulator, phantom)
    simulator.set_tissues(phantom.baseline)
    return frames, _images(simulator, phantom)


def _level_row(quantity: str, change: LevelChange, probe: Probe, frame: Frame, baseline: Frame) -> Row:
    """The difference of a region's level from that of the baseline."""
    seen, plain = (region_level_db(image, probe, change.region_mm) for image in (frame, baseline))
    return Row(quantity, "dB", change.change_db, seen - plain, 0.5)


def shadow_and_enhancement(rotation: np.ndarray, device) -> Outcome:
    """A block that attenuates more than its surroundings, and one that attenuates less."""
    rows, views = [], []
    for kind, attenuation in (("shadow", 1.2), ("enhancement", 0.1)):
        phantom = attenuating_block(attenuation, rotation)
        frames, plain = _images_and_baseline(phantom, device)
        for name, probe in PROBES.items():
            (change,) = phantom.expected(probe)
            rows.append(_level_row(f"level behind, {kind}, {name}", change, probe, frames[name], plain[name]))
        views.append(View(kind, phantom, PROBES["linear"], frames["linear"]))
    return Outcome(tuple(rows), partial(draw_views, views=views))


def range_distortion(rotation: np.ndarray, device) -> Outcome:
    """A wire behind a slow block and behind a fast one."""
    rows, views = [], []
    for kind, speed in (("slow", 1450.0), ("fast", 1650.0)):
        phantom = speed_block(speed, rotation)
        frames, plain = _images_and_baseline(phantom, device)
        for name, probe in PROBES.items():
            (wire,) = phantom.expected(probe)
            shown = echo_near(frames[name], probe, wire.shown_mm, _SEARCH_MM)[1]
            undistorted = echo_near(plain[name], probe, wire.object_mm, _SEARCH_MM)[1]
            moved = wire.shown_mm[1] - wire.object_mm[1]
            tolerance = frames[name].sample_interval_mm + 0.05
            rows.append(Row(f"wire moves, {kind} block, {name}", "mm", moved, shown - undistorted, tolerance))
        views.append(View(f"{kind} block", phantom, PROBES["linear"], frames["linear"]))
    return Outcome(tuple(rows), partial(draw_views, views=views))


def _displacements(phantom: Phantom, frames: dict[str, Frame], picture: str = "linear") -> Outcome:
    """Rows for every echo of a phantom: predicted and measured position."""
    tolerance_mm = 0.3
    rows = []
    for name, probe in PROBES.items():
        for echo in phantom.expected(probe):
            if isinstance(echo, Echo):
                x, y, _ = echo_near(frames[name], probe, echo.shown_mm, _SEARCH_MM)
                rows += [
                    Row(f"{echo.name}, lateral, {name}", "mm", echo.shown_mm[0], x, tolerance_mm),
                    Row(f"{echo.name}, depth, {name}", "mm", echo.shown_mm[1], y, tolerance_mm),
                ]
    return Outcome(
        tuple(rows), partial(draw_views, views=[View(phantom.name, phantom, PROBES[picture], frames[picture])])
    )


def mirroring(rotation: np.ndarray, device) -> Outcome:
    """A rod in front of an oblique strong reflector."""
    phantom = mirror(rotation)
    return _displacements(phantom, _images(_simulator(phantom, device), phantom))


def curved_mirrors(rotation: np.ndarray, device) -> Outcome:
    """Speckle mirrored by a ball, a rod and a plane."""
    rows, views = [], []
    for kind, phantom in (
        ("ball", curved_mirror(rotation)),
        ("rod", curved_mirror(rotation, is_sphere=False)),
        ("plane", curved_mirror(rotation, radius_mm=1e6)),
    ):
        simulator = _simulator(phantom, device, replace(_SETTINGS, interfaces=False))
        seen = []
        for seed in range(12):
            simulator.settings = replace(simulator.settings, seed=seed)
            seen.append(_images(simulator, phantom))
        for name, probe in PROBES.items():
            for level in phantom.expected(probe):
                powers = [10 ** (region_level_db(frame[name], probe, level.region_mm) / 10) for frame in seen]
                measured = float(10 * np.log10(np.mean(powers)))
                # Behind a ball, the Gaussian beam is wider across the slice than that of the lens, by 0.9 dB at 10 mm.
                limit = 2.5 if kind == "ball" else 1.5
                rows.append(Row(f"speckle {level.name} behind a {kind}, {name}", "dB", level.level_db, measured, limit))
        views.append(View(kind, phantom, PROBES["convex"], seen[0]["convex"]))
    return Outcome(tuple(rows), partial(draw_views, views=views))


def refraction(rotation: np.ndarray, device) -> Outcome:
    """Wires behind an oblique interface between two speeds of sound."""
    phantom = refracting_wedge(rotation)
    # By single rays: of a beam, deflection is to first order of the contrast.
    return _displacements(phantom, _images(_simulator(phantom, device, replace(_SETTINGS, beam="ray")), phantom))


def reverberation(rotation: np.ndarray, device) -> Outcome:
    """Two parallel interfaces, in small voxels at 2 MHz, and in voxels of 0.5 and 1 mm at 5 MHz.

    Borders reconstructed from voxels have errors of some hundredths of a voxel, and an echo that has met several loses
    coherence if the errors are not small compared with the wavelength.
    """
    rows, views = [], []
    for spacing, gap, frequency, loss in ((0.2, 7.2, 2.0, 0.5), (0.5, 7.0, 5.0, 1.0), (1.0, 7.0, 5.0, 1.0)):
        phantom = parallel_plates(rotation, gap_mm=gap, spacing_mm=spacing)
        probes = {name: replace(probe, frequency_mhz=frequency) for name, probe in PROBES.items()}
        simulator = _simulator(phantom, device, replace(_SETTINGS, reflection_threshold=1e-3))
        frames = _images(simulator, phantom, probes)
        views.append(View(phantom.name, phantom, probes["linear"], frames["linear"]))
        for name, probe in probes.items():
            echoes = phantom.expected(probe)
            found = [echo_near(frames[name], probe, echo.shown_mm, _SEARCH_MM) for echo in echoes]
            tolerance = frames[name].sample_interval_mm + 0.05
            for n in range(1, len(echoes)):
                apart = echoes[n].shown_mm[1] - echoes[n - 1].shown_mm[1]
                fall = echoes[n].level_db - echoes[n - 1].level_db
                with np.errstate(divide="ignore"):  # a missing echo is a finding too
                    found_fall = 20.0 * np.log10(found[n][2] / found[n - 1][2])
                where = f"{echoes[n].name}, {name}, {spacing:g} mm"
                rows += [
                    Row(f"distance to {where}", "mm", apart, found[n][1] - found[n - 1][1], tolerance),
                    Row(f"fall to {where}", "dB", fall, found_fall, loss),
                ]
    return Outcome(tuple(rows), partial(draw_views, views=views[:1]))


def wires_cysts_and_contrast(rotation: np.ndarray, device) -> Outcome:
    """A quality-assurance phantom: positions of wires, levels of cysts and contrast targets."""
    phantom = wires_and_cysts(rotation)
    frames, plain = _images_and_baseline(phantom, device)
    main_lobes = _simulator(phantom, device)
    main_lobes.settings = replace(main_lobes.settings, side_lobes=False)
    dark = _images(main_lobes, phantom)
    placed = _displacements(phantom, frames, "convex")
    rows = list(placed.rows)
    for name, probe in PROBES.items():
        for change in phantom.expected(probe):
            if isinstance(change, LevelChange):
                rows.append(_level_row(f"{change.name} target, {name}", change, probe, frames[name], plain[name]))
        # In the main lobes there are only echoes from a cyst's surroundings at the edges of the beam; side lobes and
        # clutter have a separate check.
        black = region_level_db(dark[name], probe, (-13.5, -10.5, 18.5, 21.5))
        around = region_level_db(dark[name], probe, (-10.0, -8.0, 24.0, 34.0))
        rows.append(Row(f"cyst in the main lobes, {name}", "dB", -40.0, black - around, 0.0, "at most"))
    return Outcome(tuple(rows), placed.draw)


CHECKS = (
    Check(
        "shadow and enhancement",
        "Behind a block of thickness d the mean level changes by -2 (a_block - a_background) f d dB.",
        shadow_and_enhancement,
    ),
    Check(
        "range distortion",
        "An echo behind a block of thickness d and speed of sound c is displaced by d (c_ref/c - 1).",
        range_distortion,
    ),
    Check("mirroring", "A target in front of an oblique mirror appears again at its mirror image.", mirroring),
    Check(
        "curved mirrors",
        "A convex mirror spreads the focused beam as the exact waves at a rod of its radius are spread.",
        curved_mirrors,
    ),
    Check("refraction", "A target behind an oblique interface is displaced as Snell's law predicts.", refraction),
    Check(
        "reverberation",
        "Between interfaces d apart there are echoes d c_ref/c apart, the level changing by 20 log10(r1 r2) dB each.",
        reverberation,
    ),
    Check(
        "wires and cysts",
        "Wires appear at their positions, targets with the level of their scatterers, and cysts are black.",
        wires_cysts_and_contrast,
    ),
)
