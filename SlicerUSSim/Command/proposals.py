"""--seed and --propose: lesions proposed from the MRI, written as masks for --add."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.base.errors import SimulationError, require

if TYPE_CHECKING:
    from SlicerUSSim.Logic.base import Volume
    from SlicerUSSim.Logic.mri import Segmentation

seed_option = click.option(
    "--seed", "seeds", multiple=True, metavar="R,A,S[=TISSUE]",
    help="Propose the lesion around a point, RAS mm in the frame of the MRI: masks beside the labels, which stay as "
    "they are; --add lays them over. With a tissue (tumour, oedema, cyst, cavity, ...) it is proposed as that, also "
    "where it looks healthy. May be repeated.",
)  # fmt: skip
propose_option = click.option(
    "--propose",
    is_flag=True,
    help="Propose what looks like a lesion in a whole brain in the same way, without a point.",
)


def split_seeds(texts: Iterable[str]) -> list[tuple[tuple[float, ...], str | None]]:
    """[((R, A, S) mm, tissue)] of the values of --seed; None for the tissue: by its look.

    Raises SimulationError for a value that is not R,A,S or R,A,S=TISSUE, and for an unknown tissue.
    """
    seeds = []
    for text in texts:
        numbers, _, tissue = text.partition("=")
        try:
            point = tuple(float(number) for number in numbers.split(","))
        except ValueError:
            point = ()
        require(
            len(point) == 3 and ("=" not in text or bool(tissue.strip())),
            f"--seed is {text!r}, expected R,A,S in mm, such as 31.5,-20,42, or with a tissue 31.5,-20,42=oedema",
        )
        if tissue:
            from SlicerUSSim.Logic.mri.pathology import tissue_to_add  # imported here to keep --help fast

            tissue = tissue_to_add(tissue)
        seeds.append((point, tissue.strip() or None))
    return seeds


def require_seeds(seeds: Iterable[str], mri: Volume, labels_path: Path) -> None:
    """Raise SimulationError, before a segmentation, for seeds outside the image and for proposals that were edited."""
    from SlicerUSSim.Logic.mri.lesions.proposal import require_own_proposals
    from SlicerUSSim.Logic.mri.lesions.seeded import require_in_image

    for point, _ in split_seeds(seeds):
        require_in_image(mri, point)
    require_own_proposals(labels_path)


def write_proposals(segmentation: Segmentation, seeds: Iterable[str], propose: bool, labels_path: Path) -> None:
    """Write the masks of what is proposed beside the labels, and say what they are and how to apply them.

    Raises SimulationError for the first seed in what is no lesion, after the others.
    """
    from SlicerUSSim.Logic.mri.lesions.detection import propose_lesions
    from SlicerUSSim.Logic.mri.lesions.seeded import grow_lesion

    proposals, refused = [], []
    for point, tissue in split_seeds(seeds):
        try:
            proposals.append(grow_lesion(segmentation, point, tissue))
        except SimulationError as error:
            refused.append(error)
    if propose:
        found = propose_lesions(segmentation)
        proposals += [new for new in found if not any(new.is_mostly_in(old) for old in proposals)]
        if not found:
            note("no lesion proposed: nothing compact in this brain looks unlike the other hemisphere")
    for number, proposal in enumerate(proposals, 1):
        note(proposal.message)
        for line in proposal.warnings:
            note(f"  {line}")
        files = proposal.write(labels_path, number)
        additions = " ".join(f"--add {tissue}={path}" for tissue, path in files.items())
        note(f"  look at it over the MRI, correct it, and apply it with {additions}")
    if refused:
        raise refused[0]
