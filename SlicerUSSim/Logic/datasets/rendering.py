"""Images of a shard, with the maps on their pixels that follow from labels alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.datasets.draws import generator
from SlicerUSSim.Logic.datasets.placed import Scene, scene, section_of
from SlicerUSSim.Logic.datasets.prepared import CLASSES, OTHER
from SlicerUSSim.Logic.datasets.recipe import Recipe
from SlicerUSSim.Logic.imaging.batch import OUTPUTS as SIMULATED, lines_of_pixels
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
    made, wanted = scene(recipe, out, recipe.case_of(shard)), set(recipe.settings.outputs)
    drawn = [(number, recipe.drawn(number)) for number in recipe.images_of(shard)]
    # Images of one probe follow each other, since its geometry is kept for a few probes alone
    shots = [_Shot.of(made, *one) for one in sorted(drawn, key=lambda one: one[1]["probe"])]
    simulated = [name for name in SIMULATED if name in wanted | ({"labels"} if "walls" in wanted else set())]
    arrays = _simulated(made, shots, simulated or ["image"], [shot.number % 2**32 for shot in shots])
    labels, of_pixels = made.simulator.medium.labels, arrays.get("labels")
    more: dict[str, list[np.ndarray]] = {name: [] for name in recipe.settings.outputs if name not in SIMULATED}
    for place, shot in enumerate(shots):
        for name, values in more.items():
            if name in ("attenuation", "travel_time"):
                values.append(along_lines(name, labels, shot.tissues, shot.probe, shot.grid, shot.pose))
            elif name == "walls" and of_pixels is not None:
                values.append(walls(of_pixels[place], shot.tissues, shot.probe, shot.grid))
            elif name == "mri" and made.mri is not None:
                values.append(slice_under_probe(made.mri, shot.grid, shot.pose))
            elif name == "clean":
                seeds = generator(recipe.settings.seed, shot.number, "looks").integers(0, 2**32, recipe.settings.looks)
                looks = [replace(shot, settings=replace(shot.settings, seed=int(seed))) for seed in seeds]
                images = _simulated(made, looks, ["image"], seeds.tolist())["image"]
                values.append(np.rint(images.mean(axis=0)).astype(np.uint8))
    number_of = np.array([CLASSES.index(n) if n in CLASSES else OTHER for n in ("coupling", *made.names)], np.uint8)
    arrays = {name: number_of[a] if name.startswith("labels") else a for name, a in arrays.items() if name in wanted}
    arrays |= {name: np.stack(values) for name, values in more.items()}
    arrays["pose"] = np.stack([shot.pose for shot in shots]).astype(np.float32)
    arrays["image_to_probe"] = np.stack([shot.grid.image_to_probe for shot in shots]).astype(np.float32)
    back = np.argsort([shot.number for shot in shots])
    return {name: values[back] for name, values in arrays.items()}, [shots[place].parameters for place in back]


@dataclass(frozen=True, eq=False)
class _Shot:
    """What one image is made of."""

    number: int
    probe: Probe
    pose: np.ndarray
    display: DisplaySettings
    settings: SimulationSettings
    tissues: TissueTable
    parameters: dict[str, Any]

    @classmethod
    def of(cls, made: Scene, number: int, drawn: dict[str, Any]) -> _Shot:
        probe, display = made.recipe.probes[drawn["probe"]], section_of(DisplaySettings(), drawn, "display")
        tissues, values = made.tissues(number)
        parameters = {"image": number, **drawn, **made.recipe.drawn_for_many(drawn["probe"], made.case), **values}
        return cls(number, probe, made.pose(number, drawn), display, made.settings(drawn), tissues, parameters)

    @property
    def grid(self) -> ImageGrid:
        return ImageGrid.for_probe(self.probe, self.display.image_size)


def _simulated(made: Scene, shots: list[_Shot], outputs: list[str], noise: list[int]) -> dict[str, np.ndarray]:
    """{output: (shots, ...)} of simulate_batch."""
    given: dict[str, Any] = {
        name: [getattr(shot, name) for shot in shots] for name in ("display", "settings", "tissues")
    }
    probes, poses = [shot.probe for shot in shots], [shot.pose for shot in shots]
    return made.simulator.simulate_batch(probes, poses, outputs=outputs, noise_seed=noise, **given)


def along_lines(
    name: str, labels: Volume, tissues: TissueTable, probe: Probe, grid: ImageGrid, pose: np.ndarray
) -> np.ndarray:
    """(rows, columns) float32 "attenuation", dB one way at the received frequency, or "travel_time", µs there and back.

    nan outside the imaged field. Along straight scan lines from the face, in steps of 0.5 mm: without refraction.
    """
    position, along = probe.line_positions(), np.arange(0.0, probe.displayed_mm, _STEP_MM)
    origin, direction = probe.line_at(position)
    matrix = (labels.ras_to_ijk @ pose).astype(np.float32)
    points = (origin[:, None] + along[:, None] * direction[:, None]).astype(np.float32)
    index = np.rint(points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.intp)[..., ::-1]
    inside = np.all((index >= 0) & (index < labels.array.shape), axis=-1)
    found = np.where(inside, labels.array[tuple(np.moveaxis(np.where(inside[..., None], index, 0), -1, 0))], 0)
    per_mm = np.zeros(256, np.float32)
    for label, tissue in tissues.items():
        decibels = 0.1 * tissue.attenuation_db_cm_mhz * probe.received_mhz
        per_mm[label] = decibels if name == "attenuation" else 2e3 / tissue.speed_of_sound_m_s
    step = _STEP_MM * (along >= probe.line_starts_mm(position)[:, None])
    field, line, at = _nearest_steps(probe, grid, len(along))
    return np.where(field, np.cumsum(per_mm[found] * step, axis=1)[line, at], np.nan).astype(np.float32)


@lru_cache(maxsize=4)
def _nearest_steps(probe: Probe, grid: ImageGrid, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(rows, columns) the imaged field, and the scan line and step nearest to a pixel."""
    position, along = lines_of_pixels(probe, grid)
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
