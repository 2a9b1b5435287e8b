"""What reads a set: SimulatedImages, as PyTorch's DataLoader and MONAI have it, and exports to COCO and nnU-Net v2."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.files import make_folder, read_json, write_json
from SlicerUSSim.Logic.datasets.writers import GEOMETRY, MANIFEST, ZARR, checksums, hdf5_path, record_path
from SlicerUSSim.Logic.imaging.figures import write_png


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
        """{output: (images, ...)} of images of one shard, as they were written."""
        form = self.manifest["format"]
        readable = f"{self.folder}: has the format {form}, which other programs read, expected zarr or hdf5"
        require(form in ("zarr", "hdf5"), readable)
        if form == "zarr":
            import zarr

            group, first = zarr.open_group(self.folder / ZARR, mode="r"), numbers.start
            return {name: np.asarray(group[name][first : first + len(numbers)]) for name in names}
        import h5py

        shard, first = divmod(numbers.start, self.manifest["shard"])
        with h5py.File(hdf5_path(self.folder, shard), "r") as file:
            return {name: np.array(file[name][first : first + len(numbers)]) for name in names}

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


# ---- exports ---------------------------------------------------------------------------------------------------------


def labels_to_export(outputs: Collection[str], format_: str, where: str) -> str:
    """Which of a set's outputs are exported as labels: those as imaged, if it has them.

    Raises SimulationError for a set without labels or images, and in a format that is not read.
    """
    labels = next((name for name in ("labels_as_imaged", "labels") if name in outputs), "")
    has = f"{where}: has {', '.join(outputs)} as {format_}, expected image and labels as zarr or hdf5 to export them"
    require("image" in outputs and labels and format_ in ("zarr", "hdf5"), has)
    return labels


def _opened(folder: str | os.PathLike) -> tuple[SimulatedImages, str]:
    images = SimulatedImages(folder)
    return images, labels_to_export(images.outputs, images.manifest["format"], str(folder))


def export_coco(folder: str | os.PathLike) -> Path:
    """The file of annotations of a set in COCO's format, written into its folder `coco` with the images as PNG.

    Each connected region of a tissue is an object, with its box, area in pixels and mask (run lengths). Raises
    SimulationError as labels_to_export.
    """
    (images, labels), out = _opened(folder), Path(folder) / "coco"
    entries, objects = [], []
    for item in images:
        name, (rows, columns) = f"{item['number']:08d}.png", item["image"].shape
        write_png(make_folder(out / "images") / name, item["image"])
        entries.append({"id": item["number"], "file_name": name, "height": rows, "width": columns})
        for label in np.unique(item[labels][item[labels] > 0]).tolist():
            parts, _ = ndimage.label(item[labels] == label)  # type: ignore[misc]
            for number, (down, across) in enumerate(ndimage.find_objects(parts), 1):
                mask = parts == number
                objects.append({
                    "id": len(objects) + 1, "image_id": item["number"], "category_id": label, "iscrowd": 0,
                    "bbox": [across.start, down.start, across.stop - across.start, down.stop - down.start],
                    "area": int(mask.sum()), "segmentation": {"size": [rows, columns], "counts": _run_lengths(mask)},
                })  # fmt: skip
    categories = [{"id": label, "name": name} for label, name in images.labels.items() if label]
    about = {"description": images.manifest["title"], "version": images.manifest["checksum"]}
    content = {"info": about, "images": entries, "annotations": objects, "categories": categories}
    write_json(out / "annotations.json", content)
    return out / "annotations.json"


def _run_lengths(mask: np.ndarray) -> list[int]:
    """Lengths of runs of 0 and 1 by columns, beginning with 0, as COCO has them."""
    changes = np.flatnonzero(np.diff(mask.T.ravel().astype(np.int8), prepend=0))
    return np.diff(np.concatenate([[0], changes, [mask.size]])).tolist()


def export_nnunet(folder: str | os.PathLike) -> Path:
    """The folder Dataset001_SlicerUSSim of a set, as nnU-Net v2 reads it from its nnUNet_raw: PNG, one channel.

    Labels are numbered anew, without gaps. Raises SimulationError as labels_to_export.
    """
    (images, labels), out = _opened(folder), Path(folder) / "Dataset001_SlicerUSSim"
    known = {label: new for new, label in enumerate((label for label in images.labels if label), 1)}
    new_of = np.array([known.get(label, 0) for label in range(256)], np.uint8)
    for item in images:
        case = f"image_{item['number']:08d}"
        write_png(make_folder(out / "imagesTr") / f"{case}_0000.png", item["image"])
        write_png(make_folder(out / "labelsTr") / f"{case}.png", new_of[item[labels]])
    names = {"background": 0} | {images.labels[label]: new for label, new in known.items()}
    values = {"channel_names": {"0": "ultrasound"}, "labels": names, "numTraining": len(images), "file_ending": ".png"}
    write_json(out / "dataset.json", values)
    return out
