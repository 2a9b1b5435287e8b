"""Options for the image of a patient, and its segmentation with a progress bar, notes and warnings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from SlicerUSSim.Command.options import declared, declared_parameters, require_no_options_beside_ct
from SlicerUSSim.Command.progress import Share, note
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.mri.segmentation_settings import CT, MRI_CONTRASTS, SegmentationSettings

if TYPE_CHECKING:
    from typing_extensions import Self

    from SlicerUSSim.Logic.base import Volume
    from SlicerUSSim.Logic.mri import CtSegmentation, Segmentation
    from SlicerUSSim.Logic.tissue import LabelledTissues

#: Value of --craniotomy and --sheets
NONE = "none"


@dataclass(frozen=True)
class MriOptions:
    """How the image of a patient is read and segmented, and what is laid over its labels. Files by their paths."""

    #: LABEL=TISSUE, NAME=TISSUE, files and numbering schemes
    maps: tuple[str, ...] = declared(
        "--map", multiple=True, metavar="LABEL=TISSUE",
        help="Tissue of a label of the label map, by its number or its name: 24=csf; 0 removes a label. Or a .json "
        'file with {"24": "csf"}, a table of names (.txt, .ctbl, .tsv), or the numbering: ussim, '
        "ussim-t1gd, spm, synthseg, fastsurfer, fsl-first, freesurfer, totalsegmentator (also -v1, -mr, -tissues), "
        "brats, brats-2022. May be repeated.",
    )  # fmt: skip
    segmentation: SegmentationSettings = declared_parameters(  # noqa: RUF009, a dataclasses.field like the others
        SegmentationSettings
    )
    organs: str | None = declared(
        "--organs", type=click.Path(), help="Label map of organs of a CT, such as TotalSegmentator's, whose "
        "soft tissues replace muscle and blood.",
    )  # fmt: skip
    mask: str | None = declared(
        "--mask", type=click.Path(), help="Brain mask on the MRI's grid (default: found in the MRI); of a CT: the "
        "patient.",
    )  # fmt: skip
    #: CONTRAST=FILE
    also: tuple[str, ...] = declared(
        "--also", multiple=True, metavar="CONTRAST=FILE",
        help="Another MRI of the same patient, on any grid, registered to the first and classified together with it: "
        "t2=FILE, flair=FILE, t1=FILE or t1gd=FILE; may be repeated.",
    )  # fmt: skip
    #: TISSUE=FILE
    additions: tuple[str, ...] = declared(
        "--add", multiple=True, metavar="TISSUE=FILE",
        help="Lay a tissue over the labels where the mask in FILE is not 0 (any grid) or above 0.5: tumour, oedema, "
        "necrosis, cyst, haematoma, cavity or another of the presets; brats=FILE for labels with names, or the "
        "tissues of a BraTS map; may be repeated, the last is on top.",
    )  # fmt: skip
    #: NAME=VALUE
    changes: tuple[str, ...] = declared(
        "--set", multiple=True, metavar="NAME=VALUE",
        help="Any key of a preset (docs/parameters.md), such as settings.max_ray_depth=4, probe.depth_mm=70, "
        '"white matter.mu0=0.5" or segmentation.classes=4; overrides other options; may be repeated.',
    )  # fmt: skip
    device: str | None = declared(
        "--device", help='OpenCL device: "platform:device" or part of its name (see `ussim devices`).'
    )

    @property
    def contrast(self) -> str:
        """Of the image; CT for a CT."""
        return self.segmentation.contrast

    @property
    def is_ct(self) -> bool:
        """Whether the image is a CT."""
        return self.contrast == CT

    def for_image(self, image: Volume) -> Self:
        """With the contrast of a CT if the image is one, after a note that says why."""
        from SlicerUSSim.Logic.mri.ct_unit import settings_for

        settings, line = settings_for(image, self.segmentation)
        if line is not None:
            note(f"{image.name}: {line}")
        return replace(self, segmentation=settings)


@dataclass(frozen=True)
class ImageOptions(MriOptions):
    """Further, what is drawn: of every command that makes images of a patient."""

    preset: str | None = declared(
        "--preset", type=click.Path(), help="Probe, display, settings and tissues as JSON, from `ussim demo` or the "
        "Slicer module, and other keys of --set; options override it.",
    )  # fmt: skip
    #: none, auto, disc:MM or a file
    craniotomy: str = declared(
        "--craniotomy", default=NONE, show_default=True, metavar="none|auto|disc:MM|FILE",
        help="Opening in skin and skull of a whole head (a label map with them, or an MRI with segmentation.outside), "
        "filled with the coupling medium: a disc of this diameter under the probe, auto (as wide as the probe's face "
        "needs), the mask in FILE, or the polygon through points of 3D Slicer (.mrk.json). With --pose auto the "
        "probe then stands on the brain.",
    )  # fmt: skip
    #: A file, auto or none
    sheets: str = declared(
        "--sheets", default=NONE, metavar="FILE|auto|none", show_default=True,
        help="Draw sulci, falx, tentorium and walls of ventricles as thin sheets: those in FILE, a .vtp of `ussim "
        "segment --sheets`; auto: found in the MRI and kept beside it, with corpus callosum, choroid plexus and "
        "vessels as labels.",
    )  # fmt: skip
    #: Kinds that are not drawn
    no_sheets: tuple[str, ...] = declared(
        "--no-sheet", multiple=True, metavar="KIND",
        help="Kind that --sheets omits: sulcus, falx, tentorium, ependyma, corpus callosum, choroid plexus, "
        "vessels; may be repeated.",
    )  # fmt: skip


def also_files(texts: Iterable[str]) -> dict[str, str]:
    """{contrast: file} of the values of --also.

    Raises SimulationError for another text or contrast, and for one twice.
    """
    found: dict[str, str] = {}
    for text in texts:
        contrast, _, file = text.partition("=")
        require(file, f"--also is {text!r}, expected CONTRAST=FILE, such as t2=t2.nii.gz")
        expected = f"expected one of {', '.join(MRI_CONTRASTS)}"
        require(contrast in MRI_CONTRASTS, f"--also: contrast is {contrast!r}, {expected}")
        require(contrast not in found, f"--also: {contrast} is given twice, expected one volume per contrast")
        found[contrast] = file
    return found


def require_no_map(path: str, maps: Iterable[str], organs: str | None) -> None:
    """Raise SimulationError for --map of an image; with --organs it is for that label map."""
    require(not tuple(maps) or organs is not None, f"{path}: is read as an image, and --map is for a label map")


def segmented_file(
    path: str, mri: Volume, patient: MriOptions, *, tell_all: bool = False, is_file: bool = True
) -> Segmentation | CtSegmentation:
    """Segment the MRI or CT of a file; the brain mask of an MRI is kept beside it if the MRI is a file (`is_file`).

    Says how the brain was found, with `tell_all` also what else; what should be checked is logged as warnings.
    """
    from SlicerUSSim.Logic.base.errors import about_file
    from SlicerUSSim.Logic.base.files import mask_beside
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.mri.masks import read_mask
    from SlicerUSSim.Logic.mri.modality import has_brain_mask, segment_image
    from SlicerUSSim.Logic.mri.segmentation import Segmentation

    settings, organs, maps = patient.segmentation, patient.organs, patient.maps
    is_of_brain = has_brain_mask(settings.contrast)
    if not is_of_brain:
        require_no_options_beside_ct(path)
    require_no_map(path, maps, organs)
    require(
        organs is None or not is_of_brain,
        f"--organs is for a CT, and {path} is read as an MRI; for a CT, give --contrast ct",
    )
    others = {contrast: Volume.read(file) for contrast, file in also_files(patient.also).items()}
    brain = read_mask(patient.mask) if patient.mask else None
    found = None if organs is None else _read_organs(organs, maps)
    with Share("segment") as progress, about_file(path):
        result = segment_image(
            mri, settings, others=others, mask=brain, organs=found, progress=progress, device=patient.device,
            keep_mask_at=mask_beside(path) if is_file else None,
        )  # fmt: skip
    lines = result.notes
    if isinstance(result, Segmentation) and not tell_all:
        lines = tuple(line for line in lines if line == result.brain.message or line.startswith("outside the brain:"))
    for line in lines:
        note(line)
    return result


def _read_organs(path: str, maps: Iterable[str]) -> LabelledTissues:
    """The label map of --organs; says what was recognised."""
    import logging

    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.tissue.label_mapping import LabelMapping
    from SlicerUSSim.Logic.tissue.label_sources import read_label_file
    from SlicerUSSim.Logic.tissue.table import TissueTable

    table = TissueTable({})
    found = read_label_file(Path(path), Volume.read(path), LabelMapping.of(maps, table), default=table, of_ct=True)
    note(f"{path}: {found.message}")
    for warning in found.warnings:
        logging.getLogger(__name__).warning("%s", warning)
    return found


def read_mri(path: str, patient: MriOptions, *, is_served: bool = False) -> Volume:
    """Read an MRI or a CT, which is not a label map unless it is segmented all the same.

    `is_served` is for the words of the errors: the command serves the workstation.
    Raises SimulationError, saying what it is, for a label map, a mask or a tracked sequence, and if it is constant.
    """
    import numpy as np

    from SlicerUSSim.Logic.base.errors import about_file
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.mri.recognition import check_finite
    from SlicerUSSim.Logic.tissue.label_findings import NoPatientError
    from SlicerUSSim.Logic.tissue.label_sources import is_label_file, read_label_file

    require_no_sequence(path)
    volume = Volume.read(path)
    if patient.mask is not None or patient.segmentation.skull_strip == "none" or patient.is_ct:
        return volume
    with about_file(path):
        check_finite(volume)
    if is_label_file(Path(path), volume):
        used_by = f"--labels {path}" if is_served else f"ussim simulate {path} ..."
        try:
            what = read_label_file(Path(path), volume).message
        except NoPatientError:  # says how to add it
            raise
        except SimulationError:  # simulate says what its labels need
            what = f"{np.unique(volume.array[volume.array != 0]).size} labels"
        raise SimulationError(
            f"{path}: is a label map ({what}), expected an MRI; use it directly ({used_by}), or segment it "
            "nevertheless with --skull-strip none"
        )
    return volume


def require_no_sequence(path: str) -> None:
    """Raise SimulationError for a file of tracked ultrasound images."""
    from SlicerUSSim.Logic.tracked.sequence import is_tracked_sequence

    require(
        not is_tracked_sequence(path),
        f"{path}: is a sequence of tracked ultrasound images, expected an MRI; use it with --sequence",
    )
