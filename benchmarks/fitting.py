"""Accuracy of the appearance optimisation on twins: simulated patients with known parameters (twins.py).

    python -m benchmarks.fitting twins         # 14 patients: cost, parameters, errors; the paper's Table 1
    python -m benchmarks.fitting algorithms    # nlopt's global and local algorithms
    python -m benchmarks.fitting ablation      # the local measure against global histogram and difference
    python -m benchmarks.fitting registration  # a 4 mm and 4 degree offset, recovered
    python -m benchmarks.fitting evaluation    # milliseconds of one evaluation against one frame

Every table is markdown; --patients N takes the first N, --device chooses the device, --json FILE keeps the numbers.
"""

from __future__ import annotations

import argparse
import warnings
from dataclasses import replace
from time import perf_counter

import numpy as np

from benchmarks.measuring import measured, output_file
from benchmarks.twins import TISSUE, Twin, make_twin
from SlicerUSSim.Logic import DisplaySettings, TissueTable, Volume, optimize_appearance, segment_mri
from SlicerUSSim.Logic.base import write_json
from SlicerUSSim.Logic.fitting import AppearanceModel, FreeParameters, SimilaritySettings
from SlicerUSSim.Logic.fitting.identifiability import variance_db
from SlicerUSSim.Logic.fitting.optimization import AppearanceCost
from SlicerUSSim.Logic.fitting.registration import rigid_from, rotation_deg
from SlicerUSSim.Logic.fitting.report import grey_levels_per_tissue
from SlicerUSSim.Logic.fitting.tracked_fit import fit, simulated
from SlicerUSSim.Logic.imaging import TreeOverflowWarning
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.probe import ImageGrid
from SlicerUSSim.Logic.tracked import TrackedImages

