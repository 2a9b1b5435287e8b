"""What reads a set: SimulatedImages, as PyTorch's DataLoader and MONAI have it, and exports to COCO and nnU-Net v2."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.files import make_folder, read_json, write_json
from SlicerUSSim.Logic.datasets.writers import GEOMETRY, HDF5, MANIFEST, ZARR, record_path
from SlicerUSSim.Logic.imaging.figures import write_png


class SimulatedImages:
    """The images of a set in Zarr or HDF5: a map-style dataset of PyTorch, which need not be installed.

    Item n is {output: array}, with "pose", "image_to_probe" and "number", the number of the image.

    Parameters
    ----------
    folder : of `ussim dataset`.
    outputs : which of the set's (default: all).

    Images of a patient follow each other: `manifest["shards"]` says which. Raises SimulationError for a folder without
    a finished set, and for outputs that it has not.
    """

    def __init__(self, folder: str | os.PathLike, outputs: Sequence[str] | None = None) -> None:
        self.folder = Path(folder)
        require((self.folder / MANIFEST).exists(), f"{folder}: has no {MANIFEST}, expected a set of `ussim dataset`")
        self.manifest = read_json(self.folder / MANIFEST, most_bytes=2**30)
        known = self.manifest["outputs"]
        self.outputs = tuple(known if outputs is None else outputs)
        for name in self.outputs:
            require(name in known, f"{folder}: has no output {name!r}, expected some of {', '.join(known)}")
        numbers = [np.arange(*one["images"]) for one in self.manifest["shards"].values()]
        self._numbers = np.concatenate([np.zeros(0, int), *numbers])
        #: {label: tissue}
        self.labels: dict[int, str] = {int(label): name for label, name in self.manifest["labels"].items()}

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: int) -> dict[str, Any]:
        number, names, form = int(self._numbers[index]), (*self.outputs, *GEOMETRY), self.manifest["format"]
        require(form in ("zarr", "hdf5"), f"{self.folder}: has the format {form}, expected zarr or hdf5 to read it")
        if form == "zarr":
            import zarr

            file: Any = zarr.open_group(self.folder / ZARR, mode="r")
            return {"number": number, **{name: np.asarray(file[name][number]) for name in names}}
        import h5py

        shard, within = divmod(number, self.manifest["shard"])
        with h5py.File(self.folder / HDF5.format(shard), "r") as file:
            return {"number": number, **{name: np.asarray(file[name][within]) for name in names}}

    def parameters(self) -> list[dict[str, Any]]:
        """What was drawn for each image, in their order."""
        shards = map(int, self.manifest["shards"])
        records = (read_json(record_path(self.folder, shard), most_bytes=2**30) for shard in shards)
        return [one for record in records for one in record["parameters"]]


def labels_to_export(outputs: Collection[str], format_: str, where: str) -> str:
    """Which of a set's outputs are exported as labels: those as imaged, if it has them.

    Raises SimulationError for a set without labels or images, and in a format that is not read.
    """
    labels = next((name for name in ("labels_as_imaged", "labels") if name in outputs), "")
    has = f"{where}: has {', '.join(outputs)} as {format_}, expected image and labels as zarr or hdf5 to export them"
    require("image" in outputs and labels and format_ in ("zarr", "hdf5"), has)
    return labels


def export_coco(folder: str | os.PathLike) -> Path:
    """The file of annotations of a set in COCO's format, written into its folder `coco` with the images as PNG.

    Each connected region of a tissue is an object, with its box, area in pixels and mask (run lengths). Raises
    SimulationError as labels_to_export.
    """
    images, out = SimulatedImages(folder), Path(folder) / "coco"
    labels = labels_to_export(images.outputs, images.manifest["format"], str(folder))
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
    images, out = SimulatedImages(folder), Path(folder) / "Dataset001_SlicerUSSim"
    labels = labels_to_export(images.outputs, images.manifest["format"], str(folder))
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
