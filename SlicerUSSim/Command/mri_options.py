"""--also, and the segmentation of an MRI file with a progress bar, notes and warnings, for all commands."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from SlicerUSSim.Command.options import require_no_options_beside_ct
from SlicerUSSim.Command.progress import Share, note
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.mri.segmentation_settings import CT, MRI_CONTRASTS, SegmentationSettings

if TYPE_CHECKING:
    from SlicerUSSim.Command.additions import Additions
    from SlicerUSSim.Logic.base import Volume
    from SlicerUSSim.Logic.mri import CtSegmentation, Segmentation
    from SlicerUSSim.Logic.tissue import LabelledTissues


also_option = click.option(
    "--also", multiple=True, metavar="CONTRAST=FILE",
    help="Another MRI of the same patient, on any grid, registered to the first and classified together with it: "
    "t2=FILE, flair=FILE, t1=FILE or t1gd=FILE; may be repeated.",
)  # fmt: skip


organs_option = click.option(
    "--organs", type=click.Path(), help="Label map of organs of a CT (--ct), such as TotalSegmentator's, whose soft "
    "tissues replace muscle and blood.",
)  # fmt: skip


def split_also(texts: Iterable[str]) -> dict[str, str]:
    """{contrast: file} of the values of --also. Raises SimulationError for another text or contrast, or one twice."""
    contrasts, found = MRI_CONTRASTS, {}
    for text in texts:
        contrast, _, file = text.partition("=")
        require(file, f"--also is {text!r}, expected CONTRAST=FILE, such as t2=t2.nii.gz")
        require(contrast in contrasts, f"--also: contrast is {contrast!r}, expected one of {', '.join(contrasts)}")
        require(contrast not in found, f"--also: {contrast} is given twice, expected one volume per contrast")
        found[contrast] = file
    return found


def read_also(texts: Iterable[str], mri: str | None = None) -> dict[str, Volume]:
    """{contrast: volume} of the values of --also. Raises SimulationError for the file of the first `mri` again."""
    from SlicerUSSim.Logic.base.volume import Volume  # imported here to keep --help fast

    files = split_also(texts)
    require_other_files(mri, files)
    return {contrast: Volume.read(file) for contrast, file in files.items()}


def require_other_files(mri: str | None, also: Mapping[str, str]) -> None:
    """Raise SimulationError if two of an MRI and {contrast: file} of --also are one file."""
    known = [] if mri is None else [("the MRI", Path(mri))]
    for contrast, file in also.items():
        for name, other in known:
            is_same = Path(file).exists() and other.exists() and other.samefile(file)
            require(not is_same, f"--also {contrast}={file}: is the file of {name} again, expected another image")
        known.append((f"--also {contrast}", Path(file)))


def require_no_map(path: str, maps: Iterable[str], organs: str | None) -> None:
    """Raise SimulationError for --map of an image; with --organs it is for that label map."""
    require(not tuple(maps) or organs is not None, f"{path}: is read as an image, and --map is for a label map")


def segmented_file(
    path: str,
    mri: Volume,
    settings: SegmentationSettings,
    *,
    mask: str | None = None,
    also: Iterable[str] = (),
    organs: str | None = None,
    maps: Iterable[str] = (),
    device: str | None = None,
    additions: Additions | None = None,
    tell_all: bool = False,
) -> Segmentation | CtSegmentation:
    """Segment the MRI or CT of a file; the brain mask of an MRI is kept beside it.

    `organs` is the file of --organs, `maps` the values of --map for it.

    Says how the brain was found, with `tell_all` also what else; what should be checked is logged as warnings.
    Raises SimulationError before the segmentation for `additions` that could not be added after it.
    """
    from SlicerUSSim.Logic.base.errors import about_file
    from SlicerUSSim.Logic.mri.kept_mask import mask_beside
    from SlicerUSSim.Logic.mri.masks import read_mask
    from SlicerUSSim.Logic.mri.modality import has_brain_mask, segment_image
    from SlicerUSSim.Logic.mri.segmentation import Segmentation

    is_of_brain = has_brain_mask(settings.contrast)
    if not is_of_brain:
        require_no_options_beside_ct(path)
    require_no_map(path, maps, organs)
    require(organs is None or not is_of_brain, f"--organs is for a CT, expected --ct; {path} is read as an MRI")
    others = read_also(also, path)
    brain = read_mask(mask) if mask else None
    if additions is not None:
        additions.require_addable(mri, brain, settings.skull_strip if is_of_brain else "none")
    found = None if organs is None else _read_organs(organs, maps)
    with Share("segment") as progress, about_file(path):
        result = segment_image(
            mri, settings, others=others, mask=brain, organs=found, keep_mask_at=mask_beside(path), device=device,
            progress=progress,
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
        if "--map 0=" in warning:  # between organs the CT says what is there
            continue
        logging.getLogger(__name__).warning("%s", warning)
    return found


def read_mri(
    path: str, *, mask: str | None, skull_strip: str, contrast: str = MRI_CONTRASTS[0], is_served: bool = False
) -> Volume:
    """Read an MRI or a CT, which is not a label map unless it is segmented all the same.

    `is_served` is for the words of the errors: the command is that of the workstation.
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
    if mask is not None or skull_strip == "none" or contrast == CT:
        return volume
    with about_file(path):
        check_finite(volume)
    if is_label_file(Path(path), volume):
        used_by = f"--labels {path}" if is_served else f"ussim simulate {path} ..."
        try:
            found = read_label_file(Path(path), volume)
        except NoPatientError:  # says how to add it
            raise
        except SimulationError as error:
            if "--map" not in str(error):
                raise
            count = np.unique(volume.array[volume.array != 0]).size
            remedy = f"use it as it is ({used_by}), which says what its labels need"
            raise SimulationError(f"{path}: is a label map ({count} labels), expected an MRI; {remedy}") from error
        raise SimulationError(
            f"{path}: is a label map ({found.message}), expected an MRI; use it as it is ({used_by}), or segment it "
            "all the same with --skull-strip none"
        )
    return volume


def require_no_sequence(path: str) -> None:
    """Raise SimulationError for a file of tracked ultrasound images."""
    from SlicerUSSim.Logic.tracked.sequence import is_tracked_sequence

    require(
        not is_tracked_sequence(path),
        f"{path}: is a sequence of tracked ultrasound images, expected an MRI; use it with --sequence",
    )