#: Poor starting points of the search.
FAR = {
    "too bright": DisplaySettings(gain_db=18, dynamic_range_db=75, tgc_db_cm_mhz=0.9),
    "too dark": DisplaySettings(gain_db=-20, dynamic_range_db=40, tgc_db_cm_mhz=0.1),
}
ALGORITHMS = [
    ("G_MLSL_LDS", "LN_BOBYQA"), ("GN_DIRECT_L", "LN_BOBYQA"), ("GN_CRS2_LM", "LN_BOBYQA"), ("GN_ISRES", "LN_BOBYQA"),
    ("GN_ESCH", "LN_BOBYQA"), ("GN_DIRECT_L", "LN_NELDERMEAD"), ("GN_DIRECT_L", "LN_SBPLX"), (None, "LN_BOBYQA"),
    (None, "LN_NELDERMEAD"), (None, "LN_SBPLX"), (None, "LN_COBYLA"),
]  # fmt: skip
MEASURES = {
    "the paper's: local histograms + SAD": SimilaritySettings(),
    "local histograms alone": SimilaritySettings(sad_weight=0.0),
    "global histogram": SimilaritySettings(patch_mm=1e5, sad_weight=0.0),
    "SAD alone": SimilaritySettings(histogram_weight=0.0),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("what", choices=["twins", "algorithms", "ablation", "registration", "evaluation"])
    parser.add_argument("--patients", type=int, default=14)
    parser.add_argument("--device")
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", TreeOverflowWarning)
    segmentation = segment_mri(demo_mri()[0], device=arguments.device, thin_sulci=False)
    tissues = TissueTable.brain(segmentation.tissue_names)
    run = {
        "twins": twins, "algorithms": algorithms, "ablation": ablation, "registration": registration,
        "evaluation": evaluation,
    }[arguments.what]  # fmt: skip
    result = run(segmentation.labels, tissues, arguments.patients, arguments.device)
    if arguments.json:
        write_json(arguments.json, result)


def twins(labels: Volume, tissues: TissueTable, patients: int, device) -> dict:
    """Two experiments: with the display known, and with everything free."""
    results = {}
    for title, known in (("Display known, white matter free", True), ("Display and white matter free", False)):
        rows = [fitted(make_twin(labels, tissues, n, display_is_known=known, device=device), known)
                for n in range(patients)]  # fmt: skip
        results[title] = rows
        print(f"\n### {title}\n")
        columns = ["cost before", "cost after", "histograms per tissue before", "after", "alpha true", "alpha found",
                   "mu0", "sigma0", "mu1", "error alpha", "error Var dB", "error Var re grey dB",
                   "error net attenuation", "seconds"]  # fmt: skip
        table(["patient", *columns], [[n, *(row[name] for name in columns)] for n, row in enumerate(rows)])
        print(f"\nspread (sd over restarts, mean of all patients): {mean_spread(rows)}")
    return results


def fitted(twin: Twin, display_is_known: bool, settings: SimilaritySettings | None = None) -> dict:
    """One patient: costs, parameters, errors."""
    free = [TISSUE] if display_is_known else ["display", TISSUE]
    result = optimize_appearance(
        twin.simulator, twin.probe, twin.poses, twin.references, free=free, display=twin.display, max_evaluations=500,
        settings=settings,
    )  # fmt: skip
    found, true = white(result.tissues), white(twin.true_tissues)
    tgc = result.display.tgc_db_cm_mhz - twin.true_display.tgc_db_cm_mhz
    alpha = found.attenuation_db_cm_mhz - true.attenuation_db_cm_mhz
    tracked = as_tracked(twin)
    real = grey_levels_per_tissue(tracked, twin.references, twin.simulator)
    before, after = (
        histogram_distance(grey_levels_per_tissue(tracked, images, twin.simulator), real)
        for images in (
            simulated(twin.simulator, tracked, twin.simulator.medium.tissues, twin.display),
            simulated(twin.simulator, tracked, result.tissues, result.display),
        )
    )
    return {
        "cost before": result.cost_before,
        "cost after": result.cost_after,
        "histograms per tissue before": before,
        "after": after,
        "alpha true": true.attenuation_db_cm_mhz,
        "alpha found": found.attenuation_db_cm_mhz,
        "mu0": found.mu0,
        "sigma0": found.sigma0,
        "mu1": found.mu1,
        "error alpha": alpha,
        "error Var dB": variance_db(found) - variance_db(true),
        # The same value, since grey matter is not free here; it can be determined even if the gain is unknown.
        "error Var re grey dB": variance_db(found) - variance_db(true),
        "error net attenuation": alpha - tgc,
        "error gain dB": result.display.gain_db - twin.true_display.gain_db,
        "error dynamic range dB": result.display.dynamic_range_db - twin.true_display.dynamic_range_db,
        "seconds": result.seconds,
        "spread": {s.name: s.standard_deviation for s in result.identifiability.spreads},
    }


def algorithms(labels: Volume, tissues: TissueTable, patients: int, device) -> dict:
    """Cost reached within 500 evaluations, from the presets and from poor starting points."""
    starts = {"preset": None, **FAR}
    results = {f"{g} then {local}" if g else local: {name: [] for name in starts} for g, local in ALGORITHMS}
    for number in range(patients):
        twin = make_twin(labels, tissues, number, device=device)
        for (global_name, local_name), name in ((pair, name) for pair in ALGORITHMS for name in starts):
            result = optimize_appearance(
                twin.simulator, twin.probe, twin.poses, twin.references, free=["display", TISSUE],
                display=starts[name] or twin.display, max_evaluations=500, restarts=0,
                algorithms=(global_name, local_name),
            )  # fmt: skip
            key = f"{global_name} then {local_name}" if global_name else local_name
            results[key][name].append((result.cost_after, len(result.history)))
    best = [min(entry[name][n][0] for entry in results.values() for name in starts) for n in range(patients)]
    print("\nCost above the best that any found, mean (worst) over the patients; evaluations\n")
    rows = []
    for key, entry in results.items():
        above = {name: np.array([cost for cost, _ in entry[name]]) - best for name in starts}
        everything = np.concatenate(list(above.values()))
        counts = np.mean([count for name in starts for _, count in entry[name]])
        cells = [f"{values.mean():.4f} ({values.max():.4f})" for values in (*above.values(), everything)]
        rows.append([key, *cells, round(counts)])
    table(["algorithms", *starts, "all", "evaluations"], rows)
    return results


def ablation(labels: Volume, tissues: TissueTable, patients: int, device) -> dict:
    """Accuracy with other similarity measures."""
    results = {}
    for name, settings in MEASURES.items():
        results[name] = [fitted(make_twin(labels, tissues, n, device=device), False, settings) for n in range(patients)]
    print("\nRoot mean square (largest) errors over the patients, display and white matter free\n")
    names = ["error alpha", "error net attenuation", "error Var dB", "error gain dB", "error dynamic range dB", "after"]
    rows = []
    for measure, found in results.items():
        values = {name: np.abs([row[name] for row in found]) for name in names}
        rows.append([measure, *(f"{np.sqrt((v**2).mean()):.3f} ({v.max():.3f})" for v in values.values())])
    table(["measure", *names[:-1], "histograms per tissue"], rows)
    return results


def registration(labels: Volume, tissues: TissueTable, patients: int, device) -> dict:
    """An offset of 4 mm and 4 degrees, in another direction for each patient, recovered from two crossing sweeps.

    Planes that are nearly parallel leave a rotation open.
    """
    rows, results = [], []
    for number in range(patients):
        twin = make_twin(labels, tissues, number, crossing=True, device=device)
        random = np.random.default_rng(number)
        shift, turn = (4.0 * v / np.linalg.norm(v) for v in random.normal(size=(2, 3)))
        middle = np.mean([(pose @ [0.0, 0.5 * twin.probe.depth_mm, 0.0, 1.0])[:3] for pose in twin.poses], axis=0)
        about = np.eye(4)
        about[:3, 3] = middle
        offset = about @ rigid_from([*shift, *turn]) @ np.linalg.inv(about)
        moved = [np.linalg.inv(offset) @ pose for pose in twin.poses]
        tracked = replace(as_tracked(twin), poses=moved)
        start = perf_counter()
        found = fit(
            twin.simulator, tracked, free=["display", TISSUE], display=twin.display, register=True, restarts=0
        ).registration
        assert found is not None, "it was asked for"
        left = found.correction @ np.linalg.inv(offset)
        error_mm = float(np.linalg.norm((left @ [*middle, 1.0])[:3] - middle))
        result = {
            "error mm": error_mm, "error deg": rotation_deg(left), "cost before": found.cost_before,
            "cost after": found.cost_after, "evaluations": len(found.history), "seconds": perf_counter() - start,
        }  # fmt: skip
        results.append(result)
        rows.append([number, *result.values()])
    table(["patient", *results[0]], rows)
    good = sum(row["error mm"] <= 1.0 and row["error deg"] <= 1.0 for row in results)
    print(f"\nwithin 1 mm and 1 degree: {good} of {patients}")
    return {"patients": results}


def evaluation(labels: Volume, tissues: TissueTable, patients: int, device) -> dict:
    """Time of one evaluation per image, compared with one frame, in one run."""
    twin = make_twin(labels, tissues, 0, frames=1, device=device)
    simulator, cases = twin.simulator, {"display": ["display"], "display, mu0, sigma0": ["display", "white matter.mu0",
        "white matter.sigma0"], "display, mu0, sigma0, mu1, alpha": ["display", TISSUE]}  # fmt: skip

    def frame() -> None:
        simulator.forget_echoes()
        simulator.simulate(twin.probe, twin.poses[0], twin.display)

    results = {"frame": best_ms(frame)}
    for name, free in cases.items():
        parameters = FreeParameters.of(free, tissues, twin.display)
        model = AppearanceModel(simulator, twin.probe, twin.poses, parameters.varied())
        cost = AppearanceCost(
            model, parameters, twin.references, None, tissues, twin.display, SimilaritySettings()
        )  # fmt: skip
        random = np.random.default_rng(0)
        results[name] = best_ms(lambda c=cost, p=parameters, r=random: c(r.random(len(p))))
        results[f"bases: {name}"] = best_ms(lambda m=model: (m.anchor(tissues), m.device.queue.finish()), 5)
    print(f"\n{simulator.device.info}\n")
    table(["", "best ms", "median ms"], [[name, *values] for name, values in results.items()])
    return results


def best_ms(function, repeat: int = 40) -> tuple[float, ...]:
    """(best, median) milliseconds."""
    return tuple(measured(function, repeat).values())


def white(tissues: TissueTable):
    """The fitted tissue."""
    return tissues[tissues.label_of(TISSUE)]


def as_tracked(twin: Twin) -> TrackedImages:
    """The twin's images as from a tracked sequence."""
    found = TrackedImages.of(twin.sequence(), probe=twin.probe)
    grid = ImageGrid.for_probe(twin.probe, None)
    mask = grid.field(twin.probe)
    return replace(found, images=twin.references, grid=grid, mask=mask)


def histogram_distance(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> float:
    """Mean over tissues of sqrt(1 - Bhattacharyya coefficient) of 32-bin grey-level histograms."""
    distances = []
    for name, pixels in theirs.items():
        if pixels.size >= 1000:
            p, q = (np.bincount(v // 8, minlength=32) / v.size for v in (pixels, ours[name]))
            distances.append(np.sqrt(max(1.0 - np.sqrt(p * q).sum(), 0.0)))
    return float(np.mean(distances))


def mean_spread(rows: list[dict]) -> str:
    names = rows[0]["spread"]
    means = {name: np.nanmean([row["spread"][name] for row in rows]) for name in names}
    return ", ".join(f"{name} {value:.3f}" for name, value in means.items())


def table(heads: list[str], rows: list[list]) -> None:
    """Print markdown; columns of numbers get their mean and standard deviation, as in the paper's Table 1."""
    text = [
        [f"{cell:.{2 if abs(cell) >= 100 else 3}f}" if isinstance(cell, float) else str(cell) for cell in row]
        for row in rows
    ]
    if len(rows) > 2 and heads[0] == "patient":
        values = np.array([row[1:] for row in rows], float)
        text.append(["**mean**", *(f"**{v:.3f}**" for v in values.mean(axis=0))])
        text.append(["sd", *(f"{v:.3f}" for v in values.std(axis=0, ddof=1))])
    for line in (heads, ["---"] * len(heads), *text):
        print("| " + " | ".join(line) + " |")


if __name__ == "__main__":
    main()
