"""--also, and the segmentation of an MRI file with a progress bar, notes and warnings, for all commands."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from SlicerUSSim.Command.progress import Share, note
from SlicerUSSim.Logic.base.declaration import parameter_of
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.mri.settings import SegmentationSettings

if TYPE_CHECKING:
    from SlicerUSSim.Command.additions import Additions
    from SlicerUSSim.Logic.base import Volume
    from SlicerUSSim.Logic.mri import Segmentation

also_option = click.option(
    "--also", multiple=True, metavar="CONTRAST=FILE",
    help="Another MRI of the same patient, on any grid, registered to the first and classified together with it: "
    "t2=FILE, flair=FILE, t1=FILE or t1gd=FILE; may be repeated.",
)  # fmt: skip


def split_also(texts: Iterable[str]) -> dict[str, str]:
    """{contrast: file} of the values of --also. Raises SimulationError for another text or contrast, or one twice."""
    contrasts, found = parameter_of(SegmentationSettings, "contrast").choices, {}
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


def segmented_file(
    path: str,
    mri: Volume,
    settings: Mapping[str, Any],
    *,
    mask: str | None = None,
    also: Iterable[str] = (),
    device: str | None = None,
    additions: Additions | None = None,
    tell_all: bool = False,
) -> Segmentation:
    """Segment the MRI of a file; its brain mask is kept beside it.

    Says how the brain was found, with `tell_all` also what else; what should be checked is logged as warnings.
    Raises SimulationError before the segmentation for `additions` that could not be added after it.
    """
    from SlicerUSSim.Logic.base.errors import about_file
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.mri.kept_mask import mask_beside
    from SlicerUSSim.Logic.mri.segmentation import segment_mri

    others = read_also(also, path)
    brain = Volume.read(mask) if mask else None
    if additions is not None:
        additions.require_addable(mri, brain, settings["skull_strip"])
    with Share("segment") as progress, about_file(path):
        result = segment_mri(
            mri, **settings, others=others, mask=brain, keep_mask_at=mask_beside(path),
            device=device, progress=progress,
        )  # fmt: skip
    for line in result.notes if tell_all else (result.brain.message,):
        note(line)
    return result


def read_mri(path: str, *, mask: str | None, skull_strip: str) -> Volume:
    """Read an MRI, which is not a label map unless it is segmented all the same, with a mask or without extraction.

    Raises SimulationError, saying what it is, for a label map, a mask or a tracked sequence, and if it is constant.
    """
    from SlicerUSSim.Logic.base.errors import about_file
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.mri.recognition import check_finite
    from SlicerUSSim.Logic.tissue.label_sources import is_label_file, read_label_file

    require_no_sequence(path)
    volume = Volume.read(path)
    if mask is not None or skull_strip == "none":
        return volume
    with about_file(path):
        check_finite(volume)
    if is_label_file(Path(path), volume):
        found = read_label_file(Path(path), volume)  # refuses a mask, and says how to add it
        raise SimulationError(
            f"{path}: is a label map ({found.message}), expected an MRI; use it as it is (ussim simulate {path} ...), "
            "or segment it all the same with --skull-strip none"
        )
    return volume


def require_no_sequence(path: str) -> None:
    """Raise SimulationError for a file of tracked ultrasound images."""
    from SlicerUSSim.Logic.tracked.sequence import is_tracked_sequence

    require(
        not is_tracked_sequence(path),
        f"{path}: is a sequence of tracked ultrasound images, expected an MRI; use it with --sequence",
    )
