"""Images of a shard, with the maps on their pixels that follow from labels alone."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.datasets.draws import generator
from SlicerUSSim.Logic.datasets.prepared import CLASSES, OTHER
from SlicerUSSim.Logic.datasets.recipe import Recipe
from SlicerUSSim.Logic.datasets.scenes import Scene, scene, section_of
from SlicerUSSim.Logic.imaging.batch import OUTPUTS as SIMULATED
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import slice_under_probe
from SlicerUSSim.Logic.tissue.table import TissueTable

#: Of the attenuation and travel time along scan lines
_STEP_MM = 0.5


def render(recipe: Recipe, out: Path, shard: int) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """({output: array}, the parameters of each image) of a shard, (images, ...) in their order.

    Labels are places in CLASSES, which are the same for all patients. Besides the recipe's outputs there are "pose",
    (4, 4) probe_to_ras, and "image_to_probe", (4, 4) from (column, row, 0, 1) to the probe's millimetres, float32.
    """
    numbers = recipe.images_of(shard)
    made = scene(recipe, out, recipe.case_of(shard))
    parameters = [recipe.drawn(number) for number in numbers]
    # Images of one probe follow each other, since its geometry is kept for a few probes alone
    order = sorted(range(len(numbers)), key=lambda n: parameters[n]["probe"])
    probes = [recipe.probes[parameters[n]["probe"]] for n in order]
    poses = [made.pose(numbers[n], parameters[n]) for n in order]
    displays = [section_of(DisplaySettings(), parameters[n], "display") for n in order]
    settings = [made.settings(parameters[n]) for n in order]
    tables = []
    for n in order:
        table, values = made.tissues(numbers[n])
        parameters[n].update(values)
        tables.append(table)
    wanted = recipe.settings.outputs
    simulated = [name for name in SIMULATED if name in wanted or (name == "labels" and "walls" in wanted)]
    noise = [numbers[n] % 2**32 for n in order]
    found = made.simulator.simulate_batch(
        probes, poses, display=displays, tissues=tables, settings=settings, outputs=simulated or ["image"],
        noise_seed=noise,
    )  # fmt: skip
    more: dict[str, list[np.ndarray]] = {name: [] for name in wanted if name not in SIMULATED}
    grids = [ImageGrid.for_probe(probe, shown.image_size) for probe, shown in zip(probes, displays, strict=True)]
    for place, (probe, grid, pose, table) in enumerate(zip(probes, grids, poses, tables, strict=True)):
        if {"attenuation", "travel_time"} & set(more):
            both = attenuation_and_time(made.simulator.medium.labels, table, probe, grid, pose)
            for name, values in zip(("attenuation", "travel_time"), both, strict=True):
                more.get(name, []).append(values)
        if "walls" in more:
            more["walls"].append(walls(found["labels"][place], table, probe, grid))
        if "mri" in more:
            assert made.mri is not None
            more["mri"].append(slice_under_probe(made.mri, grid, pose))
        if "clean" in more:
            number = numbers[order[place]]
            more["clean"].append(
                _clean(made, number, probe, pose, displays[place], table, settings[place], recipe.settings.looks)
            )
    number_of = np.array([CLASSES.index(n) if n in CLASSES else OTHER for n in ("coupling", *made.names)], np.uint8)
    arrays = {
        name: number_of[found[name]] if name.startswith("labels") else found[name]
        for name in simulated if name in wanted
    }  # fmt: skip
    arrays |= {name: np.stack(values) for name, values in more.items()}
    arrays["pose"] = np.stack(poses).astype(np.float32)
    arrays["image_to_probe"] = np.stack([grid.image_to_probe for grid in grids]).astype(np.float32)
    back = np.argsort(order)
    arrays = {name: values[back] for name, values in arrays.items()}
    return arrays, [{"image": number, **values} for number, values in zip(numbers, parameters, strict=True)]


def _clean(
    made: Scene, number: int, probe: Probe, pose: np.ndarray, display: DisplaySettings, table: TissueTable,
    settings: SimulationSettings, looks: int,
) -> np.ndarray:  # fmt: skip
    """(rows, columns) uint8 mean of images with other speckle and noise."""
    seeds = generator(made.recipe.settings.seed, number, "looks").integers(0, 2**32, looks)
    many = made.simulator.simulate_batch(
        probe, [pose] * looks, display=display, tissues=table,
        settings=[replace(settings, seed=int(seed)) for seed in seeds], noise_seed=[int(seed) for seed in seeds],
    )  # fmt: skip
    return np.rint(many["image"].mean(axis=0)).astype(np.uint8)


def attenuation_and_time(
    labels: Volume, tissues: TissueTable, probe: Probe, grid: ImageGrid, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """((rows, columns) float32 dB one way at the received frequency, µs there and back), nan outside the imaged field.

    Along straight scan lines from the face, in steps of 0.5 mm: without refraction.
    """
    position, along = probe.line_positions(), np.arange(0.0, probe.displayed_mm, _STEP_MM)
    origin, direction = probe.line_at(position)
    matrix = (labels.ras_to_ijk @ pose).astype(np.float32)
    points = (origin[:, None] + along[:, None] * direction[:, None]).astype(np.float32)
    index = np.rint(points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.intp)[..., ::-1]
    inside = np.all((index >= 0) & (index < labels.array.shape), axis=-1)
    found = np.where(inside, labels.array[tuple(np.moveaxis(np.where(inside[..., None], index, 0), -1, 0))], 0)
    attenuation, slowness = np.zeros((2, 256), np.float32)
    for label, tissue in tissues.items():
        attenuation[label] = 0.1 * tissue.attenuation_db_cm_mhz * probe.received_mhz
        slowness[label] = 2e3 / tissue.speed_of_sound_m_s
    step = _STEP_MM * (along >= probe.line_starts_mm(position)[:, None])
    field, line, at = _nearest_steps(probe, grid, len(along))
    sums = (np.cumsum(values[found] * step, axis=1) for values in (attenuation, slowness))
    decibels, microseconds = (np.where(field, each[line, at], np.nan).astype(np.float32) for each in sums)
    return decibels, microseconds


@lru_cache(maxsize=4)
def _nearest_steps(probe: Probe, grid: ImageGrid, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(rows, columns) the imaged field, and the scan line and step nearest to a pixel."""
    (x, y), (dx, dy) = (grid.left_mm, grid.top_mm), grid.pixel_spacing_mm
    columns, rows = np.meshgrid(np.arange(grid.columns) + 0.5, np.arange(grid.rows) + 0.5)
    position, along = probe.line_through(x + dx * columns, y + dy * rows)
    line = np.rint((position - probe.first_line) / probe.line_spacing).astype(int)
    at = np.rint(np.nan_to_num(along) / _STEP_MM).astype(int)
    return grid.field(probe), np.clip(line, 0, probe.scan_lines - 1), np.clip(at, 0, steps - 1)


def walls(labels: np.ndarray, tissues: TissueTable, probe: Probe, grid: ImageGrid) -> np.ndarray:
    """(rows, columns) float32 largest amplitude reflection coefficient of the borders below and right of a pixel.

    `labels` are those of the image's pixels, (rows, columns); 0 outside the imaged field.
    """
    impedance = np.ones(256, np.float32)
    for label, tissue in tissues.items():
        impedance[label] = tissue.impedance_mrayl
    here, field = impedance[labels], grid.field(probe)
    found = np.zeros(labels.shape, np.float32)
    for axis in (0, 1):
        first, second = (np.moveaxis(here, axis, 0)[part] for part in (slice(-1), slice(1, None)))
        both = np.moveaxis(field, axis, 0)[:-1] & np.moveaxis(field, axis, 0)[1:]
        border = np.moveaxis(found, axis, 0)[:-1]
        np.maximum(border, np.where(both, abs(first - second) / (first + second), 0.0), out=border)
    return found
