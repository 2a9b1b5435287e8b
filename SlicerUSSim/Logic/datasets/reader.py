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
from SlicerUSSim.Logic.datasets.writers import checksums, read_arrays, record_path


class SimulatedImages:
    """The images of a set: a map-style dataset of PyTorch, which need not be installed.

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
        known = list(self.manifest["outputs"])
        self.outputs = tuple(known if outputs is None else outputs)
        for name in self.outputs:
            require(name in known, f"{folder}: has no output {name!r}, expected some of {', '.join(known)}")
        every = {one["patient"] for one in self.manifest["shards"].values()}
        for name in patients or ():
            require(name in every, f"{folder}: has no patient {name!r}, expected some of {', '.join(sorted(every))}")
        self._shards = [
            (int(shard), range(*one["images"])) for shard, one in self.manifest["shards"].items()
            if patients is None or one["patient"] in patients
        ]  # fmt: skip
        self._ends = np.cumsum([len(numbers) for _, numbers in self._shards]).tolist()

    @property
    def labels(self) -> dict[int, str]:
        """{label: tissue}."""
        return {int(label): name for label, name in self.manifest["labels"].items()}

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, index: int) -> Any:
        if not -len(self) <= index < len(self):
            raise IndexError(f"image {index} of {len(self)}")
        index %= len(self)
        place = bisect_right(self._ends, index)
        shard, numbers = self._shards[place]
        within = index - (self._ends[place] - len(numbers))
        number = numbers[within]
        names = (*self.outputs, "pose", "image_to_probe")
        if self.manifest["format"] in ("zarr", "png"):  # which read one image as fast as its part of a shard
            arrays = read_arrays(self.folder, self.manifest["format"], shard, range(number, number + 1), names)
            within = 0
        else:
            arrays = _shard(str(self.folder), self.manifest["format"], shard, numbers, names)
        item = {name: values[within] for name, values in arrays.items()} | {"number": number}
        return item if self.transform is None else self.transform(item)

    def parameters(self) -> list[dict[str, Any]]:
        """What was drawn for each image, in their order."""
        return [
            one for shard, _ in self._shards
            for one in read_json(record_path(self.folder, shard), most_bytes=2**30)["parameters"]
        ]  # fmt: skip

    def damaged(self) -> list[int]:
        """The shards whose arrays have not the checksums of the manifest."""
        found = []
        for shard, numbers in self._shards:
            wanted = self.manifest["shards"][str(shard)]["checksums"]
            arrays = read_arrays(self.folder, self.manifest["format"], shard, numbers, tuple(wanted))
            if checksums(arrays) != wanted:
                found.append(shard)
        return found


@lru_cache(maxsize=4)
def _shard(folder: str, format_: str, shard: int, numbers: range, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    return read_arrays(Path(folder), format_, shard, numbers, names)
