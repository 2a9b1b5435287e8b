"""Rates of data sets, for docs/scale.md: python -m benchmarks.dataset_scale [IMAGES]

Of small drafts of the MNI152 brain: simulate_batch alone and sets in Zarr by this process and by two workers, in turn;
what an image costs beside simulate_batch, by part; then eight workers whose renderer is slowed down to that of a whole
machine, beside the model of docs/scale.md.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import time
from pathlib import Path
from time import perf_counter

import numpy as np

from SlicerUSSim.Logic.datasets import Recipe, make_dataset
from SlicerUSSim.Logic.datasets.making import render_task
from SlicerUSSim.Logic.datasets.patients import prepare, scene
from SlicerUSSim.Logic.datasets.rendering import Shot, render
from SlicerUSSim.Logic.datasets.writers import record_path, write_shard

#: Seconds that the slowed-down renderer takes for a shard, and its shards for each worker
SLOW_S, SHARDS_EACH = 2.0, 12


def batch_rate(recipe: Recipe, out: Path, images: int) -> float:
    """Images per second of simulate_batch with the inputs of the recipe's images, in shards."""
    made = scene(recipe, out, recipe.case_of(0))
    shots = [Shot.of(made, number) for number in range(images)]
    inputs = [(shot.probe, shot.pose, shot.display, shot.tissues, shot.settings) for shot in shots]
    shards = [inputs[first : first + recipe.shard] for first in range(0, images, recipe.shard)]
    began = perf_counter()
    for shard in shards:
        shard.sort(key=lambda one: hash(one[0]))
        probes, poses, displays, tables, settings = map(list, zip(*shard, strict=True))
        made.simulator.simulate_batch(
            probes, poses, display=displays, tissues=tables, settings=settings, outputs=recipe.settings.outputs
        )
    return images / (perf_counter() - began)


def set_rate(recipe: Recipe, patients: Path, workers: int) -> tuple[float, float]:
    """(images per second while shards are made, largest memory in MB of a process) of a set."""
    with tempfile.TemporaryDirectory() as name:
        shutil.copytree(patients, Path(name) / "patients")
        (Path(name) / "recipe.toml").write_text(recipe.text, encoding="utf-8")
        ends: list[tuple[float, int]] = []
        made = make_dataset(
            recipe, name, workers=workers, progress=lambda done: ends.append((perf_counter(), done.done))
        )
        (first, before), (last, after) = ends[max(workers - 1, 0)], ends[-1]
        return (after - before) / (last - first), made.peak_mb


def slowed_task(out: str, files: str, shard: int) -> float:
    """A shard of which nothing is computed: it takes SLOW_S, and has the arrays of the first one."""
    recipe = Recipe.read(Path(out) / "recipe.toml")
    time.sleep(SLOW_S)
    numbers = recipe.images_of(shard)
    arrays = {name: np.zeros((len(numbers), 128, 160), np.uint8) for name in ("image", "labels")}
    record = {"images": [numbers.start, numbers.stop], "patient": "mni152", "case": 0, "tissues": [], "version": "",
              "device": "none", "warnings": [], "parameters": []}  # fmt: skip
    write_shard(recipe, Path(out), shard, arrays, record)
    return 0.0


def eight_workers(recipe: Recipe) -> tuple[float, float]:
    """(images per second of eight slowed-down workers, of the model without any loss)."""
    many = Recipe.of_text(recipe.text.replace(f"images = {recipe.settings.images}", f"images = {64 * 8 * SHARDS_EACH}"))
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "recipe.toml").write_text(many.text, encoding="utf-8")
        (Path(name) / "patients").mkdir()
        prepare(many, 0, Path(name))
        ends: list[tuple[float, int]] = []
        make_dataset(
            many, name, workers=8, task=slowed_task, progress=lambda done: ends.append((perf_counter(), done.done))
        )
        (first, before), (last, after) = ends[8], ends[-9]  # while all work
        return (after - before) / (last - first), 8 * many.shard / SLOW_S


def main(images: int) -> None:
    recipe = Recipe.of_text(Recipe.read("ventricles").text.replace("images = 500", f"images = {images}"))
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        (out / "recipe.toml").write_text(recipe.text, encoding="utf-8")
        prepare(recipe, 0, out)
        render(recipe, out, 0)  # builds kernels
        rates: dict[str, list[float]] = {"simulate_batch": [], "1 process": [], "2 workers": []}
        memory: dict[str, float] = {}
        for _ in range(3):
            rates["simulate_batch"].append(batch_rate(recipe, out, images))
            for workers, key in ((1, "1 process"), (2, "2 workers")):
                rate, memory[key] = set_rate(recipe, out / "patients", workers)
                rates[key].append(rate)
        arrays, parameters = render(recipe, out, 0)
        began = perf_counter()
        write_shard(recipe, out, 0, arrays, {"parameters": parameters})
        write_ms = 1e3 * (perf_counter() - began) / recipe.shard
        made, began = scene(recipe, out, recipe.case_of(0)), perf_counter()
        for number in range(recipe.shard):
            Shot.of(made, number)
        draw_ms = 1e3 * (perf_counter() - began) / recipe.shard
        record_path(out, 0).unlink()
        began = perf_counter()
        render_task(str(out), str(out), 0)
        task_ms = 1e3 * (perf_counter() - began) / recipe.shard
    found, model = eight_workers(recipe)
    best = {key: max(values) for key, values in rates.items()}
    print(json.dumps({
        "images per second": {key: round(value, 1) for key, value in best.items()},
        "1 process by simulate_batch": round(best["1 process"] / best["simulate_batch"], 2),
        "2 workers by 1 process": round(best["2 workers"] / best["1 process"], 2),
        "ms per image": {"draw and pose": round(draw_ms, 2), "write": round(write_ms, 2), "task": round(task_ms, 1)},
        "MB": memory, "eight slowed workers": {"measured": round(found, 1), "model": model},
    }, indent=2))  # fmt: skip


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 640)
