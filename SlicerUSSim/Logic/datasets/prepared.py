"""Prepared patients: segmented once, cut to what is labelled, and kept beside the set for all workers."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError, about_other_file, require
from SlicerUSSim.Logic.base.files import make_folder, written_whole
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.datasets.recipe import BUNDLED, PatientSettings, Recipe
from SlicerUSSim.Logic.mri.masks import read_mask
from SlicerUSSim.Logic.mri.modality import segment_image
from SlicerUSSim.Logic.mri.pathology import add_tissues, texture_below
from SlicerUSSim.Logic.mri.refinement import on_grid
from SlicerUSSim.Logic.mri.samples import demo_mri, head_mri
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.regions import ventricles
from SlicerUSSim.Logic.placement.views import view_pose
from SlicerUSSim.Logic.tissue.label_sources import is_label_file, read_label_file
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture

VENTRICLE = "ventricle"
#: Names of the labels in all sets: the label is the place; and that of a tissue which is none of them
CLASSES, OTHER = (*TISSUES, VENTRICLE), 255
#: Around what is labelled
_MARGIN_MM = 5.0


class PatientError(SimulationError):
    """What a patient has not: its images are left out, and those of the others are made."""


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
    try:
        with about_other_file(recipe.patients[patient].file):
            found = _prepared(recipe, recipe.patients[patient])
    except SimulationError as error:
        raise PatientError(str(error)) from None
    path = prepared_path(out, patient)
    make_folder(path.parent)
    with written_whole(path) as partial, partial.open("wb") as file:
        pickle.dump(found, file, protocol=pickle.HIGHEST_PROTOCOL)


def load(out: Path, patient: int) -> PreparedPatient:
    """The patient that prepare() wrote, in a set that this user made."""
    with prepared_path(out, patient).open("rb") as file:
        return pickle.load(file)


def _prepared(recipe: Recipe, chosen: PatientSettings) -> PreparedPatient:
    texture, mri, path, warnings = None, None, recipe.folder / chosen.file, ()
    is_file = chosen.file not in BUNDLED
    image = Volume.read(path) if is_file else demo_mri()[0] if chosen.file == BUNDLED[0] else head_mri()
    if is_file and is_label_file(path, image):
        require(not chosen.ventricles, "is a label map; ventricles are looked for in an MRI")
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
    require(isinstance(segmentation, Segmentation), "is a CT; ventricles are looked for in an MRI")
    assert isinstance(segmentation, Segmentation) and tissues.membrane is not None
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
