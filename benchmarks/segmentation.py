"""Segmentation of MRIs, every data set and method side by side: Dice with the truth, calibration, seconds.

    python -m benchmarks.segmentation tissues             # phantoms of MNI152 and Colin27; 10 to 20 minutes
    python -m benchmarks.segmentation tissues --data ring --methods "segment_mri"       # a part of it
    python -m benchmarks.segmentation tissues --label-map aseg.nii.gz                   # phantoms of other brains
    python -m benchmarks.segmentation tissues --scan T1.nii.gz aseg.nii.gz              # a scan labelled by others
    python -m benchmarks.segmentation parts --label-map aseg.nii.gz                     # of these phantoms, bias field
    python -m benchmarks.segmentation brains --head HEAD.nii.gz [--head ...]            # brain extraction; minutes each
    python -m benchmarks.segmentation patients            # ReMIND-022: T1, T2, both; shares and hemispheres

Every table is markdown; --json FILE keeps the numbers, and --pictures FOLDER writes a picture of every case.
Methods that are not installed (antspyx, brainextractor) are left out with a message.
Names of data: mni152, colin27, ring; a part of a case's name selects too, as "7% noise" or "tight".
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Any, cast

import numpy as np
from scipy import ndimage

from benchmarks.brain_extraction import SHARED, measure_brains
from benchmarks.labelled_brains import labelled_scan, maps_of_labels
from benchmarks.measuring import output_file
from benchmarks.segmentation_controls import atropos, plain_mixture, true_thresholds
from SlicerUSSim.Logic import Volume, segment_mri
from SlicerUSSim.Logic.base import write_json
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.mri.bias import without_bias
from validation.brain_phantoms import (
    PARTS,
    BrainPhantom,
    TissueMaps,
    part_of,
    phantom,
    tissue_maps,
    with_ring_tumour,
)
from validation.brain_scores import calibration, scores

#: (noise, bias) of the phantoms
QUALITIES = ((0.03, 0.0), (0.03, 0.2), (0.07, 0.2))
TISSUES = ("csf", "grey matter", "white matter", "grey and white")


# ---- tissues ---------------------------------------------------------------------------------------------------------


def maps_of(brain: str, files: dict[str, Path]) -> TissueMaps:
    """The maps of a brain of the package, also warped, or of a label map."""
    if brain in files:
        return maps_of_labels(Volume.read(files[brain]), brain)
    found = tissue_maps(brain.split()[0])
    require(found, f"{brain} is not installed")
    found = cast(TissueMaps, found)
    return found.warped() if brain.endswith("warped") else found


def cases(arguments: argparse.Namespace) -> Iterator[tuple[str, Callable[[], tuple[BrainPhantom, str]]]]:
    """(name, function that makes the phantom and says its contrast) of every case."""
    files = {path.name.split(".")[0]: path for path in arguments.label_map}
    for brain in ("mni152", "mni152 warped", "colin27", *files):
        for mask in ("full", "tight"):
            for noise, bias in QUALITIES:
                yield (
                    f"{brain}, {noise:.0%} noise, {bias:.0%} bias, {mask} mask",
                    lambda b=brain, n=noise, f=bias, m=mask: (
                        phantom(maps_of(b, files), noise=n, bias=f, mask=m),
                        "t1",
                    ),
                )
            if brain in ("mni152", "colin27"):
                yield (
                    f"{brain}, ring tumour, 3% noise, 20% bias, {mask} mask",
                    lambda b=brain, m=mask: (phantom(with_ring_tumour(maps_of(b, files)), "t1gd", mask=m), "t1gd"),
                )
    for image, labels in arguments.scan:
        name = Path(image).name.split(".")[0] + ", scan"
        yield name, lambda i=image, t=labels, n=name: (labelled_scan(Volume.read(i), Volume.read(t), n), "t1")


def ours(case: BrainPhantom, contrast: str, **changes):
    """segment_mri with its defaults."""
    found = segment_mri(case.mri, contrast=contrast, mask=case.mask, **changes, thin_sulci=False)
    return found.labels.array, dict(enumerate(found.tissue_names, start=1)), found.posteriors


def ours_smoothed(case: BrainPhantom, contrast: str):
    """segment_mri without its filter, after Gaussian smoothing inside the mask."""
    inside = (case.mask.array > 0).astype(np.float32)
    share = np.maximum(ndimage.gaussian_filter(inside, 0.6), 1e-3)
    smooth = np.where(inside > 0, ndimage.gaussian_filter(case.mri.array * inside, 0.6) / share, 0.0)
    found = segment_mri(
        case.mri.with_array(smooth), contrast=contrast, mask=case.mask, filter_radius=0, thin_sulci=False
    )
    return found.labels.array, dict(enumerate(found.tissue_names, start=1)), found.posteriors


METHODS = {
    "true thresholds": true_thresholds,
    "smoothed, true thresholds": lambda case, contrast: true_thresholds(case, contrast, smooth=0.6),
    "plain mixture": plain_mixture,
    "Atropos": atropos,
    "N4 + Atropos": lambda case, contrast: atropos(case, contrast, n4=True),
    "segment_mri": ours,
    "segment_mri, Gaussian": ours_smoothed,
}


def measure_tissues(arguments: argparse.Namespace) -> list[dict]:
    rows = []
    print("| data | method | CSF | grey | white | grey and white | enhancing | of those given 70 %, right | s |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for name, make in cases(arguments):
        if arguments.data and not any(part in name for part in arguments.data):
            continue
        try:
            case, contrast = make()
        except SimulationError as error:
            print(f"| {name} | {error} |", flush=True)
            continue
        pictures = {}
        for method, function in METHODS.items():
            if arguments.methods and method not in arguments.methods:
                continue
            if method == "Atropos" and " 0% bias" not in name:
                continue  # with a bias field it is only worse
            if "true thresholds" in method and np.isnan(case.noise):
                continue  # they are unknown in a scan
            known = [row for row in arguments.reuse if (row["data"], row["method"]) == (name, method)]
            if known and not method.startswith("segment_mri"):
                rows += known
                print(tissue_line(known[0]), flush=True)
                continue
            start = perf_counter()
            try:
                labels, names, *posteriors = function(case, contrast)
            except SimulationError as error:
                print(f"| {name} | {method}: {error} |", flush=True)
                continue
            seconds = perf_counter() - start
            row = {"data": name, "method": method, **scores(labels, names, case), "seconds": seconds}
            if posteriors:
                row["calibration"] = list(calibration(posteriors[0], names, case))
            rows.append(row)
            if arguments.json:
                write_json(arguments.json, {"tissues": rows})  # a run of hours may be ended
            print(tissue_line(row), flush=True)
            pictures[method] = labels
        if arguments.pictures:
            picture(arguments.pictures / f"{name.replace(', ', '-').replace(' ', '-')}.png", case, pictures)
    return rows


def tissue_rows(file: str) -> list[dict]:
    """The rows of an earlier run of this version, as controls take minutes and are deterministic."""
    return json.loads(Path(file).read_text(encoding="utf-8"))["tissues"]


def tissue_line(row: dict) -> str:
    near = [(right, count) for stated, right, count in row.get("calibration", ()) if 0.6 <= stated < 0.8]
    seventy = f"{sum(r * n for r, n in near) / sum(n for _, n in near):.0%}" if near else ""
    numbers = [f"{row[tissue]:.3f}" if tissue in row else "" for tissue in (*TISSUES, "enhancing")]
    return f"| {row['data']} | {row['method']} | {' | '.join(numbers)} | {seventy} | {row['seconds']:.1f} |"


def picture(path: Path, case: BrainPhantom, found: dict[str, np.ndarray]) -> None:
    """A slice of the image, the truth, and every method's labels."""
    import matplotlib.pyplot as plt
    from matplotlib.colors import ListedColormap

    colours = ListedColormap(["black", "#4a7fb5", "#8f8f8f", "#f2ead8", "#d0483e", "#5b3a6e", "#7fae6a"])
    panels = {"MRI": case.mri.array, "truth": case.truth.array, **found}
    middle = int(np.median(np.nonzero(case.mask.array)[0])) + 8
    figure, axes = plt.subplots(1, len(panels), figsize=(2.6 * len(panels), 3.2))
    for axis, (title, array) in zip(np.atleast_1d(axes), panels.items(), strict=True):
        plane = array[middle][::-1] if case.mri.ijk_to_ras[1, 1] > 0 else array[middle]
        if title == "MRI":
            axis.imshow(plane, cmap="gray")
        else:
            axis.imshow(plane, cmap=colours, vmin=0, vmax=6, interpolation="nearest")
        axis.set_title(title, fontsize=9)
        axis.axis("off")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


