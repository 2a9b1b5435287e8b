"""SimulatedImages: the images of a set one by one, as PyTorch's DataLoader and MONAI read them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.files import read_json
from SlicerUSSim.Logic.datasets.datasheet import MANIFEST
from SlicerUSSim.Logic.datasets.writers import GEOMETRY, checksums, read_arrays, record_path


class SimulatedImages:
    """The images of a set in Zarr or HDF5: a map-style dataset of PyTorch, which need not be installed.

    Item n is {output: array}, with "pose", "image_to_probe" and "number", the number of the image.

    Parameters
    ----------
    folder : of `ussim dataset`.
    outputs : which of the set's (default: all).
    patients : those of these files alone, to train and test on different ones.

    Raises SimulationError for a folder without a finished set, and for outputs and patients that it has not.
    """

    def __init__(
        self, folder: str | os.PathLike, outputs: Sequence[str] | None = None, *, patients: Sequence[str] | None = None
    ) -> None:
        self.folder = Path(folder)
        require((self.folder / MANIFEST).exists(), f"{folder}: has no {MANIFEST}, expected a set of `ussim dataset`")
        self.manifest = read_json(self.folder / MANIFEST, most_bytes=2**30)
        shards, known = self.manifest["shards"], list(self.manifest["outputs"])
        every = sorted({one["patient"] for one in shards.values()})
        self.outputs = tuple(known if outputs is None else outputs)
        wanted = every if patients is None else patients
        for kind, names, there in (("output", self.outputs, known), ("patient", wanted, every)):
            for name in names:
                require(name in there, f"{folder}: has no {kind} {name!r}, expected some of {', '.join(there)}")
        self._shards = {int(shard): one for shard, one in shards.items() if one["patient"] in wanted}
        numbers = [np.arange(*one["images"]) for one in self._shards.values()]
        self._numbers = np.concatenate([np.zeros(0, int), *numbers])
        #: {label: tissue}
        self.labels: dict[int, str] = {int(label): name for label, name in self.manifest["labels"].items()}

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: int) -> dict[str, Any]:
        number = int(self._numbers[index])
        arrays = self._read(range(number, number + 1), (*self.outputs, *GEOMETRY))
        return {name: values[0] for name, values in arrays.items()} | {"number": number}

    def _read(self, numbers: range, names: Iterable[str]) -> dict[str, np.ndarray]:
        return read_arrays(self.folder, self.manifest["format"], numbers, self.manifest["shard"], names)

    def parameters(self) -> list[dict[str, Any]]:
        """What was drawn for each image, in their order."""
        records = (read_json(record_path(self.folder, shard), most_bytes=2**30) for shard in self._shards)
        return [one for record in records for one in record["parameters"]]

    def damaged(self) -> list[int]:
        """The shards whose arrays have not the checksums of the manifest."""
        return [
            shard for shard, one in self._shards.items()
            if checksums(self._read(range(*one["images"]), one["checksums"])) != one["checksums"]
        ]  # fmt: skip
