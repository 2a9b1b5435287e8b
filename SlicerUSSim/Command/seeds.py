"""--seed: lesions grown from points of the MRI, written as masks for --add."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from SlicerUSSim.Command.options import check_outputs
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.base.errors import SimulationError, require

if TYPE_CHECKING:
    from SlicerUSSim.Logic.base import Volume
    from SlicerUSSim.Logic.mri import Segmentation
    from SlicerUSSim.Logic.mri.lesions.grown_lesion import GrownLesion

seed_option = click.option(
    "--seed", "seeds", multiple=True, metavar="R,A,S|FILE[=TISSUE]",
    help="Grow the lesion around a point, RAS mm in the frame of the MRI, or around each point of a file of 3D "
    "Slicer (.mrk.json): masks beside the unchanged labels, each in a smaller and a larger "
    "version; --add lays them over. With a tissue (tumour, oedema, necrosis, cyst, haematoma, cavity, enhancing) it "
    "is called that. May be repeated.",
)  # fmt: skip


def split_seeds(texts: Iterable[str]) -> list[tuple[tuple[float, ...], str | None]]:
    """[((R, A, S) mm, tissue)] of the values of --seed, one for each point; None for the tissue: by its look.

    Raises SimulationError for a value that is not R,A,S or a file of points, without or with =TISSUE, and for a tissue
    that is not a lesion.
    """
    seeds = []
    for text in texts:
        place, _, tissue = text.partition("=")
        points = _points_of(place)
        require(
            bool(points) and ("=" not in text or bool(tissue.strip())),
            f"--seed is {text!r}, expected R,A,S in mm, such as 31.5,-20,42, or points of 3D Slicer (.mrk.json), and "
            "with a tissue 31.5,-20,42=oedema; a mask is laid over the labels with --add tumour=FILE",
        )
        if tissue:
            from SlicerUSSim.Logic.base.errors import about_file
            from SlicerUSSim.Logic.mri.lesions.seeded import lesion_tissue  # imported here to keep --help fast

            with about_file(f"--seed {text}"):
                tissue = lesion_tissue(tissue.strip())
        seeds += [(point, tissue or None) for point in points]
    return seeds


def _points_of(place: str) -> list[tuple[float, ...]]:
    """The point R,A,S, or those of a file; empty for another text."""
    from SlicerUSSim.Logic.mri.markups import is_markup_name, markup_points  # imported here to keep --help fast

    if is_markup_name(place):
        _, points = markup_points(place, ("Fiducial",), "a list of points")
        require(len(points) > 0, f"{place}: has no point that was placed, expected one in each lesion")
        return [tuple(map(float, point)) for point in points]
    try:
        point = tuple(float(number) for number in place.split(","))
    except ValueError:
        return []
    return [point] if len(point) == 3 else []


def require_seeds(seeds: Iterable[str], mri: Volume, labels_path: Path) -> None:
    """Raise SimulationError, before a segmentation, for seeds outside the image and for masks that exist."""
    from SlicerUSSim.Logic.mri.lesions.grown_lesion import grown_beside
    from SlicerUSSim.Logic.mri.lesions.seeded import require_in_image

    for point, _ in split_seeds(seeds):
        require_in_image(mri, point)
    check_outputs(*grown_beside(labels_path))


def grown_at(segmentation: Segmentation, seeds: Iterable[str]) -> tuple[list[GrownLesion], list[str]]:
    """(the lesions around seeds, a line for each seed at which nothing grows). Writes nothing."""
    from SlicerUSSim.Logic.mri.lesions.seeded import grow_lesion

    lesions, refused = [], []
    for point, tissue in split_seeds(seeds):
        try:
            lesions.append(grow_lesion(segmentation, point, tissue))
        except SimulationError as error:
            refused.append(str(error))
    return lesions, refused


def require_none_refused(refused: Iterable[str], labels_path: Path) -> None:
    """Raise SimulationError with the lines of refused seeds, when labels and the other lesions are written."""
    lines = "; ".join(refused)
    require(not lines, f"{lines}; {labels_path} is written, with all lesions that were not refused")


def write_lesions(lesions: Iterable[GrownLesion], labels_path: Path) -> None:
    """Write the masks of lesions beside the labels, and say what they are and how to apply them.

    A warning lists files of an earlier run that stay beside the labels.
    """
    from SlicerUSSim.Logic.mri.lesions.grown_lesion import grown_beside

    written: set[Path] = set()
    for number, lesion in enumerate(lesions, 1):
        note(f"{lesion.message}; not applied")
        for line in lesion.warnings:
            note(f"  {line}")
        files = lesion.write(labels_path, number)
        written |= {path for tissue in files for path in files[tissue]}
        additions = " ".join(f"--add {tissue}={smaller}" for tissue, (smaller, _) in files.items())
        larger = ", ".join(str(path) for _, path in files.values())
        note(f"  look at it over the MRI, correct it, and apply it with {additions}; larger: {larger}")
    for path in grown_beside(labels_path):
        if path not in written:
            note(f"{path} of an earlier run stays: delete it if it is not needed")
