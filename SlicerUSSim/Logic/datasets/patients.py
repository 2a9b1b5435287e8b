"""Patients: segmented once and kept beside the set, and the scenes that workers build of them: the simulator of a
patient, with a lesion or none, and where probes stand on it."""

from __future__ import annotations

import gc
import pickle
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError, about_other_file, require
from SlicerUSSim.Logic.base.files import make_folder, written_whole
from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.datasets.draws import generator
from SlicerUSSim.Logic.datasets.recipe import ALL, BUNDLED, VENTRICLE, Case, PatientSettings, Recipe
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.mri.markups import markup_points
from SlicerUSSim.Logic.mri.masks import read_mask
from SlicerUSSim.Logic.mri.modality import segment_image
from SlicerUSSim.Logic.mri.pathology import Added, add_tissues, innermost_ras, texture_below
from SlicerUSSim.Logic.mri.refinement import on_grid
from SlicerUSSim.Logic.mri.samples import demo_mri, head_mri
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.mri.segmentation_settings import GEL_MM
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.regions import ventricles
from SlicerUSSim.Logic.placement.craniotomy import default_pose, disc_diameter_mm, disc_opening, opened, without_outside
from SlicerUSSim.Logic.placement.views import view_pose
from SlicerUSSim.Logic.probe.poses import aimed_at, turned
from SlicerUSSim.Logic.probe.surface import PatientSurface
from SlicerUSSim.Logic.tissue.label_sources import is_label_file, read_label_file
from SlicerUSSim.Logic.tissue.names import OUTSIDE, labels_of
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

#: Around what is labelled
_MARGIN_MM = 5.0
#: Wider than the probe's face is an opening, in which poses differ, mm
_WIDER_MM = 30.0
#: Tissues in which the middle of a lesion may be, steps of the search, and distance from the wanted depth, mm
_WITHIN, _COARSE_MM, _SHELL_MM = ("grey matter", "white matter", "brain"), 2.0, 1.5
#: The scene of this process, by recipe, folder and case
_kept: dict[tuple, Scene] = {}


class PatientError(SimulationError):
    """What a patient has not: its images are left out, and those of the others are made."""


@contextmanager
def about_patient(recipe: Recipe, number: int) -> Iterator[None]:
    """Within the block a SimulationError becomes a PatientError, which names the file."""
    try:
        with about_other_file(recipe.patients[number].file):
            yield
    except SimulationError as error:
        raise PatientError(str(error)) from None


@dataclass(frozen=True, eq=False)
class PreparedPatient:
    """What images of a patient are made of."""

    labels: Volume
    #: Names of labels 1, 2, ...
    names: tuple[str, ...]
    tissues: TissueTable
    texture: Texture | None
    #: The MRI or CT on the grid of the labels, float32; None for a label map, or if no output shows it
    mri: Volume | None
    #: {name: (4, 4) probe_to_ras} of the standard views of the recipe, which would take workers 1 GB
    views: dict[str, np.ndarray]
    #: What a user should check
    warnings: tuple[str, ...]


def prepared_path(out: Path, patient: int) -> Path:
    """The file of a prepared patient of a set."""
    return out / "patients" / f"{patient:04d}.pickle"


def prepare(recipe: Recipe, patient: int, out: Path) -> None:
    """Write what images of a patient are made of.

    Raises PatientError, which names the file, if it cannot be read or segmented.
    """
    with about_patient(recipe, patient):
        found = _prepared(recipe, recipe.patients[patient])
    path = prepared_path(out, patient)
    make_folder(path.parent)
    with written_whole(path) as partial, partial.open("wb") as file:
        pickle.dump(found, file, protocol=pickle.HIGHEST_PROTOCOL)


