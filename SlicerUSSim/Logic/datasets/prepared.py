"""Prepared patients: segmented once, cut to what is labelled, and kept beside the set for all workers."""

from __future__ import annotations

import hashlib
import pickle
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import make_folder, written_whole
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.datasets.recipe import BUNDLED, Recipe
from SlicerUSSim.Logic.mri.masks import read_mask
from SlicerUSSim.Logic.mri.modality import segment_image
from SlicerUSSim.Logic.mri.pathology import add_tissues, texture_below
from SlicerUSSim.Logic.mri.samples import demo_mri, head_mri
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.regions import ventricles
from SlicerUSSim.Logic.tissue.label_sources import is_label_file, read_label_file
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture

VENTRICLE = "ventricle"
#: Names of the labels in all sets; the label is the place, and the last one is any other tissue
CLASSES = (*TISSUES, VENTRICLE)
OTHER = 255
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
    #: SHA-256 of its file; "" for one that is bundled
    digest: str


def prepared_path(out: Path, patient: int) -> Path:
    """The file of a prepared patient of a set."""
    return out / "patients" / f"{patient:04d}.pickle"


def prepare(recipe: Recipe, patient: int, out: Path, device: str | None = None) -> None:
    """Write what images of a patient are made of, unless it is there.

    Raises PatientError, which names the file, if it cannot be read or segmented.
    """
    path = prepared_path(out, patient)
    if path.exists():
        return
    try:
        found = _prepared(recipe, patient, device)
    except SimulationError as error:
        name = recipe.patients[patient].file
        raise PatientError(str(error) if name in str(error) else f"{name}: {error}") from None
    make_folder(path.parent)
    with written_whole(path) as partial:
        partial.write_bytes(pickle.dumps(found, protocol=pickle.HIGHEST_PROTOCOL))


def load(out: Path, patient: int) -> PreparedPatient:
    """The patient that prepare() wrote, in a set that this user made."""
    return pickle.loads(prepared_path(out, patient).read_bytes())


def _prepared(recipe: Recipe, number: int, device: str | None) -> PreparedPatient:
    chosen = recipe.patients[number]
    digest, texture, path = "", None, recipe.folder / chosen.file
    if chosen.file in BUNDLED:
        image = demo_mri()[0] if chosen.file == BUNDLED[0] else head_mri()
    else:
        image = Volume.read(path)
        digest = file_digest(path) if path.is_file() else ""
    if chosen.file not in BUNDLED and is_label_file(path, image):
        require(not chosen.ventricles, "is a label map; ventricles are looked for in an MRI")
        found = read_label_file(path, image)
        labels, names, tissues, mri = found.labels, found.names, found.tissues, None
    else:
        segmentation = segment_image(image, recipe.segmentations[number], device=device)
        labels, names, mri = segmentation.labels, segmentation.tissue_names, image
        if chosen.ventricles:
            labels, names = with_ventricles(image, segmentation, recipe.segmentations[number].contrast)
        texture = segmentation.texture()
        tissues = TissueTable.brain([name for name in names if name != VENTRICLE])
        if chosen.ventricles:  # their walls are membranes, as those of other CSF
            csf = replace(TISSUES["csf"], name=VENTRICLE)
            assert tissues.membrane is not None
            membrane = replace(tissues.membrane, fluids=(*tissues.membrane.fluids, VENTRICLE))
            tissues = TissueTable({**tissues, len(names): csf}, membrane)
    masks = [_mask(text, recipe.folder) for text in chosen.add]
    if masks:
        added = add_tissues(labels, names, masks, has_brain_mask=mri is not None)
        texture = None if texture is None else texture_below(texture, image, labels, added.labels)
        labels, names, tissues = added.labels, added.tissue_names, added.table(tissues)
    whole = labels
    labels = _cut(labels)
    texture = None if texture is None else texture.on_grid_of(labels, whole)
    shown = mri is not None and "mri" in recipe.settings.outputs
    mri = _on_grid(mri, labels) if shown and mri is not None else None
    return PreparedPatient(labels, tuple(names), tissues, texture, mri, digest)


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        found = hashlib.sha256()
        while block := file.read(2**20):
            found.update(block)
    return found.hexdigest()


def with_ventricles(image: Volume, segmentation, contrast: str) -> tuple[Volume, tuple[str, ...]]:
    """(labels, their names) with one more label: CSF in the ventricles.

    Raises SimulationError for a CT, a FLAIR, and where the atlas did not lead.
    """
    require(isinstance(segmentation, Segmentation), "is a CT; ventricles are looked for in an MRI")
    head = Head.of(image, segmentation, contrast)
    labels, names = segmentation.labels, segmentation.tissue_names
    inside = _sampled(head.image.with_array(ventricles(head).astype(np.uint8)), labels, order=0) > 0
    inside &= labels.array == names.index("csf") + 1
    require(bool(inside.any()), "no ventricles are found")
    return labels.with_array(np.where(inside, len(names) + 1, labels.array).astype(np.uint8)), (*names, VENTRICLE)


def _mask(text: str, folder: Path) -> tuple[str, Volume, str]:
    tissue, equals, name = text.partition("=")
    require(bool(equals), f"add is {text!r}, expected TISSUE=FILE, such as tumour=mask.nii.gz")
    return tissue.strip(), read_mask(str(folder / name)), name


def _cut(labels: Volume) -> Volume:
    """The part of labels that is labelled."""
    require(bool((labels.array > 0).any()), "has no labels, expected a patient")
    margin = np.ceil(_MARGIN_MM / np.asarray(labels.spacing_mm)[::-1]).astype(int)
    box = []
    for axis in range(3):
        along = np.flatnonzero((labels.array > 0).any(axis=tuple({0, 1, 2} - {axis})))
        box.append(slice(max(along[0] - margin[axis], 0), along[-1] + 1 + margin[axis]))
    matrix = labels.ijk_to_ras.copy()
    matrix[:3, 3] = (matrix @ [*(part.start for part in box[::-1]), 1.0])[:3]
    return Volume(np.ascontiguousarray(labels.array[tuple(box)]), matrix)


def _sampled(volume: Volume, grid: Volume, order: int) -> np.ndarray:
    """(k, j, i) values of a volume at the voxels of a grid."""
    from scipy import ndimage

    to_ijk = (volume.ras_to_ijk @ grid.ijk_to_ras)[[2, 1, 0, 3]][:, [2, 1, 0, 3]]
    return ndimage.affine_transform(volume.array, to_ijk, output_shape=grid.array.shape, order=order, cval=0)


def _on_grid(volume: Volume, grid: Volume) -> Volume:
    return grid.with_array(_sampled(volume.with_array(volume.array.astype(np.float32)), grid, order=1))
