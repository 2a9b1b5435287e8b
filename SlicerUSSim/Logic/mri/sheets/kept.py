"""Sheets kept beside their MRI, so that the search runs once."""

from __future__ import annotations

import json
import logging
import zipfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.files import named_beside, written_whole
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.kept_mask import fingerprint_of, keep_file
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


def read_kept_sheets(path: Path, key: str, kinds: tuple[str, ...]) -> tuple[Surfels, np.ndarray] | None:
    """(surfels, structures) if all `kinds` are kept for this key; None if not."""
    found = _read(path)
    if found is None or found[0]["key"] != key or not _holds(set(found[0]["kinds"]), set(kinds)):
        return None
    return found[1:]


def keep_sheets(path: Path, key: str, kinds: tuple[str, ...], surfels: Surfels, structures: np.ndarray) -> str:
    """Write them as keep_file does, also over others that were kept; returns one line about it."""
    head = json.dumps({"key": key, "kinds": kinds})
    is_ours = _read(path) is not None
    write = lambda place: _write(place, head, surfels, structures)  # noqa: E731
    return keep_file(path, "the file of the sheets", write, replaces=is_ours)


def _read(path: Path) -> tuple[dict[str, Any], Surfels, np.ndarray] | None:
    """(what they depend on, surfels, structures) of a file by keep_sheets; None for another, and for none."""
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            surfels = Surfels(**{entry.name: file[entry.name] for entry in fields(Surfels)})
            return json.loads(str(file["ussim_sheets"])), surfels, file["structures"]
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, SimulationError) as error:
        _log.info("%s: is not used as kept sheets (%s)", path, error)
    return None


def _write(path: Path, head: str, surfels: Surfels, structures: np.ndarray) -> None:
    arrays = {entry.name: getattr(surfels, entry.name) for entry in fields(surfels)}
    with written_whole(path) as partial:
        np.savez_compressed(partial, ussim_sheets=np.array(head), structures=structures, **arrays)


def _holds(kept: set[str], wanted: set[str]) -> bool:
    """Whether what is wanted is part of what is kept. Sulci beside the dura are left out where that is found, too."""
    dura = {"falx", "tentorium"}
    return wanted <= kept and ("sulcus" not in wanted or wanted & dura == kept & dura)
