"""Images of a shard, with the maps on their pixels that follow from labels alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.datasets.draws import generator
from SlicerUSSim.Logic.datasets.patients import Scene, scene
from SlicerUSSim.Logic.datasets.recipe import CLASSES, OTHER, Recipe
from SlicerUSSim.Logic.imaging.batch import OUTPUTS as SIMULATED, lines_of_pixels
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import sample, slice_under_probe
from SlicerUSSim.Logic.tissue.table import TissueTable

#: Of the attenuation and travel time along scan lines
_STEP_MM = 0.5
#: Images of which a clean one is the mean
_LOOKS = 16


@dataclass(frozen=True, eq=False)
class Shot:
    """What one image is made of."""

    probe: Probe
    pose: np.ndarray
    display: DisplaySettings
    settings: SimulationSettings
    tissues: TissueTable
    parameters: dict[str, Any]

    @classmethod
    def of(cls, made: Scene, number: int) -> Shot:
        """Image `number` of the set."""
        drawn, (tissues, values) = made.recipe.drawn(number), made.tissues(number)
        return cls(
            made.recipe.probes[drawn["probe"]["number"]], made.pose(number, drawn["pose"]),
            replace(DisplaySettings(), **drawn["display"]), replace(made.settings, **drawn["settings"]), tissues,
            {"image": number, **drawn, "tissues": values},
        )  # fmt: skip

    @property
    def grid(self) -> ImageGrid:
        """Its pixels."""
        return ImageGrid.for_probe(self.probe, self.display.image_size)


def render(recipe: Recipe, out: Path, shard: int) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """({output: array}, the parameters of each image) of a shard, (images, ...) in their order.

    Labels are places in CLASSES, which are the same for all patients. Besides the recipe's outputs there are "pose",
    (4, 4) probe_to_ras, and "image_to_probe", (4, 4) from (column, row, 0, 1) to the probe's millimetres, float32.
    """
    made, wanted = scene(recipe, out, recipe.case_of(shard)), recipe.settings.outputs
    shots = [Shot.of(made, number) for number in recipe.images_of(shard)]
    # Images of one probe follow each other, since its geometry is kept for a few probes alone
    shots.sort(key=lambda shot: shot.parameters["probe"]["number"])
    names = [name for name in SIMULATED if name in wanted or (name == "labels" and "walls" in wanted)]
    numbers = [shot.parameters["image"] for shot in shots]
    arrays = _simulated(made, shots, names or ["image"], numbers)
    labels = arrays.get("labels", [None] * len(shots))
    for name in wanted:
        if name not in SIMULATED:
            arrays[name] = np.stack([_computed(name, made, *both) for both in zip(shots, labels, strict=True)])
    number_of = np.array([CLASSES.index(n) if n in CLASSES else OTHER for n in ("coupling", *made.names)], np.uint8)
    arrays = {name: number_of[arrays[name]] if name.startswith("labels") else arrays[name] for name in wanted}
    arrays["pose"] = np.stack([shot.pose for shot in shots]).astype(np.float32)
    arrays["image_to_probe"] = np.stack([shot.grid.image_to_probe for shot in shots]).astype(np.float32)
    back = np.argsort(numbers)
    return {name: values[back] for name, values in arrays.items()}, [shots[place].parameters for place in back]


def _simulated(made: Scene, shots: list[Shot], outputs: list[str], noise: list[int]) -> dict[str, np.ndarray]:
    """{output: (shots, ...)} of simulate_batch."""
    names = ("probe", "pose", "display", "settings", "tissues")
    probes, poses, display, settings, tissues = ([getattr(shot, name) for shot in shots] for name in names)
    return made.simulator.simulate_batch(
        probes, poses, display=display, settings=settings, tissues=tissues, outputs=outputs, noise_seed=noise
    )


def _computed(name: str, made: Scene, shot: Shot, labels: np.ndarray | None) -> np.ndarray:
    """(rows, columns) of an output that simulate_batch has not; `labels` of the pixels, for "walls"."""
    if name == "mri" and made.mri is not None:
        return slice_under_probe(made.mri, shot.grid, shot.pose)
    if name == "walls" and labels is not None:
        return walls(labels, shot)
    if name == "clean":
        seeds = generator(made.recipe.settings.seed, shot.parameters["image"], "looks").integers(0, 2**32, _LOOKS)
        looks = [replace(shot, settings=replace(shot.settings, seed=int(seed))) for seed in seeds]
        images = _simulated(made, looks, ["image"], seeds.tolist())["image"]
        return np.rint(images.mean(axis=0)).astype(np.uint8)
    return along_lines(name, made.simulator.medium.labels, shot)


def along_lines(name: str, labels: Volume, shot: Shot) -> np.ndarray:
    """(rows, columns) float32 "attenuation", dB one way at the received frequency, or "travel_time", µs there and back.

    nan outside the imaged field. Along straight scan lines from the face, in steps of 0.5 mm: without refraction.
    """
    probe, grid, along = shot.probe, shot.grid, np.arange(0.0, shot.probe.displayed_mm, _STEP_MM)
    origin, direction = probe.origins_mm(), probe.directions()
    points = origin[:, None] + along[:, None] * direction[:, None]
    found = sample(labels, points @ shot.pose[:3, :3].T + shot.pose[:3, 3], order=0)
    per_mm = np.zeros(256, np.float32)
    for label, tissue in shot.tissues.items():
        decibels = 0.1 * tissue.attenuation_db_cm_mhz * probe.received_mhz
        per_mm[label] = decibels if name == "attenuation" else 2e3 / tissue.speed_of_sound_m_s
    step = _STEP_MM * (along >= probe.line_starts_mm(probe.line_positions())[:, None])
    position, away = lines_of_pixels(probe, grid)
    line = np.rint((position - probe.first_line) / probe.line_spacing).clip(0, probe.scan_lines - 1).astype(int)
    at = np.rint(away / _STEP_MM).clip(0, len(along) - 1).astype(int)
    values = np.cumsum(per_mm[found] * step, axis=1)[line, at]
    return np.where(grid.field(probe), values, np.nan).astype(np.float32)


def walls(labels: np.ndarray, shot: Shot) -> np.ndarray:
    """(rows, columns) float32 largest amplitude reflection coefficient of the borders below and right of a pixel.

    `labels` of the image's pixels, (rows, columns); 0 outside the imaged field.
    """
    impedance = np.ones(256, np.float32)
    for label, tissue in shot.tissues.items():
        impedance[label] = tissue.impedance_mrayl
    here = np.where(shot.grid.field(shot.probe), impedance[labels], np.nan)
    found = np.zeros(labels.shape, np.float32)
    for axis in (0, 1):
        values, border = (np.moveaxis(array, axis, 0) for array in (here, found))
        reflected = abs(np.diff(values, axis=0)) / (values[:-1] + values[1:])
        np.fmax(border[:-1], reflected, out=border[:-1])  # nan outside the field is left out
    return found
