"""--add: tissues laid over the labels, from masks in files."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.base.errors import require

if TYPE_CHECKING:
    from SlicerUSSim.Logic.base import Volume
    from SlicerUSSim.Logic.mri import Added


def split_additions(texts: Iterable[str]) -> list[tuple[str, str]]:
    """[(tissue, file)] of the values of --add. Raises SimulationError for one that is not TISSUE=FILE."""
    parts = []
    for text in texts:
        name, _, file = text.partition("=")
        require(name.strip() and file, f"--add is {text!r}, expected TISSUE=FILE, such as tumour=mask.nii.gz")
        parts.append((name.strip(), file))
    return parts


@dataclass(frozen=True, eq=False)
class Additions:
    """The masks of --add, read and checked."""

    #: (tissue, mask, file name)
    masks: tuple[tuple[str, Volume, str], ...] = ()
    #: Names of tissues besides the presets
    own_tissues: tuple[str, ...] = ()

    @classmethod
    def read(cls, texts: Iterable[str], own_tissues: Iterable[str] = ()) -> Additions:
        """From the values of --add; tissues are among `own_tissues` and the presets.

        Raises SimulationError, before anything slow is done, for a value that is not TISSUE=FILE, for an unknown
        tissue, and for a file that is not a mask.
        """
        parts, own = split_additions(texts), tuple(own_tissues)
        if not parts:
            return cls()
        from SlicerUSSim.Logic.mri.masks import read_mask  # imported here to keep --help fast
        from SlicerUSSim.Logic.mri.pathology import mask_tissue

        for name, _ in parts:  # before a file is read
            mask_tissue(name, own)
        return cls.of(((name, read_mask(file), file) for name, file in parts), own)

    @classmethod
    def of(cls, parts: Iterable[tuple[str, Volume, str]], own_tissues: Iterable[str] = ()) -> Additions:
        """From (tissue, mask, its file); errors as in read(). Says which tissue a synonym is."""
        from SlicerUSSim.Logic.mri.masks import read_masks
        from SlicerUSSim.Logic.mri.pathology import mask_tissue
        from SlicerUSSim.Logic.tissue.names import same_name

        own, masks = tuple(own_tissues), []
        for name, mask, file in parts:
            tissue = mask_tissue(name, own)
            if not same_name(name, tissue):
                note(f"--add {name}: {tissue}")
            read_masks(mask, tissue, Path(file).name)
            masks.append((tissue, mask, Path(file).name))
        return cls(tuple(masks), own)

    def on(self, labels: Volume, tissue_names: Iterable[str], *, has_brain_mask: bool) -> Added:
        """The labels with these tissues on top, after notes of what was done; warnings are logged.

        `has_brain_mask` as in add_tissues: whether the labels are a segmentation.
        """
        from SlicerUSSim.Logic.mri.pathology import add_tissues

        added = add_tissues(
            labels, tuple(tissue_names), self.masks, also=self.own_tissues, has_brain_mask=has_brain_mask
        )
        for message in added.messages:
            note(message)
        return added