# ---- parts ----------------------------------------------------------------------------------------------------------


def measure_parts(arguments: argparse.Namespace) -> list[dict]:
    """Mean Dice of grey and white matter in parts of phantoms (brain_phantoms.PARTS), whose field no atlas leads."""
    rows = []
    print("| data | field left in | N4 | segment_mri |")
    print("|---|---|---|---|", flush=True)
    files = {path.name.split(".")[0]: path for path in arguments.label_map}
    for brain, bias in itertools.product(("mni152 warped", "colin27", *files), (0.0, 0.05, 0.1, 0.2)):
        named = {f"{brain}, {part}, {bias:.0%} bias": part for part in PARTS}
        wanted_data = [name for name in named if not arguments.data or any(text in name for text in arguments.data)]
        whole = phantom(maps_of(brain, files), noise=0.03, bias=bias, seed=3) if wanted_data else None
        for name in wanted_data:
            case = part_of(cast(BrainPhantom, whole), named[name])
            inside = case.mask.array > 0
            n4 = case.mri.with_array(without_bias(case.mri, inside, lambda share: None))
            row: dict[str, Any] = {"data": name}
            for method, mri, wanted in (
                ("none", case.mri, False),
                ("N4", n4, False),
                ("segment_mri", case.mri, None),
            ):
                found = segment_mri(mri, contrast="t1", mask=case.mask, bias_correction=wanted, thin_sulci=False)
                names = dict(enumerate(found.tissue_names, start=1))
                row[method] = scores(found.labels.array, names, case)["grey and white"]
            rows.append(row)
            print(f"| {name} | {row['none']:.3f} | {row['N4']:.3f} | {row['segment_mri']:.3f} |", flush=True)
    return rows


