"""A lesion grown from a point: masks of its parts for a person to look at and to correct."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.names import labels_of
from SlicerUSSim.Logic.tissue.table import write_named_labels


@dataclass(frozen=True, eq=False)
class GrownLesion:
    """A lesion on the grid of its MRI, and a larger version of it. Nothing is laid over labels by it."""

    #: uint8 on the grid of the MRI; label n + 1 is part n, 0 is outside
    labels: Volume
    #: Tissue of each part, from outside to inside: "tumour", "necrosis"; "cyst"; as the user said
    tissues: tuple[str, ...]
    #: How it looks: "enhancing", "bright in T2", "dark in T1", "fluid"
    look: str
    #: (3,) RAS mm of the point from which it was grown
    seed_ras_mm: np.ndarray
    #: What a user should look at, a line each
    warnings: tuple[str, ...] = ()
    #: The same out to the foot of its border; None: it is that itself
    larger: GrownLesion | None = None

    def mask(self, tissue: str) -> Volume:
        """uint8 mask of a part on the grid of the MRI, as pathology.add_tissue takes it."""
        return self.labels.with_array((self.labels.array == self.tissues.index(tissue) + 1).astype(np.uint8))

    def volume_ml(self, *tissues: str) -> float:
        """Of these parts, by default of all."""
        numbers = labels_of(self.tissues, tissues or self.tissues)
        return float(np.isin(self.labels.array, numbers).sum() * self.labels.voxel_ml)

    @property
    def centre_ras_mm(self) -> np.ndarray:
        """(3,) centroid."""
        centre = ndimage.center_of_mass(self.labels.array > 0)
        return self.labels.ijk_to_ras[:3] @ [*centre[::-1], 1.0]

    @property
    def message(self) -> str:
        """One line: "tumour 10.6 ml (larger version 14.6 ml) at R -42, A -22, S 25 mm, enhancing"."""
        parts = ", ".join(f"{tissue} {millilitres(self.volume_ml(tissue))}" for tissue in reversed(self.tissues))
        other = "" if self.larger is None else f" (larger version {millilitres(self.larger.volume_ml())})"
        return f"{parts}{other} at {place(self.centre_ras_mm)}, {self.look}"

    def write(self, labels_path: str | os.PathLike, number: int = 1) -> dict[str, tuple[Path, Path]]:
        """Write two masks for each part beside a label map; {tissue: (file, that of the larger version)}.

        Those of the first lesion are labels_grown_tumour.nii.gz and labels_grown_tumour_larger.nii.gz, those of the
        second labels_grown_2_tumour.nii.gz and so on.
        """
        stem, suffix = _split(Path(labels_path))
        stem += f"{number}_" if number > 1 else ""
        files = {}
        for tissue in self.tissues:
            smaller, larger = (Path(labels_path).with_name(f"{stem}{tissue}{end}{suffix}") for end in ("", "_larger"))
            for lesion, path in ((self, smaller), (self.larger or self, larger)):
                write_named_labels(path, lesion.mask(tissue), {1: tissue})
            files[tissue] = smaller, larger
        return files


def grown_beside(labels_path: str | os.PathLike) -> tuple[Path, ...]:
    """The masks of lesions beside a label map, of this or an earlier run."""
    path = Path(labels_path)
    stem, suffix = _split(path)
    if not path.parent.is_dir():
        return ()
    files = sorted(path.parent.iterdir())
    return tuple(file for file in files if file.name.startswith(stem) and file.name.endswith(suffix))


def _split(path: Path) -> tuple[str, str]:
    """(beginning, ending) of the names of the masks beside a label map."""
    name = path.name.lower()
    suffix = next((path.name[-len(end) :] for end in (".nii.gz", ".seg.nrrd") if name.endswith(end)), path.suffix)
    return f"{path.name[: len(path.name) - len(suffix)]}_grown_", suffix


def place(ras_mm: np.ndarray) -> str:
    """ "R 41, A -12, S 20 mm" """
    return "{} mm".format(", ".join(f"{axis} {round(float(value))}" for axis, value in zip("RAS", ras_mm, strict=True)))


def millilitres(volume: float) -> str:
    """ "8.1 ml", "0.46 ml" """
    return f"{volume:.1f} ml" if volume >= 1.0 else f"{volume:.2f} ml"
