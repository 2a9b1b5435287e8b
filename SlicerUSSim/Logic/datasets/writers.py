"""Files of a set: shards, each written whole and its record last, which says that it is there; manifest, datasheet."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.files import make_folder, read_json, write_json, written_whole
from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.base.version import __version__
from SlicerUSSim.Logic.datasets.recipe import BUNDLED, CLASSES, OUTPUTS, PatientSettings, Recipe
from SlicerUSSim.Logic.imaging.figures import write_png
from SlicerUSSim.Logic.imaging.quality import sample_mm
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.tracked.sequence import SIMULATED, TrackedSequence

#: Written with every image
GEOMETRY = ("pose", "image_to_probe")
ZARR, HDF5, MANIFEST = "images.zarr", "shard-{:06d}.h5", "manifest.json"
#: (licence, citation) of the bundled patients
_SOURCES = {
    BUNDLED[0]: ("that of mni152.txt in the package", "MNI152 2009a (Fonov et al., NeuroImage 54, 2011), from nilearn"),
    BUNDLED[1]: ("Apache-2.0", "drawn by SlicerUSSim"),
}
_LIBRARIES = {"numpy", "pyopencl", "zarr", "h5py", "distributed"}
_PAGE = """# {title}

{made} of {images} B-mode images, simulated by SlicerUSSim {makers} from the recipe `recipe.toml` with seed {seed}. They
are not measurements: test a model that was trained on them on real images.

Licence: {licence}

## Content

{outputs}
- `pose`: (4, 4) from the probe to the patient, RAS mm; `image_to_probe`: (4, 4) from (column, row, 0, 1) to mm
- `shards/*.json`: parameters drawn for each image, and the SHA-256 of its arrays

Format: {format}, {shard} images in a shard. Labels: {labels}. Checksum of all arrays: `{checksum}`.

## Sources

{patients}

Acoustic values of tissues: with their sources in SlicerUSSim. Warnings, devices and probes are in manifest.json.
"""


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
    """Zarr v3: an array per output of all images, a chunk per image or for all poses of a shard, a file per shard."""
    import zarr
    from zarr.errors import ContainsArrayError

    numbers, path = recipe.images_of(shard), out / ZARR
    for name, values in arrays.items():
        if not (path / name / "zarr.json").exists():  # another worker may write the same at the same time
            zarr.open_group(path, mode="a", zarr_format=3)
            chunk = recipe.shard if name in GEOMETRY else 1
            shape, chunks, shards = ((n, *values.shape[1:]) for n in (recipe.settings.images, chunk, recipe.shard))
            with suppress(ContainsArrayError):
                zarr.create_array(path, name=name, shape=shape, chunks=chunks, shards=shards, dtype=values.dtype)
        with zarr.config.set({"codec_pipeline.batch_size": recipe.shard}):  # twice as fast as one after the other
            zarr.open_array(path, path=name, mode="r+")[numbers.start : numbers.stop] = values


def _hdf5(recipe: Recipe, out: Path, shard: int, arrays: Mapping[str, np.ndarray], _: list[dict]) -> None:
    """A file per shard with a dataset per output, compressed by image."""
    import h5py

    with written_whole(out / HDF5.format(shard)) as partial, h5py.File(partial, "w") as file:
        for name, values in arrays.items():
            chunks = (1, *values.shape[1:])
            file.create_dataset(name, data=values, chunks=chunks, compression="gzip", compression_opts=1)


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
        made = TrackedSequence(arrays[name], transforms, times, fields={SIMULATED: "dataset"}, frame_fields=texts)
        made.write(out / f"{name}-{shard:06d}.igs.mha")


def write_datasheet(recipe: Recipe, out: Path, skipped: Mapping[str, str]) -> None:
    """Write manifest.json and README.md of what is in the folder."""
    for rest in out.glob("images.zarr/**/*.partial"):  # of workers that were killed
        rest.unlink(missing_ok=True)
    shards, settings = {}, recipe.settings
    devices, makers, warnings, tissues = set(), set(), set(), {"coupling"}
    for shard in range(recipe.shards):
        if record_path(out, shard).exists():
            record = read_json(record_path(out, shard), most_bytes=2**30)
            shards[str(shard)] = {name: record[name] for name in ("images", "patient", "case", "checksums")}
            devices.add(record["device"])
            makers.add(record["version"])
            warnings |= {f"{record['patient']}: {warning}" for warning in record["warnings"]}
            tissues |= set(record["tissues"])
    sums = json.dumps([one["checksums"] for one in shards.values()])
    found = {one.name: one.version for one in distributions() if one.name in _LIBRARIES}
    manifest = {
        "title": settings.title, "licence": settings.licence or "see Sources", "seed": settings.seed,
        "format": settings.format, "images": settings.images, "shard": recipe.shard,
        "made": sum(one["images"][1] - one["images"][0] for one in shards.values()), "checksum": _sha256(sums.encode()),
        "recipe_sha256": _sha256(recipe.text.encode()), "outputs": {name: OUTPUTS[name] for name in settings.outputs},
        "labels": {str(n): name for n, name in enumerate(CLASSES) if name in tissues},
        "patients": [_patient(recipe, one, skipped) for one in recipe.patients],
        "made_by": sorted(makers), "devices": sorted(devices), "warnings": sorted(warnings),
        "versions": {"SlicerUSSim": __version__, "Python": platform.python_version(), **found}, "shards": shards,
        "probes": [_scan_lines(*worked) for worked in recipe.worked],
    }  # fmt: skip
    write_json(out / MANIFEST, manifest)
    texts = {
        "outputs": _listed(f"`{name}`: {about}" for name, about in manifest["outputs"].items()),
        "labels": ", ".join(f"{number} {name}" for number, name in manifest["labels"].items()),
        "patients": _listed(
            f"`{one['file']}`: {one['citation']}; licence: {one['licence']}"
            + (f"; MISSING: {one['missing_because']}" if one["missing_because"] else "")
            for one in manifest["patients"]
        ),
        "makers": ", ".join(manifest["made_by"]),
    }  # fmt: skip
    with written_whole(out / "README.md") as partial:
        partial.write_text(_PAGE.format(**{**manifest, **texts}), encoding="utf-8")


def _patient(recipe: Recipe, patient: PatientSettings, skipped: Mapping[str, str]) -> dict[str, Any]:
    path, (licence, citation) = recipe.folder / patient.file, _SOURCES.get(patient.file, ("not given", "not given"))
    return {
        "file": patient.file, "sha256": _sha256(path.read_bytes()) if path.is_file() else "",
        "licence": patient.licence or licence, "citation": patient.citation or citation,
        "missing_because": skipped.get(patient.file, ""),
    }  # fmt: skip


def _scan_lines(probe: Probe, settings: SimulationSettings) -> dict[str, Any]:
    """A probe, and where its signals are: sample n of a line is at origin + n sample_mm direction, in its frame."""
    step_mm = sample_mm(probe, settings)
    return {
        **probe.to_dict(), "sample_mm": step_mm, "sampling_mhz": 5e-4 * settings.reference_speed_m_s / step_mm,
        "samples_per_cycle": settings.samples_per_cycle,
        "origins_mm": probe.origins_mm().tolist(), "directions": probe.directions().tolist(),
    }  # fmt: skip


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _listed(lines: Iterable[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)
