"""Images of a shard: one simulator per worker, kept while patient and lesion are the same."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from vtkmodules.util.numpy_support import vtk_to_numpy

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.datasets.draws import generator
from SlicerUSSim.Logic.datasets.laid_lesions import with_lesion
from SlicerUSSim.Logic.datasets.pixel_maps import attenuation_and_time, walls
from SlicerUSSim.Logic.datasets.prepared import CLASSES, OTHER, PatientError, PreparedPatient, load
from SlicerUSSim.Logic.datasets.recipe import ALL, SECTIONS, Case, Recipe
from SlicerUSSim.Logic.imaging.batch import OUTPUTS as SIMULATED
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.mri.markups import markup_points
from SlicerUSSim.Logic.mri.pathology import innermost_ras, texture_below
from SlicerUSSim.Logic.mri.segmentation_settings import GEL_MM
from SlicerUSSim.Logic.placement.craniotomy import default_pose, disc_diameter_mm, disc_opening, opened, without_outside
from SlicerUSSim.Logic.placement.views import view_pose
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import aimed_at, slice_under_probe, turned
from SlicerUSSim.Logic.probe.surface import PatientSurface
from SlicerUSSim.Logic.tissue.names import labels_of
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

#: Wider than the probe's face is an opening, in which poses differ, mm
_WIDER_MM = 30.0
#: Kinds of markups that are paths
_PATHS = ("Curve", "ClosedCurve", "Line", "Fiducial")


class Scene:
    """The simulator of a case, and where probes stand on it. Raises SimulationError if they cannot."""

    def __init__(self, recipe: Recipe, out: Path, case: Case) -> None:
        patient = _patient(str(out), case.patient)
        labels, names, tissues, texture = patient.labels, patient.names, patient.tissues, patient.texture
        self.recipe, self.case, self.mri = recipe, case, patient.mri
        shown = patient.mri is not None or "mri" not in recipe.settings.outputs
        require(shown, "is a label map, and the output mri needs an MRI or CT")
        if recipe.lesions:
            random = generator(recipe.settings.seed, case.number, "lesion shape")
            added = with_lesion(labels, names, recipe.lesion(case), random)
            if texture is not None:
                texture = texture_below(texture, labels, labels, added.labels)
            labels, names, tissues = added.labels, added.tissue_names, added.table(tissues)
        chosen, self.names = recipe.pose, names
        is_open = chosen.on == "craniotomy" and "skin" in names
        self.surface = _surface(str(out), case.patient, is_open)
        self.target = _innermost(labels, names, chosen.aim) if chosen.aim else None
        self.start = default_pose(labels, names, recipe.probes[0], is_open=is_open, target_ras=self.target)
        if is_open:
            opening = disc_opening(labels, names, self.start, disc_diameter_mm(recipe.probes[0]) + _WIDER_MM)
            labels = opened(labels, names, opening)[0]
        self._labels, self._views = labels, {}
        fixed = recipe.drawn(0)
        settings = _section(SimulationSettings(), fixed, "settings")
        if "skin" in names and not is_open and "settings.contact_gap_mm" not in fixed:
            settings = replace(settings, contact_gap_mm=GEL_MM)
        self.simulator = UltrasoundSimulator(labels, tissues, settings, None, texture)
        self._settings, self._tissues = settings, tissues
        self._poses = self._listed() if chosen.file else []
        self._places = self._surface_places() if chosen.on == "surface" else np.zeros((0, 3))

    def pose(self, image: int, drawn: Mapping[str, Any]) -> np.ndarray:
        """(4, 4) probe_to_ras of an image."""
        right, front, rock, tilt, rotate = (
            drawn[f"pose.{name}_deg"] for name in ("right", "front", "rock", "tilt", "rotate")
        )
        chosen, pose = self.recipe.pose, self.start
        if self._poses:
            pose = self._poses[(image - self.case.first * self.recipe.shard) % len(self._poses)]
        elif chosen.on == "view":
            pose = self._view(drawn["pose.view"])
        elif chosen.on == "surface":
            random = generator(self.recipe.settings.seed, image, "place")
            pose = self.surface.slid(pose, self._places[int(random.integers(len(self._places)))])
        if right or front:
            old = self.surface.angles(self.surface.nearest(pose[:3, 3]))
            point = self.surface.at(old[0] + right, old[1] + front)
            pose = self.surface.slid(pose, point, upright=chosen.on != "view")
        if self.target is not None:
            pose = aimed_at(pose, self.target)
        pose = turned(pose, rock_deg=rock, tilt_deg=tilt, rotate_deg=rotate)
        pose[:3, 3] -= drawn["pose.lift_mm"] * pose[:3, 1]
        return pose.astype(np.float32).astype(float)  # as it is written

    def settings(self, drawn: Mapping[str, Any]) -> SimulationSettings:
        """The simulation's settings of an image."""
        return _section(self._settings, drawn, "settings")

    def tissues(self, image: int) -> tuple[TissueTable, dict[str, float]]:
        """(tissues of an image, {"white matter.mu0": value} of what was drawn).

        Of `all`, each tissue with scatterers is drawn by itself; a tissue's own table comes before it.
        """
        changes: dict[str, dict[str, float]] = {}
        draws = sorted(self.recipe.draws.items(), key=lambda item: not item[0].startswith(f"{ALL}."))
        own = {tissue.name: tissue for tissue in self._tissues.all_tissues()}
        for key, draw in draws:
            owner, _, name = key.rpartition(".")
            for tissue in own.values() if owner not in SECTIONS else ():
                if owner == tissue.name or (owner == ALL and tissue.scatterer_variance > 0.0):
                    value = draw(generator(self.recipe.settings.seed, image, f"{tissue.name}.{name}"))
                    factor = getattr(tissue, name) if draw.relative else 1.0
                    changes.setdefault(tissue.name, {})[name] = draw.cut(value * factor)
        table = self._tissues
        for tissue, values in changes.items():
            table = table.replace(tissue, **values)
        return table, {f"{tissue}.{name}": one for tissue, values in changes.items() for name, one in values.items()}

    def _surface_places(self) -> np.ndarray:
        points = vtk_to_numpy(self.surface.polydata.GetPoints().GetData()).astype(float)
        x, y, z = (points - self.surface.centre).T
        within = self.recipe.pose.within_deg
        kept = points[np.degrees(np.arctan2(np.hypot(x, y), z)) <= within]
        require(len(kept) > 0, f"[pose] within_deg is {within:g}, and the surface has no point so near to its top")
        return kept

    def _view(self, name: str) -> np.ndarray:
        if name not in self._views:
            self._views[name] = view_pose(self._labels, self.names, name)[0]
        return self._views[name]

    def _listed(self) -> list[np.ndarray]:
        chosen = self.recipe.pose
        path = str(self.recipe.folder / chosen.file)
        if chosen.on == "path":
            return self.surface.along(markup_points(path, _PATHS, "a curve")[1])
        sequence = TrackedSequence.read(path)
        kept = [number for number in range(len(sequence)) if sequence.has_pose(number, chosen.transform)]
        require(kept, f"{path}: no image has {chosen.transform}; it has {', '.join(sequence.frames_of_reference())}")
        return [check_rigid(chosen.transform, sequence.pose(number, chosen.transform)) for number in kept]


