"""--outside: skin, scalp, skull and air around the brain of a whole head."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.base.errors import require

if TYPE_CHECKING:
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.mri.segmentation import Segmentation

outside_option = click.option(
    "--outside", is_flag=True,
    help="Also label what is outside the brain in the T1 of a whole head: skin, scalp, skull, its marrow, and air. A "
    "probe then stands on the skin.",
)  # fmt: skip
#: Contrasts in which bone is known to be found
_CONTRASTS = ("t1", "t1gd")


def require_outside(wanted: bool, contrast: str, skull_strip: str, mask: str | None) -> None:
    """Raise SimulationError where --outside is asked for and the image is no T1, or its brain is not to be found."""
    require(
        not wanted or contrast in _CONTRASTS,
        f"--outside is for a whole head of contrast t1 or t1gd, and this is {contrast}",
    )
    require(
        not wanted or mask is not None or skull_strip != "none",
        "--outside needs to know the brain, and --skull-strip is none; give another, or a --mask",
    )


def require_head(wanted: bool, mri_path: str, mri: Volume) -> None:
    """Raise SimulationError where --outside is asked for and the image is a brain without its head."""
    from SlicerUSSim.Logic.mri.recognition import stripped_brain

    require(
        not wanted or stripped_brain(mri) is None,
        f"{mri_path}: is a brain without its head (skull-stripped), and --outside is for a whole head",
    )


def with_outside(
    mri_path: str, mri: Volume, segmentation: Segmentation, labels: Volume, names: Sequence[str]
) -> tuple[Volume, tuple[str, ...]]:
    """(labels with those outside the brain, names of all); says what was found."""
    from SlicerUSSim.Logic.base.errors import about_file
    from SlicerUSSim.Logic.mri.outside import find_outside

    with about_file(mri_path):
        found = find_outside(mri, segmentation.brain.mask.array > 0)
    labels, names = found.over(labels, names)
    note(found.text(mri.voxel_ml))
    return labels, names
