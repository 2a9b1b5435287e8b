"""Manifest and datasheet of a set: what is in it, what it was made of and by, and what is missing."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from SlicerUSSim.Logic.base.files import read_json, write_json, written_whole
from SlicerUSSim.Logic.base.version import __version__
from SlicerUSSim.Logic.datasets.prepared import CLASSES, load, prepared_path
from SlicerUSSim.Logic.datasets.recipe import BUNDLED, OUTPUTS, Recipe
from SlicerUSSim.Logic.datasets.writers import record_path
from SlicerUSSim.Logic.tissue.presets import TISSUES

MANIFEST = "manifest.json"
_MNI = (
    "MNI152 2009a nonlinear symmetric (Fonov et al., NeuroImage 54, 2011), by way of nilearn; "
    "Copyright (C) 1993-2009 Louis Collins, McConnell Brain Imaging Centre, Montreal Neurological Institute"
)
#: (licence, citation) of the bundled patients
_SOURCES = {BUNDLED[0]: ("as in mni152.txt of the package", _MNI), BUNDLED[1]: ("Apache-2.0", "drawn by SlicerUSSim")}
_LIBRARIES = ("numpy", "pyopencl", "zarr", "h5py", "distributed")


def write_datasheet(recipe: Recipe, out: Path, skipped: Mapping[str, str]) -> None:
    """Write manifest.json and README.md of what is in the folder."""
    for rest in out.glob("images.zarr/**/*.partial"):  # of workers that were killed
        rest.unlink(missing_ok=True)
    shards: dict[str, dict] = {}
    devices, makers, warnings, tissues = set(), set(), set(), {"coupling"}
    for shard in range(recipe.shards):
        if record_path(out, shard).exists():
            record = read_json(record_path(out, shard), most_bytes=2**30)
            shards[str(shard)] = {name: record[name] for name in ("images", "patient", "case", "checksums")}
            devices.add(record["device"])
            makers.add(record["version"])
            warnings |= set(record["warnings"])
            tissues |= set(record["tissues"])
    digest = hashlib.sha256(json.dumps([one["checksums"] for one in shards.values()]).encode()).hexdigest()
    made = sum(end - start for start, end in (one["images"] for one in shards.values()))
    settings = recipe.settings
    manifest = {
        "title": settings.title, "licence": settings.licence, "seed": settings.seed, "format": settings.format,
        "images": settings.images, "made": made, "shard": recipe.shard, "checksum": digest,
        "recipe_sha256": hashlib.sha256(recipe.text.encode()).hexdigest(),
        "outputs": {name: OUTPUTS[name] for name in settings.outputs},
        "labels": {str(n): name for n, name in enumerate(CLASSES) if name in tissues},
        "patients": _patients(recipe, out, skipped),
        "made_by": sorted(makers), "devices": sorted(devices), "versions": _versions(),
        "warnings": sorted(warnings), "shards": shards,
    }  # fmt: skip
    write_json(out / MANIFEST, manifest)
    with written_whole(out / "README.md") as partial:
        partial.write_text(_page(recipe, manifest), encoding="utf-8")


def _patients(recipe: Recipe, out: Path, skipped: Mapping[str, str]) -> list[dict[str, Any]]:
    found = []
    for number, patient in enumerate(recipe.patients):
        licence, citation = _SOURCES.get(patient.file, ("", ""))
        there = prepared_path(out, number).exists()
        found.append({
            "file": patient.file, "sha256": load(out, number).digest if there else "",
            "licence": patient.licence or licence, "citation": patient.citation or citation,
            "missing_because": skipped.get(patient.file, ""),
        })  # fmt: skip
    return found


def _versions() -> dict[str, str]:
    found = {"SlicerUSSim": __version__, "Python": platform.python_version(), "system": platform.platform()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _page(recipe: Recipe, manifest: Mapping[str, Any]) -> str:
    settings = recipe.settings
    missing = {one["file"]: one["missing_because"] for one in manifest["patients"] if one["missing_because"]}
    sources = [
        f"- `{one['file']}`: {one['citation'] or 'no citation given'}; licence: {one['licence'] or 'not given'}"
        for one in manifest["patients"]
    ]
    lines = [
        f"# {settings.title}", "",
        f"{manifest['made']} of {settings.images} B-mode images, simulated by SlicerUSSim "
        f"{', '.join(manifest['made_by'])} from the recipe `recipe.toml` with seed {settings.seed}. No scanner "
        "measured them: test on real images what you train on these.",
        "", f"Licence: {settings.licence or 'not given; that of the sources applies'}", "", "## Content", "",
        *(f"- `{name}`: {about}" for name, about in manifest["outputs"].items()),
        "- `pose`: (4, 4) from the probe to the patient, RAS mm",
        "- `image_to_probe`: (4, 4) from (column, row, 0, 1) to the probe's mm",
        "- `shards/*.json`: parameters drawn for each image, and the SHA-256 of its arrays",
        "", f"Format: {settings.format}, {recipe.shard} images in a shard. Labels: places in `labels` of `{MANIFEST}`: "
        + ", ".join(f"{number} {name}" for number, name in manifest["labels"].items()) + ".",
        "", "## Sources", "", *sources, "", "Acoustic values of tissues: with their sources in SlicerUSSim "
        f"({len(TISSUES)} presets).", "", "## Made on", "", *(f"- {device}" for device in manifest["devices"]),
        f"- checksum of all arrays: `{manifest['checksum']}`",
    ]  # fmt: skip
    if missing:
        lines += ["", "## Missing", "", *(f"- `{file}`: {why}" for file, why in missing.items())]
    if manifest["warnings"]:
        lines += ["", "## Warnings", "", *(f"- {line}" for line in manifest["warnings"])]
    return "\n".join(lines) + "\n"