def scene(recipe: Recipe, out: Path, case: Case) -> Scene:
    """The scene of a case; the last one is kept. Raises PatientError if a patient has not what the recipe wants."""
    key = (recipe.digest, str(out), case.number)
    found = _kept.get(key)
    if found is None:
        _kept.clear()  # its memory goes before the next one is built
        try:
            found = _kept[key] = Scene(recipe, out, case)
        except SimulationError as error:
            raise PatientError(f"{recipe.patients[case.patient].file}: {error}") from None
    return found


_kept: dict[tuple, Scene] = {}


@lru_cache(maxsize=1)
def _patient(out: str, number: int) -> PreparedPatient:
    return load(Path(out), number)


@lru_cache(maxsize=1)
def _surface(out: str, number: int, is_open: bool) -> PatientSurface:
    patient = _patient(out, number)
    return PatientSurface(without_outside(patient.labels, patient.names) if is_open else patient.labels)


def _innermost(labels: Volume, names: tuple[str, ...], tissue: str) -> np.ndarray:
    inside = np.isin(labels.array, labels_of(names, (tissue,)))
    require(inside.any(), f"[pose] aim is {tissue!r}, which is not labelled, expected one of {', '.join(names)}")
    return innermost_ras(inside, labels)


def _section(settings: Any, drawn: Mapping[str, Any], section: str) -> Any:
    """Settings with the drawn values of a section."""
    values = {key.partition(".")[2]: value for key, value in drawn.items() if key.startswith(f"{section}.")}
    return replace(settings, **values)


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
    displays = [_section(DisplaySettings(), parameters[n], "display") for n in order]
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
    made: Scene, number: int, probe, pose: np.ndarray, display: DisplaySettings, table: TissueTable,
    settings: SimulationSettings, looks: int,
) -> np.ndarray:  # fmt: skip
    """(rows, columns) uint8 mean of images with other speckle and noise."""
    seeds = generator(made.recipe.settings.seed, number, "looks").integers(0, 2**32, looks)
    many = made.simulator.simulate_batch(
        probe, [pose] * looks, display=display, tissues=table,
        settings=[replace(settings, seed=int(seed)) for seed in seeds], noise_seed=[int(seed) for seed in seeds],
    )  # fmt: skip
    return np.rint(many["image"].mean(axis=0)).astype(np.uint8)
