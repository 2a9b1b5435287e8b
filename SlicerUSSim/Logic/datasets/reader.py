"""SimulatedImages: the images of a set one by one, as PyTorch's DataLoader and MONAI read them."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Callable, Sequence
from functools import lru_cache
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
    transform : applied to every item, as those of MONAI.
    patients : those of these files alone, to train and test on different ones.

    Raises SimulationError for a folder without a finished set, and for outputs and patients that it has not.
    """

    def __init__(
        self, folder: str | os.PathLike, outputs: Sequence[str] | None = None, *,
        transform: Callable[[dict], Any] | None = None, patients: Sequence[str] | None = None,
    ) -> None:  # fmt: skip
        self.folder, self.transform = Path(folder), transform
        require((self.folder / MANIFEST).exists(), f"{folder}: has no {MANIFEST}, expected a set of `ussim dataset`")
        self.manifest = read_json(self.folder / MANIFEST, most_bytes=2**30)
        shards, known = self.manifest["shards"], list(self.manifest["outputs"])
        self.outputs = tuple(known if outputs is None else outputs)
        every = sorted({one["patient"] for one in shards.values()})
        for kind, wanted, there in (("output", self.outputs, known), ("patient", patients or (), every)):
            for name in wanted:
                require(name in there, f"{folder}: has no {kind} {name!r}, expected some of {', '.join(there)}")
        kept = {shard: one for shard, one in shards.items() if patients is None or one["patient"] in patients}
        self._shards = [(int(shard), range(*one["images"])) for shard, one in kept.items()]
        self._ends = np.cumsum([len(numbers) for _, numbers in self._shards]).tolist()
        #: {label: tissue}
        self.labels: dict[int, str] = {int(label): name for label, name in self.manifest["labels"].items()}

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, index: int) -> Any:
        if not -len(self) <= index < len(self):
            raise IndexError(f"image {index} of {len(self)}")
        place = bisect_right(self._ends, index % len(self))
        shard, numbers = self._shards[place]
        number, within = numbers[index % len(self) - self._ends[place]], 0  # from the end of the shard
        form, names = self.manifest["format"], (*self.outputs, *GEOMETRY)
        if form == "hdf5":
            arrays, within = _shard(self.folder, form, shard, numbers, names), number - numbers.start
        else:
            arrays = read_arrays(self.folder, form, shard, range(number, number + 1), names)
        item = {name: values[within] for name, values in arrays.items()} | {"number": number}
        return item if self.transform is None else self.transform(item)

    def parameters(self) -> list[dict[str, Any]]:
        """What was drawn for each image, in their order."""
        records = (read_json(record_path(self.folder, shard), most_bytes=2**30) for shard, _ in self._shards)
        return [one for record in records for one in record["parameters"]]

    def damaged(self) -> list[int]:
        """The shards whose arrays have not the checksums of the manifest."""
        wanted = {shard: self.manifest["shards"][str(shard)]["checksums"] for shard, _ in self._shards}
        form = self.manifest["format"]
        return [
            shard for shard, numbers in self._shards
            if checksums(read_arrays(self.folder, form, shard, numbers, tuple(wanted[shard]))) != wanted[shard]
        ]  # fmt: skip


_shard = lru_cache(maxsize=4)(read_arrays)