def _prepared(recipe: Recipe, chosen: PatientSettings) -> PreparedPatient:
    texture, mri, path, warnings = None, None, recipe.folder / chosen.file, ()
    is_file = chosen.file not in BUNDLED
    image = Volume.read(path) if is_file else demo_mri()[0] if chosen.file == BUNDLED[0] else head_mri()
    if is_file and is_label_file(path, image):
        has_labels = not chosen.ventricles and "mri" not in recipe.settings.outputs
        require(has_labels, "is a label map; ventricles, and the output mri, are of an MRI")
        found = read_label_file(path, image)
        labels, names, tissues = found.labels, found.tissues.names_by_label(), found.tissues
    else:
        made = segment_image(image, chosen.segmentation)
        labels, names, mri, texture, warnings = made.labels, made.tissue_names, image, made.texture(), made.warnings
        tissues = TissueTable.brain(names)
        if chosen.ventricles:
            labels, names, tissues = with_ventricles(image, made, chosen.segmentation.contrast, tissues)
    masks = [(tissue, read_mask(str(recipe.folder / file)), file) for tissue, file in chosen.add.items()]
    if masks:
        added = add_tissues(labels, names, masks, has_brain_mask=mri is not None)
        texture = None if texture is None else texture_below(texture, image, labels, added.labels)
        labels, names, tissues = added.labels, added.tissue_names, added.table(tissues)
        warnings += added.warnings
    part = _cut(labels)
    texture = None if texture is None else texture.on_grid_of(part, labels)
    if mri is not None:
        is_shown = "mri" in recipe.settings.outputs
        mri = part.with_array(on_grid(mri.with_array(mri.array.astype(np.float32)), part)) if is_shown else None
    views: dict[str, np.ndarray] = {
        name: view_pose(part, names, name)[0] for name in recipe.draws["pose"]["view"].values
        if recipe.fixed("pose", "on") == "view"
    }  # fmt: skip
    return PreparedPatient(part, tuple(names), tissues, texture, mri, views, warnings)


def with_ventricles(
    image: Volume, segmentation: object, contrast: str, tissues: TissueTable
) -> tuple[Volume, tuple[str, ...], TissueTable]:
    """(labels, their names, their tissues) with one more label: CSF in the ventricles, whose walls are membranes.

    Raises SimulationError for a CT, a FLAIR, and where there are none.
    """
    if not isinstance(segmentation, Segmentation) or tissues.membrane is None:
        raise SimulationError("is a CT; ventricles can be found in an MRI only")
    head = Head.of(image, segmentation, contrast)
    labels, names = segmentation.labels, (*segmentation.tissue_names, VENTRICLE)
    inside = on_grid(head.image.with_array(ventricles(head).astype(np.float32)), labels) > 0.5
    inside &= labels.array == names.index("csf") + 1
    require(bool(inside.any()), "no ventricles are found")
    labels = labels.with_array(np.where(inside, len(names), labels.array).astype(np.uint8))
    membrane = replace(tissues.membrane, fluids=(*tissues.membrane.fluids, VENTRICLE))
    return labels, names, TissueTable({**tissues, len(names): replace(TISSUES["csf"], name=VENTRICLE)}, membrane)


def _cut(labels: Volume) -> Volume:
    """The part of labels that is labelled."""
    boxes = ndimage.find_objects((labels.array > 0).astype(np.uint8))
    require(bool(boxes), "has no labels, expected a patient")
    margin = np.ceil(_MARGIN_MM / np.asarray(labels.spacing_mm)[::-1]).astype(int)
    box = tuple(slice(max(part.start - m, 0), part.stop + m) for part, m in zip(boxes[0], margin, strict=True))
    matrix = labels.ijk_to_ras.copy()
    matrix[:3, 3] = (matrix @ [*(part.start for part in box[::-1]), 1.0])[:3]
    return Volume(np.ascontiguousarray(labels.array[box]), matrix)


