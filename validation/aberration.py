"""Checks of beams in soft tissue against wave propagation (docs/physics.md#beams-from-an-aperture)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from itertools import pairwise

import numpy as np

from SlicerUSSim.Logic.probe.arrays import PROBES as SHIPPED, Probe
from SlicerUSSim.Logic.tissue.presets import TISSUES
from validation.beam_levels import along_line, beam_of_line, levels_and_widths, levels_db, undisturbed
from validation.checks import PROBES, Check, Outcome, Row
from validation.phantoms import (
    BACKGROUND,
    REFERENCE_SPEED_M_S,
    Phantom,
    behind_object,
    folds,
    mirrored_power_behind,
    reflection_coefficient,
    speed_cyst,
)
from validation.pictures import Curve, Plot, draw_plots
from validation.wave import Map, beam_fields, past_rod, speckle_power

_DEPTHS_MM = np.array([32.0, 38.0, 44.0, 50.0])
#: Speed in m/s and radius in mm
_CYSTS = {"1440 m/s": (1440.0, 4.0), "1500 m/s": (1500.0, 4.0), "1640 m/s": (1640.0, 4.0),
          "1440 m/s, 7 mm": (1440.0, 7.0), "1640 m/s, 7 mm": (1640.0, 7.0)}  # fmt: skip
#: Phantoms by name, for any rotation
_SCENES: dict[str, Callable[..., Phantom]] = {
    "folds": folds,
    **{name: partial(speed_cyst, speed, radius_mm=radius) for name, (speed, radius) in _CYSTS.items()},
}
_LINES = slice(12, 150, 4)  # around those beyond, the phantoms end
_SEEDS = 5  # of scatterers, over which speckle averages
_DARK_DB = -12.0
_EDGE_MM = (-1.5, -0.7, 0.5, 1.1, 1.7)  # places of lines beside the edge of a plate
_BEHIND_MM = (27.0, 29.0, 31.0, 33.0, 35.0)
_NEAR_MM = np.array([-2.0, -1.5, -1.0, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0, 1.5])  # the same, right behind it


def beams_in_folds(rotation: np.ndarray, device) -> Outcome:
    """The level of every line behind sulci, against wave propagation; and of single rays, as a control."""
    rows, plots = [], []
    levels: dict[str, list[np.ndarray]] = {"aperture": [], "ray": [], "wave": []}
    for name, probe in PROBES.items():
        wave = _wave_levels_db("folds", name)
        level, ray = (_levels_db("folds", name, beam, rotation, device) for beam in ("aperture", "ray"))
        for kind, values in (("aperture", level), ("ray", ray), ("wave", wave)):
            levels[kind].append(values)
        rows += [
            Row(f"difference RMS, {name}", "dB", 0.0, float(np.sqrt(np.mean((level - wave) ** 2))), 2.0, "at most"),
            Row(f"mean step between lines, {name}", "dB", 0.0, float(np.abs(np.diff(level)).mean()), 1.5, "at most"),
            Row(f"lines darker than 12 dB, {name}", "", 0.0, float((level < _DARK_DB).mean()), 0.02, "at most"),
        ]
        place = probe.line_positions()[_LINES]
        curves = [Curve("aperture", place, level, place, wave), Curve("single rays", place, ray, place, wave)]
        plots.append(Plot(f"level behind sulci, {name}", "line [mm or radians]", "dB", curves))
    aperture, ray, wave = (np.concatenate(values) for values in levels.values())
    rows += [
        Row("correlation with waves", "", 1.0, float(np.corrcoef(aperture, wave)[0, 1]), 0.15, "at least"),
        Row("control, single rays: correlation", "", 0.5, float(np.corrcoef(ray, wave)[0, 1]), 0.0, "at most"),
    ]
    phantom, probe = folds(rotation), PROBES["linear"]
    assert phantom.baseline is not None
    lengths = levels_and_widths(
        phantom.labels, phantom.tissues, phantom.baseline, probe, phantom.probe_to_ras, device,
        beam="aperture", edges_mm=_DEPTHS_MM[[0, -1]], lines=_LINES, seeds=_SEEDS, wavefront_curvature=True,
    )[1]  # fmt: skip
    # The beams are 1.7 times as wide as undisturbed ones. What waves meet also differs from line to line.
    rows.append(
        Row("length of speckle re undisturbed, linear", "", _wave_length(), float(np.exp(np.log(lengths).mean())), 0.3)
    )
    return Outcome(tuple(rows), partial(draw_plots, plots=plots))


@lru_cache
def _wave_length() -> float:
    """Length of speckle behind sulci re undisturbed one, geometric mean of lines, by the correlation of neighbours."""
    probe, decays = PROBES["linear"], []
    for position in probe.line_positions()[_LINES]:
        of_line = []
        for disturbed in (True, False):
            both = []
            for place in (position, position + probe.line_spacing):
                beam = beam_of_line(beam_fields, probe, place, _DEPTHS_MM, REFERENCE_SPEED_M_S)
                x, sent, received = beam(_speed_of("folds", probe, place) if disturbed else None)
                both.append(sent * received)
            moved = np.array([np.interp(x - probe.line_spacing, x, of) for of in both[1]])
            common = np.abs((both[0] * moved.conj()).sum(axis=1))
            of_line.append(-np.log(common / np.sqrt((abs(both[0]) ** 2).sum(axis=1) * (abs(moved) ** 2).sum(axis=1))))
        decays.append(of_line)
    found = np.array(decays)
    return float(np.exp(0.5 * np.log(found[:, 1] / found[:, 0]).mean()))


def beams_behind_cysts(rotation: np.ndarray, device) -> Outcome:
    """Mean power and edge shadow behind cysts of other speeds of sound, against wave propagation."""
    rows, plots = [], []
    place = PROBES["linear"].line_positions()[_LINES]
    for scene, (_, radius) in _CYSTS.items():
        behind = np.abs(place) < 2.0 * radius
        wave = _wave_levels_db(scene, "linear")
        level = _levels_db(scene, "linear", "aperture", rotation, device)
        means = [float(10 * np.log10(np.mean(10 ** (values[behind] / 10)))) for values in (wave, level)]
        edges = [float(values[np.abs(np.abs(place) - radius) < 1.2].mean()) for values in (wave, level)]
        # Of the two edges; a shadow's place moves with depth, and its darkest line with the scatterers.
        darkest = [
            float(np.mean([values[behind & (side * place > 0.4 * radius)].min() for side in (-1, 1)]))
            for values in (wave, level)
        ]
        rows += [
            Row(f"mean power behind, {scene}", "dB", means[0], means[1], 0.7),
            Row(f"level behind the edge, {scene}", "dB", edges[0], edges[1], 1.2),
            Row(f"darkest line beside the middle, {scene}", "dB", darkest[0], darkest[1], 1.7),
        ]
        plots.append(Plot(f"behind a cyst, {scene}", "lateral [mm]", "dB", [Curve("", place, level, place, wave)]))
    return Outcome(tuple(rows), partial(draw_plots, plots=plots))


def _levels_db(scene: str, probe_name: str, beam: str, rotation: np.ndarray, device) -> np.ndarray:
    """(lines,) power of speckle in the deeper part, relative to the reference speed of sound everywhere."""
    phantom, probe = _SCENES[scene](rotation=rotation), PROBES[probe_name]
    assert phantom.baseline is not None
    return levels_db(
        phantom.labels, phantom.tissues, phantom.baseline, probe, phantom.probe_to_ras, device,
        beam=beam, edges_mm=_DEPTHS_MM[[0, -1]], lines=_LINES, seeds=_SEEDS,
    )  # fmt: skip


@lru_cache
def _wave_levels_db(scene: str, probe_name: str) -> np.ndarray:
    """(lines,) the same from wave propagation in the plane of the image."""
    probe, levels = PROBES[probe_name], []
    for position in probe.line_positions()[_LINES]:
        beam = beam_of_line(speckle_power, probe, position, _DEPTHS_MM, REFERENCE_SPEED_M_S)
        levels.append(10.0 * np.log10(np.mean(beam(_speed_of(scene, probe, position)) / beam(None))))
    return np.array(levels)


def _speed_of(scene: str, probe: Probe, position: float) -> Map:
    """Speed of sound in the frame of a line through a scene that is not turned."""
    phantom = _scene(scene)
    labels, to_ijk = phantom.labels.array, phantom.labels.ras_to_ijk @ phantom.probe_to_ras
    speeds, voxel = np.full(256, REFERENCE_SPEED_M_S), along_line(probe, position, to_ijk)
    for label, tissue in phantom.tissues.items():
        speeds[label] = tissue.speed_of_sound_m_s

    def speed(x: np.ndarray, depth: np.ndarray) -> np.ndarray:
        indices = zip(voxel(x, depth), labels.shape[::-1], strict=False)
        i, j, k = (np.clip(np.rint(c).astype(int), 0, n - 1) for c, n in indices)
        return speeds[labels[k, j, i]]

    return speed


@lru_cache
def _scene(name: str) -> Phantom:
    return _SCENES[name]()


def beams_past_strong_tissue(rotation: np.ndarray, device) -> Outcome:
    """Objects that differ in impedance alone, lossy plates, and fat in scalp: against theory and wave propagation."""
    probe = replace(PROBES["linear"], frequency_mhz=5.0, focus_mm=30.0, depth_mm=48.0, scan_lines=192)
    plain, place, rows = replace(BACKGROUND, attenuation_db_cm_mhz=0.0), probe.line_positions(), []

    def level(shape: str, tissue, background=plain, edges=(27.0, 35.0)) -> np.ndarray:
        phantom = behind_object(shape, tissue, rotation, background=background)
        assert phantom.baseline is not None
        return levels_db(
            phantom.labels, phantom.tissues, phantom.baseline, probe, phantom.probe_to_ras, device,
            beam="aperture", edges_mm=np.array(edges), lines=slice(0, 191, 1), seeds=_SEEDS,
            reflections=False,  # a mirror image would fill the shadow
        )  # fmt: skip

    clear = replace(plain, name="clear", impedance_mrayl=1.29 * plain.impedance_mrayl)
    through = 40.0 * np.log10(1.0 - (0.29 / 2.29) ** 2)
    near = np.abs(place[:-1]) < 6.0
    for shape in ("plate", "strip", "ball"):
        found = level(shape, clear)[near]
        rows += [
            Row(f"darkest line, clear {shape}", "dB", through, float(found.min()), 0.3),
            Row(f"brightest line, clear {shape}", "dB", 0.0, float(found.max()), 0.15),
        ]
    plates = {
        "plate of 30 dB": (30.0, replace(clear, name="lossy", attenuation_db_cm_mhz=10.0)),
        "air": (90.0, TISSUES["air"]),
    }
    for name, (loss_db, tissue) in plates.items():
        found = level("plate", tissue)
        for edge in _EDGE_MM:
            wave = _wave_behind_db(None, "plate", -edge, loss_db)
            seen = float(np.interp(edge, place[:-1], found))
            rows.append(Row(f"{name}, line at {edge} mm", "dB", wave, seen, 3.5))
    # Right behind its edge: in blocks of depth, since levels change with it.
    blocks, away = np.array([18.5, 20.5, 22.5, 24.5, 26.5]), []
    for begin, end in pairwise(blocks):
        found, depths = level("plate", TISSUES["air"], edges=(begin, end)), (begin + 0.5, end - 0.5)
        waves = np.array([_wave_behind_db(None, "plate", -edge, 90.0, depths) for edge in _NEAR_MM])
        lit = waves > -20.0
        away.append((np.interp(_NEAR_MM, place[:-1], found) - waves)[lit])
    behind = float(np.sqrt(np.mean(np.concatenate(away) ** 2)))
    rows.append(Row("air, up to 8 mm behind its edge: difference RMS", "dB", 3.0, behind, 0.0, "at most"))
    # Soft tissue of 15 dB: a beam has the mean amplitude of its lines, not the mean of their decibels.
    found = level("plate", replace(plain, name="lossy", attenuation_db_cm_mhz=5.0))
    waves = np.array([_wave_behind_db(None, "plate", -edge, 15.0) for edge in _EDGE_MM])
    seen, decibels = np.interp(_EDGE_MM, place[:-1], found), np.array([_mean_db(edge, 15.0) for edge in _EDGE_MM])
    rows += [
        Row(f"soft plate of 15 dB, line at {edge} mm", "dB", wave, float(level), 0.8)
        for edge, wave, level in zip(_EDGE_MM, waves, seen, strict=True)
    ]
    plate = "soft plate of 15 dB"
    away, control = (float(np.sqrt(np.mean((levels - waves) ** 2))) for levels in (seen, decibels))
    rows += [
        Row(f"{plate}, difference RMS", "dB", 0.5, away, 0.0, "at most"),
        Row(f"{plate}, control, mean of decibels: difference RMS", "dB", 1.0, control, 0.0, "at least"),
    ]
    fat, scalp = (replace(TISSUES[name], attenuation_db_cm_mhz=0.0) for name in ("fat", "scalp"))
    found = level("ball", fat, scalp)
    for edge in (-4.0, -2.4, 0.0):
        wave = _wave_behind_db((fat.speed_of_sound_m_s, scalp.speed_of_sound_m_s), "ball", -edge, 0.0)
        seen = float(np.interp(edge, place[:-1], found))
        rows.append(Row(f"ball of fat in scalp, line at {edge} mm", "dB", wave, seen, 2.0))
    return Outcome(tuple(rows), None)


def shadows_of_rods(rotation: np.ndarray, device) -> Outcome:
    """Speckle behind a rod of bone of 4 mm, with its mirror image in front of it, against the exact series of waves."""
    plain, rows, plots = replace(BACKGROUND, attenuation_db_cm_mhz=0.0), [], []
    phantom, radius, centre = behind_object("rod", TISSUES["bone"], rotation), 2.0, 16.0
    assert phantom.baseline is not None
    reflected = float(reflection_coefficient(plain, TISSUES["bone"])) ** 4  # of the power, both ways
    for name, depth in (("linear", 23.0), ("linear", 28.0), ("convex", 26.0), ("convex", 46.0)):
        probe = replace(SHIPPED[name], clutter_db=None, depth_mm=50.0, focus_mm=SHIPPED[name].focus_mm)
        found = levels_db(
            phantom.labels, phantom.tissues, phantom.baseline, probe, phantom.probe_to_ras, device,
            beam="aperture", edges_mm=np.array([depth - 1.0, depth + 1.0]), lines=slice(0, probe.scan_lines - 1, 1),
            seeds=_SEEDS,
        )  # fmt: skip
        place = probe.line_positions()[:-1] / probe.line_spacing * float(probe.line_distance_mm(depth))
        near = np.flatnonzero(np.abs(place) < 7.0)
        lines = np.unique(np.append(near[::4], np.argmin(np.abs(place))))
        apertures = (probe.aperture_mm, probe.focus_mm), (min(probe.aperture_mm, depth / probe.receive_f_number), depth)
        powers = []
        for line in lines:
            origin, direction = (v[:2] for v in probe.line_at(probe.line_positions()[line]))
            away = [0.0, centre] - origin
            beside = float(away @ [direction[1], -direction[0]]), float(away @ direction)
            powers.append(past_rod(radius, beside, depth, apertures, probe.frequency_mhz))
        image = 10.0 ** (0.1 * found[near])
        image = np.convolve(np.pad(image, 2, mode="edge"), np.full(5, 0.2), "valid")
        mirrored = mirrored_power_behind(probe, radius, centre - radius, depth - centre + radius, is_sphere=False)
        middle = float(np.interp(0.0, place[lines], powers)) + reflected * mirrored
        where = f"{depth - centre - radius:.0f} mm behind, {name}"
        # Right behind it, where waves leave -34 dB and mirror -27, images have -30 and -22: 2 dB by the Gaussian beam
        # before so small a mirror, and 2 dB by curvature from voxels.
        limit = 6.0 if middle < 0.003 else 3.0
        rows += [
            Row(f"middle, {where}", "dB", 10.0 * np.log10(middle),
                10.0 * float(np.log10(image[np.abs(place[near]) < 0.5].mean())), limit),
            Row(f"width at -6 dB, {where}", "mm", width := _dark_mm(place[lines], np.array(powers)),
                _dark_mm(place[near], image), 0.2 * width),
        ]  # fmt: skip
        levels = 10.0 * np.log10(image), 10.0 * np.log10(powers)
        curve = Curve("image", place[near], levels[0], place[lines], levels[1])
        plots.append(Plot(f"{where}", "lateral [mm]", "dB", [curve]))
    return Outcome(tuple(rows), partial(draw_plots, plots=plots))


def _dark_mm(place: np.ndarray, power: np.ndarray) -> float:
    """How wide a shadow around zero is a quarter of the power around it, or less."""
    sides = []
    for side in (1.0, -1.0):
        out = np.argsort(side * place)
        x, of = (side * place)[out], power[out]
        x, of = x[x >= 0.0], of[x >= 0.0]
        lit = int(np.argmax(of > 0.25))
        sides.append(np.interp(0.25, of[lit - 1 : lit + 1], x[lit - 1 : lit + 1]) if lit else 0.0)
    return float(sum(sides))


def _mean_db(line_mm: float, loss_db: float) -> float:
    """Mean decibels of the straight lines to a scan line behind the plate of phantoms.behind_object."""
    depths = np.array(_BEHIND_MM)
    reach = 0.5 * np.minimum(12.0, depths / 2.5)
    at_plate = line_mm + np.linspace(-1.0, 1.0, 81) * (reach * (1.0 - 16.5 / depths))[:, None]
    return float(-loss_db * (at_plate > 0.0).mean())


@lru_cache
def _wave_behind_db(
    speeds: tuple[float, float] | None, shape: str, moved_mm: float, loss_db: float, depths_mm=_BEHIND_MM
) -> float:
    """Power of speckle on a line behind an object of phantoms.behind_object moved aside, by wave propagation.

    `speeds` are of the object and around it; `loss_db` is both ways, through a plate.
    """
    fields = {"frequency_mhz": 5.0, "aperture_mm": 12.0, "f_number": 2.5, "focus_mm": 30.0,
              "reference_m_s": REFERENCE_SPEED_M_S}  # fmt: skip
    beam = partial(speckle_power, depths_mm=np.array(depths_mm), **fields)

    def is_inside(x, depth):
        if shape == "ball":
            return (x - moved_mm) ** 2 + (depth - 16.0) ** 2 < 9.0
        return (depth > 15.0) & (depth < 18.0) & (x > moved_mm)

    def nepers(x, depth):
        return is_inside(x, depth) * loss_db / 2.0 / 3.0 * np.log(10.0) / 20.0

    def speed(x, depth, inside: float, around: float):
        return np.where(is_inside(x, depth), inside, around)

    if speeds is None:
        powers = [beam(None, nepers_per_mm=nepers), undisturbed(speckle_power, tuple(depths_mm), **fields)]
    else:
        powers = [beam(partial(speed, inside=inside, around=speeds[1])) for inside in speeds]
    return float(10.0 * np.log10(np.mean(powers[0] / powers[1])))


CHECKS = (
    Check(
        "beams past strong tissue",
        "Strong tissue takes from a beam what it does not let through, of the lines that meet it: levels at its edges.",
        beams_past_strong_tissue,
    ),
    Check(
        "rods of bone",
        "Behind a rod of bone there is what goes past it, and the mirror image of what is in front of it: exact waves.",
        shadows_of_rods,
    ),
    Check(
        "beams in folds",
        "Sulci change the level of a line as wave propagation says, without streaks; single rays do not follow it.",
        beams_in_folds,
    ),
    Check(
        "beams behind cysts",
        "Behind a cyst of another speed of sound, mean power and edge shadow agree with wave propagation.",
        beams_behind_cysts,
    ),
)
