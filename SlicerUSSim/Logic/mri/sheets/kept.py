"""Sheets kept beside their MRI, so that they are looked for once."""

from __future__ import annotations

import json
import logging
import zipfile
from dataclasses import fields
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.files import named_beside, written_whole
from SlicerUSSim.Logic.base.version import __version__
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.kept_mask import cache_folder, fingerprint_of, keep_file
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.tissue.surfels import Surfels

_log = logging.getLogger(__name__)
#: Raised where other sheets are found from the same image
_RECIPE = 3


def sheets_beside(mri_path: str | Path) -> Path:
    """The file of an MRI's sheets: head.nii.gz has head.sheets.npz."""
    return named_beside(mri_path, "sheets.npz")


def key_of(mri: Volume, segmentation: Segmentation, contrast: str) -> str:
    """What sheets depend on: the image, the brain in it, its contrast, and how they are found."""
    means = ",".join(f"{mean:.6g}" for mean in segmentation.means)
    return " ".join([fingerprint_of(mri), fingerprint_of(segmentation.brain.mask), contrast, means, str(_RECIPE)])


def read_kept_sheets(path: Path, key: str, kinds: tuple[str, ...]) -> tuple[Surfels, np.ndarray, Path] | None:
    """(surfels, structures, their file) if all `kinds` are kept for this key; None if not."""
    for place in (path, _in_cache(path, key)):
        if not place.is_file():
            continue
        try:
            with np.load(place, allow_pickle=False) as file:
                head = json.loads(str(file["ussim_sheets"]))
                if head["key"] != key or not _holds(set(head["kinds"]), set(kinds)):
                    continue
                arrays = {entry.name: file[entry.name] for entry in fields(Surfels)}
                surfels, structures = Surfels(**arrays), file["structures"]
                return surfels, structures, place
        except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, SimulationError) as error:
            _log.info("%s: is not used as kept sheets (%s)", place, error)
    return None


def keep_sheets(path: Path, key: str, kinds: tuple[str, ...], surfels: Surfels, structures: np.ndarray) -> str:
    """Write them to `path`, or to the user's cache folder as keep_file does; returns one line about it."""
    head = json.dumps({"key": key, "kinds": kinds, "version": __version__})
    return keep_file(
        path, _in_cache(path, key), "the sheets are", lambda place: _write(place, head, surfels, structures)
    ).text


def _write(path: Path, head: str, surfels: Surfels, structures: np.ndarray) -> None:
    arrays = {entry.name: getattr(surfels, entry.name) for entry in fields(surfels)}
    with written_whole(path) as partial:
        np.savez_compressed(partial, ussim_sheets=np.array(head), structures=structures, **arrays)


def _holds(kept: set[str], wanted: set[str]) -> bool:
    """Whether what is wanted is part of what is kept. Sulci beside the dura are left out where that is found, too."""
    dura = {"falx", "tentorium"}
    return wanted <= kept and ("sulcus" not in wanted or wanted & dura == kept & dura)


def _in_cache(path: Path, key: str) -> Path:
    return cache_folder() / "sheets" / f"{key.split()[0]}-{path.name}"