class Scene:
    """The simulator of a case, and where probes stand on it. Raises SimulationError if they cannot."""

    def __init__(self, recipe: Recipe, out: Path, case: Case) -> None:
        with prepared_path(out, case.patient).open("rb") as file:
            patient: PreparedPatient = pickle.load(file)  # in a set that this user made
        labels, names, texture = patient.labels, patient.names, patient.texture
        self.recipe, self.case, self.mri, self.warnings = recipe, case, patient.mri, patient.warnings
        self._views, self._tissues = patient.views, patient.tissues
        del patient  # so that what is not needed goes
        drawn = recipe.drawn(case.image)
        #: Those of an image are drawn over them
        self.settings = replace(SimulationSettings(), **drawn["settings"])
        if recipe.lesions:
            random = generator(recipe.settings.seed, case.number, "lesion shape")
            added = with_lesion(labels, names, drawn["lesions"], random)
            for certain in (texture.second_share, texture.deviation, texture.volume_share) if texture else ():
                if certain is not None:
                    certain[added.labels.array != labels.array] = 0
            labels, names, self._tissues = added.labels, added.tissue_names, added.table(self._tissues)
        self.names, self._on, aim = names, recipe.fixed("pose", "on"), recipe.fixed("pose", "aim")
        is_open = self._on == "craniotomy" and "skin" in names
        self.surface = PatientSurface(without_outside(labels, names) if is_open else labels)
        self.target = _innermost(labels, names, aim) if aim else None
        self.start = default_pose(labels, names, recipe.probes[0], is_open=is_open, target_ras=self.target)
        if is_open:
            opening = disc_opening(labels, names, self.start, disc_diameter_mm(recipe.probes[0]) + _WIDER_MM)
            labels = opened(labels, names, opening)[0]
        if "skin" in names and not is_open and "contact_gap_mm" not in drawn["settings"]:
            self.settings = replace(self.settings, contact_gap_mm=GEL_MM)
        self.simulator = UltrasoundSimulator(labels, self._tissues, self.settings, None, texture)
        self.simulator.texture = None  # the device has it, and nobody pickles this simulator
        self._poses = self._listed() if recipe.fixed("pose", "file") else []
        self._places = self._surface_places() if self._on == "surface" else np.zeros((0, 3))

    def pose(self, image: int, drawn: Mapping[str, Any]) -> np.ndarray:
        """(4, 4) probe_to_ras of an image by what is drawn for `[pose]`."""
        right, front, *turns = (drawn[f"{name}_deg"] for name in ("right", "front", "rock", "tilt", "rotate"))
        pose = self.start
        if self._poses:
            pose = self._poses[(image - self.case.image) % len(self._poses)]
        elif self._on == "view":
            pose = self._views[drawn["view"]]
        elif self._on == "surface":
            random = generator(self.recipe.settings.seed, image, "place")
            pose = self.surface.slid(pose, self._places[int(random.integers(len(self._places)))])
        if right or front:
            old = self.surface.angles(self.surface.nearest(pose[:3, 3]))
            point = self.surface.at(old[0] + right, old[1] + front)
            pose = self.surface.slid(pose, point, upright=self._on != "view")
        if self.target is not None:
            pose = aimed_at(pose, self.target)
        pose = turned(pose, rock_deg=turns[0], tilt_deg=turns[1], rotate_deg=turns[2])
        pose[:3, 3] -= drawn["lift_mm"] * pose[:3, 1]
        return pose.astype(np.float32).astype(float)  # as it is written

    def tissues(self, image: int) -> tuple[TissueTable, dict[str, dict[str, float]]]:
        """(tissues of an image, {tissue: {name: value}} of what was drawn).

        Of `all`, each tissue with scatterers is drawn by itself; a tissue's own table comes before it.
        """
        table, found, seed = self._tissues, {}, self.recipe.settings.seed
        for tissue in self._tissues.all_tissues():
            of_all = self.recipe.tissues.get(ALL, {}) if tissue.scatterer_variance > 0.0 else {}
            changes = {
                name: draw(generator(seed, image, f"{tissue.name}.{name}"), getattr(tissue, name))
                for name, draw in {**of_all, **self.recipe.tissues.get(tissue.name, {})}.items()
            }
            if changes:
                table, found[tissue.name] = table.replace(tissue.name, **changes), changes
        return table, found

    def _surface_places(self) -> np.ndarray:
        from vtkmodules.util.numpy_support import vtk_to_numpy

        points = vtk_to_numpy(self.surface.polydata.GetPoints().GetData()).astype(float)
        x, y, z = (points - self.surface.centre).T
        within = self.recipe.fixed("pose", "within_deg")
        kept = points[np.degrees(np.arctan2(np.hypot(x, y), z)) <= within]
        require(len(kept) > 0, f"[pose] within_deg is {within:g}, and the surface has no point so near to its top")
        return kept

    def _listed(self) -> list[np.ndarray]:
        file, transform = (self.recipe.fixed("pose", name) for name in ("file", "transform"))
        path = str(self.recipe.folder / file)
        if self._on == "path":
            kinds = ("Curve", "ClosedCurve", "Line", "Fiducial")
            return self.surface.along(markup_points(path, kinds, "a curve")[1])
        sequence = TrackedSequence.read(path)
        kept = [number for number in range(len(sequence)) if sequence.has_pose(number, transform)]
        require(kept, f"{path}: no image has {transform}; it has {', '.join(sequence.frames_of_reference())}")
        return [check_rigid(transform, sequence.pose(number, transform)) for number in kept]