# ---- patients --------------------------------------------------------------------------------------------------------


def measure_patients(arguments: argparse.Namespace) -> list[dict]:
    """Shares of ReMIND-022, which has no truth, from T1, T2 and both, and how far its hemispheres differ."""
    folder = SHARED / "remind022"
    rows: list[dict] = []
    if not folder.is_dir():
        print(f"{folder} is not here")
        return rows
    t1, t2 = Volume.read(folder / "t1_contrast.nii.gz"), Volume.read(folder / "t2.nii.gz")
    print("| MRI | shares of the brain | grey, right of left | white, right of left | ml | s |")
    print("|---|---|---|---|---|---|", flush=True)
    for name, mri, contrast, others in (
        ("T1 with contrast", t1, "t1gd", {}),
        ("T2", t2, "t2", {}),
        ("both", t1, "t1gd", {"t2": t2}),
    ):
        if arguments.data and not any(part == name for part in arguments.data):
            continue
        keep_at = arguments.keep / f"remind022-{contrast}-mask.nii.gz" if arguments.keep else None
        more: dict[str, Any] = {"others": others} if others else {}
        start = perf_counter()
        try:
            found = segment_mri(mri, contrast=contrast, keep_mask_at=keep_at, **more, thin_sulci=False)
        except (SimulationError, TypeError) as error:
            print(f"| {name} | {error} |", flush=True)
            continue
        seconds = perf_counter() - start
        labels, names = found.labels.array, found.tissue_names
        share = {tissue: float((labels == n).sum() / (labels > 0).sum()) for n, tissue in enumerate(names, start=1)}
        halves = hemispheres(labels > 0, found.labels.ijk_to_ras)
        ratio = {}
        for tissue in ("grey matter", "white matter"):
            here = labels == names.index(tissue) + 1
            ratio[tissue] = float((here & (halves > 0)).sum() / max((here & (halves < 0)).sum(), 1))
        rows.append({"mri": name, "shares": share, "right of left": ratio, "seconds": seconds})
        text = ", ".join(f"{tissue} {value:.0%}" for tissue, value in share.items())
        sides = " | ".join(f"{value:.3f}" for value in ratio.values())
        print(f"| {name} | {text} | {sides} | {found.brain.volume_ml:.0f} | {seconds:.0f} |", flush=True)
        if arguments.keep:
            found.labels.write(arguments.keep / f"remind022-{name.replace(' ', '-')}-labels.nii.gz")
    return rows


