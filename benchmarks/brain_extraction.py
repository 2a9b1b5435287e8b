"""Brain extraction: every method on every head, and how far they agree; called by benchmarks/segmentation.py."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
from time import perf_counter

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic import Volume
from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.mri.brain import find_brain
from validation.brain_phantoms import COLIN27
from validation.brain_scores import dice

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def brain_extractor(head: Volume) -> np.ndarray:
    """BET (Smith, Human Brain Mapping 17(3), 2002) by the package brainextractor."""
    import nibabel

    package = importlib.import_module("brainextractor")
    extractor = package.BrainExtractor(img=nibabel.Nifti1Image(head.array.astype(np.float32).T, head.ijk_to_ras))
    extractor.run()
    return np.asarray(extractor.mask).T > 0


def measure_brains(arguments: argparse.Namespace) -> list[dict]:
    heads: dict[str, tuple[Volume, Volume | None]] = {}
    if (COLIN27 / "ch2.nii.gz").exists():
        heads["Colin27"] = Volume.read(COLIN27 / "ch2.nii.gz"), Volume.read(COLIN27 / "ch2bet.nii.gz")
    for name, file in (("ReMIND-022 T1", "t1_contrast"), ("ReMIND-022 T2", "t2")):
        if (SHARED / f"remind022/{file}.nii.gz").exists():
            heads[name] = Volume.read(SHARED / f"remind022/{file}.nii.gz"), None
    heads |= {Path(path).name.split(".")[0]: (Volume.read(path), None) for path in arguments.head}
    rows = []
    print("| head | method | Dice with its own mask | filled | volume | s | agrees most with |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for name, (head, own) in heads.items():
        if arguments.data and not any(part.lower() in name.lower() for part in arguments.data):
            continue
        masks: dict[str, np.ndarray] = {}
        for method in ("atlas", "none", "BET"):
            if arguments.methods and method not in arguments.methods:
                continue
            start = perf_counter()
            try:
                mask = brain_extractor(head) if method == "BET" else find_brain(head, method).mask.array > 0
            except (SimulationError, ImportError) as error:
                print(f"| {name} | {method}: {error} |", flush=True)
                continue
            seconds = perf_counter() - start
            row = {"head": name, "method": method, "seconds": seconds}
            row["ml"] = float(mask.sum() * abs(np.linalg.det(head.ijk_to_ras[:3, :3])) / 1000.0)
            if own is not None:
                row["dice"] = dice(mask, own.array > 0)
                row["filled"] = dice(np.asarray(ndimage.binary_fill_holes(mask)), closed(own.array > 0))
            row["agreement"] = {other: dice(mask, theirs) for other, theirs in masks.items()}
            masks[method] = mask
            rows.append(row)
            with_truth = f"{row['dice']:.3f} | {row['filled']:.3f}" if own is not None else " | "
            best = ", ".join(f"{other} {value:.3f}" for other, value in row["agreement"].items())
            print(f"| {name} | {method} | {with_truth} | {row['ml']:.0f} ml | {seconds:.0f} | {best} |", flush=True)
            if arguments.keep:
                head.with_array(mask.astype(np.uint8)).write(
                    arguments.keep / f"{name.replace(' ', '-')}-{method}.nii.gz"
                )
    return rows


def closed(mask: np.ndarray) -> np.ndarray:
    """The mask with sulci of up to 10 mm closed and holes filled, as extraction methods draw it."""
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(np.pad(mask.astype(np.uint8), 8))
    image = sitk.BinaryFillhole(sitk.BinaryMorphologicalClosing(image, [5] * 3, sitk.sitkBall))
    return sitk.GetArrayFromImage(image)[8:-8, 8:-8, 8:-8] > 0
