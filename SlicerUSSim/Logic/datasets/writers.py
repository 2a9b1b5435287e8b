"""Files of a set: each shard is written whole, and its record last, which says that it is there."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import make_folder, write_json, written_whole
from SlicerUSSim.Logic.datasets.recipe import Recipe
from SlicerUSSim.Logic.imaging.figures import write_png
from SlicerUSSim.Logic.tracked.sequence import SIMULATED, TrackedSequence

#: Written with every image
GEOMETRY = ("pose", "image_to_probe")
_ZARR = "images.zarr"


def record_path(out: Path, shard: int) -> Path:
    """The record of a shard: parameters of its images, checksums, and what made it."""
    return out / "shards" / f"{shard:06d}.json"


def write_shard(recipe: Recipe, out: Path, shard: int, arrays: Mapping[str, np.ndarray], record: dict) -> None:
    """Write the images of a shard, {output: (images, ...)}, and then its record with their checksums.

    Raises SimulationError if a file cannot be written, as on a full disk.
    """
    write = {"zarr": _zarr, "hdf5": _hdf5, "png": _png, "tracked": _tracked}[recipe.settings.format]
    try:
        write(recipe, out, shard, arrays, record["parameters"])
        make_folder(record_path(out, shard).parent)
        write_json(record_path(out, shard), record | {"checksums": checksums(arrays)})
    except OSError as error:
        raise SimulationError(f"{out}: shard {shard} cannot be written ({error.strerror or error})") from None


def checksums(arrays: Mapping[str, np.ndarray]) -> dict[str, str]:
    """{output: SHA-256 of its values, little-endian, in the order of images, rows, columns}."""
    return {name: hashlib.sha256(np.ascontiguousarray(values).data).hexdigest() for name, values in arrays.items()}


def _zarr(recipe: Recipe, out: Path, shard: int, arrays: Mapping[str, np.ndarray], _: list[dict]) -> None:
    """Zarr v3: an array per output of all images, a chunk per image, a file per shard."""
    import zarr
    from zarr.errors import ContainsArrayError

    numbers, path = recipe.images_of(shard), out / _ZARR
    for name, values in arrays.items():
        if not (path / name / "zarr.json").exists():  # another worker may write the same at the same time
            zarr.open_group(path, mode="a", zarr_format=3)
            shape, chunks, shards = ((n, *values.shape[1:]) for n in (recipe.settings.images, 1, recipe.shard))
            with suppress(ContainsArrayError):
                zarr.create_array(path, name=name, shape=shape, chunks=chunks, shards=shards, dtype=values.dtype)
        zarr.open_array(path, path=name, mode="r+")[numbers.start : numbers.stop] = values


def _hdf5(recipe: Recipe, out: Path, shard: int, arrays: Mapping[str, np.ndarray], _: list[dict]) -> None:
    """A file per shard with a dataset per output, compressed by image."""
    import h5py

    with written_whole(_h5(out, shard)) as partial, h5py.File(partial, "w") as file:
        for name, values in arrays.items():
            chunks = (1, *values.shape[1:])
            file.create_dataset(name, data=values, chunks=chunks, compression="gzip", compression_opts=1)


def _h5(out: Path, shard: int) -> Path:
    return out / f"shard-{shard:06d}.h5"


def _png(recipe: Recipe, out: Path, shard: int, arrays: Mapping[str, np.ndarray], parameters: list[dict]) -> None:
    """A picture per image and output, and its pose and parameters as JSON."""
    for place, number in enumerate(recipe.images_of(shard)):
        for name in set(arrays) - set(GEOMETRY):
            write_png(make_folder(out / name) / f"{number:08d}.png", arrays[name][place])
        geometry = {name: arrays[name][place].tolist() for name in GEOMETRY}
        write_json(make_folder(out / "parameters") / f"{number:08d}.json", parameters[place] | geometry)


def _tracked(recipe: Recipe, out: Path, shard: int, arrays: Mapping[str, np.ndarray], parameters: list[dict]) -> None:
    """A tracked sequence per shard and output."""
    geometry = zip(*(arrays[name] for name in GEOMETRY), strict=True)
    transforms = tuple({"ProbeToReference": pose, "ImageToProbe": matrix} for pose, matrix in geometry)
    texts = tuple({"Parameters": json.dumps(one, separators=(",", ":"))} for one in parameters)
    times = np.array(recipe.images_of(shard), float)
    for name in set(arrays) - set(GEOMETRY):
        about = {"fields": {SIMULATED: "dataset"}, "frame_fields": texts}
        TrackedSequence(arrays[name], transforms, times, **about).write(out / f"{name}-{shard:06d}.igs.mha")


def read_arrays(out: Path, form: str, numbers: range, size: int, names: Iterable[str]) -> dict[str, np.ndarray]:
    """{output: (images, ...)} of images with these numbers, all in one shard of `size`, as they were written.

    Raises SimulationError for a format of pictures.
    """
    require(form in ("zarr", "hdf5"), f"{out}: has the format {form}, which other programs read, expected zarr or hdf5")
    if form == "zarr":
        import zarr

        part = slice(numbers.start, numbers.stop)
        return {name: np.asarray(zarr.open_array(out / _ZARR, path=name, mode="r")[part]) for name in names}
    import h5py

    shard, first = divmod(numbers.start, size)
    with h5py.File(_h5(out, shard), "r") as file:
        return {name: np.array(file[name][first : first + len(numbers)]) for name in names}