def hemispheres(mask: np.ndarray, ijk_to_ras: np.ndarray) -> np.ndarray:
    """(k, j, i) 1 right and -1 left of the plane through the middles of the brain's extent from left to right."""
    k, j, i = np.nonzero(mask)
    ras = np.stack([i, j, k, np.ones_like(i)]).T @ ijk_to_ras.T[:, :3]
    across = {}
    for cell, x in zip(map(tuple, np.round(ras[::7, 1:] / 4.0).astype(int)), ras[::7, 0], strict=True):
        low, high = across.get(cell, (x, x))
        across[cell] = min(low, x), max(high, x)
    cells = np.array(list(across), float) * 4.0
    ends = np.array(list(across.values()))
    wide = np.ptp(ends, axis=1) > 60.0
    ground = np.column_stack([cells[wide], np.ones(wide.sum())])
    plane = np.linalg.lstsq(ground, ends[wide].mean(axis=1), rcond=None)[0]
    side = np.zeros(mask.shape, np.int8)
    side[k, j, i] = np.where(ras[:, 0] > ras[:, 1:] @ plane[:2] + plane[2], 1, -1)
    return side


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("what", choices=("tissues", "parts", "brains", "patients"), nargs="+")
    parser.add_argument("--data", nargs="+", default=[], help="parts of the names of cases (default: all)")
    parser.add_argument("--methods", nargs="+", default=[], help="names of methods as in the table (default: all)")
    parser.add_argument("--label-map", type=Path, nargs="+", default=[], help="with FreeSurfer's values")
    parser.add_argument("--scan", nargs=2, action="append", default=[], metavar=("MRI", "LABELS"))
    parser.add_argument("--head", action="append", default=[], help="a whole head for brains")
    parser.add_argument("--json", type=output_file)
    parser.add_argument(
        "--reuse", type=tissue_rows, default=[], help="a file of --json, whose rows of other methods are taken over"
    )
    parser.add_argument("--pictures", type=Path, help="folder")
    parser.add_argument("--keep", type=Path, help="folder for masks and labels")
    arguments = parser.parse_args()
    if arguments.keep:
        arguments.keep.mkdir(parents=True, exist_ok=True)
    measures = {
        "tissues": measure_tissues, "parts": measure_parts, "brains": measure_brains, "patients": measure_patients
    }  # fmt: skip
    results = {}
    for what in arguments.what:
        print(f"\n{what}\n")
        results[what] = measures[what](arguments)
    if arguments.json:
        write_json(arguments.json, results)


if __name__ == "__main__":
    main()