def scene(recipe: Recipe, out: Path, case: Case) -> Scene:
    """The scene of a case; the last one is kept. Raises PatientError if a patient has not what the recipe wants."""
    key = (recipe.text, str(out), case.number)
    if key not in _kept:
        _kept.clear()
        gc.collect()  # its memory goes before the next one is built
        with about_patient(recipe, case.patient):
            _kept[key] = Scene(recipe, out, case)
    return _kept[key]


def _innermost(labels: Volume, names: tuple[str, ...], tissue: str) -> np.ndarray:
    inside = np.equal(labels.array, names.index(tissue) + 1 if tissue in names else 255)
    boxes = ndimage.find_objects(inside.astype(np.uint8))
    require(bool(boxes), f"[pose] aim is {tissue!r}, which is not labelled, expected one of {', '.join(names)}")
    return innermost_ras(inside[boxes[0]], labels, [part.start for part in boxes[0]])


def with_lesion(labels: Volume, names: Sequence[str], drawn: Mapping[str, Any], random: np.random.Generator) -> Added:
    """Labels 1, 2, ... called `names` with a lesion at a random place of the drawn depth.

    `drawn` are values of LesionSettings. Raises SimulationError if the brain has no place that deep.
    """
    spacing = np.asarray(labels.spacing_mm)[::-1]
    step = np.maximum(np.rint(_COARSE_MM / spacing), 1).astype(int)
    coarse = tuple(slice(None, None, n) for n in step)
    # Of parts of the volume, since what is computed of all of it takes 300 MB
    outside = [0, *labels_of(names, OUTSIDE)]
    brain = ~np.isin(labels.array[coarse], outside)
    # By scipy, since SimpleITK takes 100 MB of a worker
    depth = np.asarray(ndimage.distance_transform_edt(np.pad(brain, 1), step * spacing))[1:-1, 1:-1, 1:-1]
    where = np.isin(labels.array[coarse], labels_of(names, _WITHIN)) & (abs(depth - drawn["depth_mm"]) <= _SHELL_MM)
    places = np.flatnonzero(where)
    require(
        places.size > 0,
        f"[lesions] depth_mm is {drawn['depth_mm']:g}, and the brain has no tissue so deep, expected at most "
        f"{depth.max():.0f}",
    )
    middle = step * np.array(np.unravel_index(int(places[random.integers(places.size)]), where.shape))
    reach = np.ceil(drawn["radius_mm"] * 2.5 / spacing).astype(int)
    low, high = np.maximum(middle - reach, 0), np.minimum(middle + reach + 1, labels.array.shape)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    away = np.linalg.norm((np.moveaxis(np.mgrid[box], 0, -1) - middle) * spacing, axis=-1)
    rough = ndimage.gaussian_filter(random.normal(size=away.shape), 0.5 * drawn["radius_mm"] / spacing)
    radius = drawn["radius_mm"] * np.clip(1.0 + drawn["roughness"] * rough / rough.std(), 0.3, 2.4)
    names = (*names, *({drawn["tissue"]} - set(names)))
    array = labels.array.copy()
    array[box][(away <= radius) & ~np.isin(array[box], outside)] = names.index(drawn["tissue"]) + 1
    return Added(labels.with_array(array), names)
