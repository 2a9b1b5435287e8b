"""A proposal: masks of a lesion's parts for a person to accept or to correct. Nothing else changes by it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.names import labels_of


@dataclass(frozen=True, eq=False)
class Proposal:
    """A lesion that an MRI seems to show."""

    #: uint8 on the grid of the MRI; label n + 1 is part n, 0 is none of them
    labels: Volume
    #: Tissue of each part, from outside to inside: "oedema", "tumour", "necrosis", "cyst", "cavity"
    tissues: tuple[str, ...]
    #: How it looks: "enhancing", "bright in T2", "dark in T1", "fluid"
    look: str
    #: (3,) RAS mm of the point from which it was grown
    seed_ras_mm: np.ndarray
    #: What a user should look at, a line each
    warnings: tuple[str, ...] = ()

    def mask(self, tissue: str) -> Volume:
        """uint8 mask of a part on the grid of the MRI, as pathology.add_tissue takes it."""
        return self.labels.with_array((self.labels.array == self.tissues.index(tissue) + 1).astype(np.uint8))

    def volume_ml(self, *tissues: str) -> float:
        """Of these parts, by default of all."""
        numbers = labels_of(self.tissues, tissues or self.tissues)
        return float(np.isin(self.labels.array, numbers).sum() * self.labels.voxel_ml)

    @property
    def centre_ras_mm(self) -> np.ndarray:
        """(3,) centroid, of the parts without oedema where there are others."""
        main = [n for n, tissue in enumerate(self.tissues, 1) if tissue != "oedema"] or [1]
        centre = ndimage.center_of_mass(np.isin(self.labels.array, main))
        return self.labels.ijk_to_ras[:3] @ [*centre[::-1], 1.0]

    @property
    def message(self) -> str:
        """One line: "tumour 0.5 ml in oedema 8.1 ml at R 41, A -12, S 20 mm, enhancing; proposed, not applied"."""
        parts = [f"{tissue} {millilitres(self.volume_ml(tissue))}" for tissue in reversed(self.tissues)]
        return f"{', '.join(parts)} at {place(self.centre_ras_mm)}, {self.look}; proposed, not applied"

    def files(self, labels_path: str | os.PathLike, number: int = 1) -> dict[str, Path]:
        """{tissue: file} beside a label map in which write() keeps the masks, of the first or a further proposal."""
        stem, suffix = _split(Path(labels_path))
        which = "" if number == 1 else f"{number}_"
        return {tissue: Path(labels_path).with_name(f"{stem}{which}{tissue}{suffix}") for tissue in self.tissues}

    def write(self, labels_path: str | os.PathLike, number: int = 1) -> dict[str, Path]:
        """Write a mask for each part beside a label map; {tissue: file}."""
        files = self.files(labels_path, number)
        for tissue, path in files.items():
            self.mask(tissue).write(path)
        return files


def proposals_beside(labels_path: str | os.PathLike) -> tuple[Path, ...]:
    """The proposals beside a label map, of this or an earlier run."""
    path = Path(labels_path)
    stem, suffix = _split(path)
    if not path.parent.is_dir():
        return ()
    return tuple(file for file in sorted(path.parent.iterdir()) if _is_called(file.name, stem, suffix))


def _split(path: Path) -> tuple[str, str]:
    """(beginning, ending) of the names of the proposals beside a label map."""
    name = path.name.lower()
    suffix = next((path.name[-len(end) :] for end in (".nii.gz", ".seg.nrrd") if name.endswith(end)), path.suffix)
    return f"{path.name[: len(path.name) - len(suffix)]}_proposed_", suffix


def _is_called(name: str, stem: str, suffix: str) -> bool:
    return name.startswith(stem) and name.endswith(suffix)


def place(ras_mm: np.ndarray) -> str:
    """ "R 41, A -12, S 20 mm" """
    return "{} mm".format(", ".join(f"{axis} {round(float(value))}" for axis, value in zip("RAS", ras_mm, strict=True)))


def millilitres(volume: float) -> str:
    """ "8.1 ml", "0.46 ml" """
    return f"{volume:.1f} ml" if volume >= 1.0 else f"{volume:.2f} ml"
