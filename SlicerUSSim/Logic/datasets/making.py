"""make_dataset: prepares patients, renders shards here or on a Dask cluster, and finishes the set."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from time import perf_counter, sleep
from typing import Any
from uuid import uuid4

from SlicerUSSim.Logic.base.errors import SimulationError, collected_warnings, require, require_package
from SlicerUSSim.Logic.base.files import make_folder, require_folder, written_whole
from SlicerUSSim.Logic.base.version import __version__
from SlicerUSSim.Logic.datasets.datasheet import write_datasheet
from SlicerUSSim.Logic.datasets.prepared import PatientError, prepare
from SlicerUSSim.Logic.datasets.recipe import Recipe
from SlicerUSSim.Logic.datasets.writers import EXTRA, RECIPE, record_path, require_format, write_shard
from SlicerUSSim.Logic.opencl.devices import choose_device

#: A worker's memory, bytes, and seconds in which a scheduler answers or is gone
WORKER_BYTES, _ANSWER_S, _ASKED_EVERY_S = 600e6, 4.0, 2.0


@dataclass
class Progress:
    """What is done so far."""

    images: int
    done: int = 0
    #: Of earlier runs, which say nothing of the rate
    found: int = 0
    seconds: float = 0.0

    @property
    def rate(self) -> float:
        """Images per second of this run."""
        return (self.done - self.found) / self.seconds if self.seconds else 0.0

    def __str__(self) -> str:
        left = f", {(self.images - self.done) / self.rate:.0f} s left" if self.rate else ""
        return f"{self.done} of {self.images} images, {self.rate:.1f} images/s{left}"


@dataclass
class Made:
    """The result of a run."""

    folder: Path
    progress: Progress
    #: {patient's file: why its images are missing}
    skipped: dict[str, str] = field(default_factory=dict)
    #: Largest memory of a process that rendered, MB; 0 where that is not known
    peak_mb: float = 0.0

    def skip(self, recipe: Recipe, shard: int, error: SimulationError) -> None:
        """Leave the other images of a shard's patient out."""
        self.skipped.setdefault(recipe.patients[recipe.case_of(shard).patient].file, str(error))


def render_task(out: str, files: str, shard: int) -> tuple[int, float]:
    """Render and write a shard of the set in the folder `out`, unless its record is there.

    (number of its images, largest memory of the process in MB). `files` is the folder of the recipe's files. A task of
    Dask: what it does is the same on every worker and however often it is done.
    """
    from SlicerUSSim.Logic.datasets.rendering import render, scene  # which workers alone wait for

    recipe, folder = _recipe(out, files), Path(out)
    numbers = recipe.images_of(shard)
    if not record_path(folder, shard).exists():
        case, began = recipe.case_of(shard), perf_counter()
        with collected_warnings() as warned:
            arrays, parameters = render(recipe, folder, shard)
        record = {
            "images": [numbers.start, numbers.stop], "patient": recipe.patients[case.patient].file,
            "case": case.number, "tissues": scene(recipe, folder, case).names, "version": __version__,
            "device": str(choose_device(None)[0]), "seconds": round(perf_counter() - began, 3),
            "peak_mb": round(peak_mb(), 1), "warnings": sorted({str(one) for one in warned}),
            "parameters": parameters,
        }  # fmt: skip
        write_shard(recipe, folder, shard, arrays, record)
    return len(numbers), peak_mb()


@lru_cache(maxsize=1)
def _recipe(out: str, files: str) -> Recipe:
    path = Path(out) / RECIPE
    return Recipe.of_text(path.read_text(encoding="utf-8"), str(path), Path(files))


def peak_mb() -> float:
    """Largest resident memory of this process so far, MB; 0 where it is not known."""
    try:
        import resource
    except ImportError:
        return 0.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)


def make_dataset(
    recipe: Recipe,
    out: str | os.PathLike,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Callable[[Progress], None] = lambda _: None,
    task: Callable[[str, str, int], tuple[int, float]] = render_task,
) -> Made:
    """Make the images of a recipe in a folder, or those that an earlier run of it left out.

    Parameters
    ----------
    scheduler : of a Dask cluster, "tcp://host:8786" or its scheduler file, whose workers see the folder by the same
        path and have this package; default: processes on this computer.
    workers : number of these; 1: this process alone, without Dask. Default: best_workers().
    progress : called after every shard; may raise errors.Cancelled.
    task : what renders and writes a shard; another one measures what is around it.

    Patients that cannot be read are left out, see Made.skipped. Raises SimulationError for a folder with another set,
    if a file cannot be written, if a package is missing, and if the scheduler is gone; the same call then goes on.
    """
    require_format(recipe)
    folder = _own_folder(recipe, Path(out))
    made = Made(folder, Progress(recipe.settings.images))
    workers = best_workers() if workers is None and scheduler is None else workers
    began = perf_counter()

    def tell(images: int, peak: float) -> None:
        made.peak_mb = max(made.peak_mb, peak)
        made.progress.done += images
        made.progress.seconds = perf_counter() - began
        progress(made.progress)

    there = {shard for shard in range(recipe.shards) if record_path(folder, shard).exists()}
    made.progress.done = made.progress.found = sum(len(recipe.images_of(shard)) for shard in there)
    if len(there) < recipe.shards:
        wanted = _prepared_shards(recipe, folder, there, made)
        inputs = (str(folder), str(recipe.folder.resolve()))
        if workers == 1:
            for shard in wanted:
                try:
                    tell(*task(*inputs, shard))
                except PatientError as error:
                    made.skip(recipe, shard, error)
        else:
            with _cluster(scheduler, workers) as client:
                waiting: dict[Any, int] = {}
                for future, shard in _completed(client, (partial(task, *inputs), wanted), waiting):
                    error = future.exception()
                    if isinstance(error, PatientError):
                        made.skip(recipe, shard, error)
                    elif error is not None:
                        raise _of_worker(error, shard) from None
                    else:
                        tell(*future.result())
    write_datasheet(recipe, folder, made.skipped)
    return made


def best_workers() -> int:
    """As many processes as help on this computer: one for two cores or a GPU, and memory for each."""
    from SlicerUSSim.Logic.imaging.batch import free_memory

    by_memory = int(min(free_memory() / WORKER_BYTES, 1024))
    is_gpu = "gpu" in str(choose_device(None)[0]).lower()
    return max(min(2 if is_gpu else os.cpu_count() or 1, by_memory), 1)


def _own_folder(recipe: Recipe, out: Path) -> Path:
    """The folder of a set, with the recipe in it. Raises SimulationError for one that has something else."""
    require_folder(out)
    known = out / RECIPE
    if known.exists():
        require(
            known.read_text(encoding="utf-8") == recipe.text,
            f"{out}: has the set of another recipe; give another folder, or delete it",
        )
        return out
    require(not out.exists() or not any(out.iterdir()), f"{out}: has other files, expected a new or empty folder")
    make_folder(out)
    with written_whole(known) as partial:
        partial.write_text(recipe.text, encoding="utf-8")
    return out.resolve()


def _prepared_shards(recipe: Recipe, out: Path, there: set[int], made: Made) -> Iterator[int]:
    """The shards to be rendered, each after its patient was prepared. Patients that cannot be are left out."""
    for number, patient in enumerate(recipe.patients):
        cases = [case for case in recipe.cases if case.patient == number]
        shards = [shard for shard in range(cases[0].first, cases[-1].last) if shard not in there]
        if not shards:
            continue
        try:
            prepare(recipe, number, out)
        except PatientError as error:
            made.skipped[patient.file] = str(error)
            continue
        for shard in shards:
            if patient.file not in made.skipped:  # as a scene of it, meanwhile
                yield shard


# ---- Dask ------------------------------------------------------------------------------------------------------------


@contextmanager
def _cluster(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    """A client of the scheduler, or of new processes on this computer, each with its part of the cores."""
    require_package("distributed", EXTRA, "more than one process")
    from distributed import Client, LocalCluster

    if scheduler is not None:
        where: dict[str, Any] = {"address": scheduler} if "://" in scheduler else {"scheduler_file": scheduler}
        is_one = "://" in scheduler or Path(scheduler).is_file()
        require(is_one, f"--scheduler is {scheduler!r}, expected tcp://HOST:PORT, or a scheduler's file")
        try:
            client = Client(**where, timeout=_ANSWER_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise SimulationError(f"no scheduler answers at {scheduler} ({_first_line(error)})") from None
        cluster = nullcontext()
    else:
        cores = str(max((os.cpu_count() or 1) // (workers or 1), 1))
        environment = {"POCL_CPU_MAX_CU_COUNT": cores, "POCL_MAX_PTHREAD_COUNT": cores, "OMP_NUM_THREADS": cores}
        plain: dict[str, Any] = {"dashboard_address": None, "silence_logs": logging.CRITICAL, "memory_limit": 0}
        cluster = LocalCluster(
            n_workers=workers, threads_per_worker=1, env=environment, local_directory=tempfile.gettempdir(), **plain
        )
        client = Client(cluster)
    with cluster:
        try:
            yield client
        finally:
            with suppress(Exception):  # a scheduler that is gone need not be told
                client.close(timeout=_ANSWER_S)


def _completed(client: Any, work: tuple[Callable, Iterator[int]], waiting: dict[Any, int]) -> Iterator[tuple[Any, int]]:
    """(future, shard) of shards as they are done; `waiting` are those that are not.

    Raises SimulationError if the scheduler is gone.
    """
    task, shards = work
    asked, threads = -_ASKED_EVERY_S, 0
    try:
        while True:
            if perf_counter() - asked > _ASKED_EVERY_S:
                about = client.sync(client.scheduler.identity, n_workers=-1, callback_timeout=_ANSWER_S)
                asked, threads = perf_counter(), sum(one["nthreads"] for one in about["workers"].values())
            for shard in islice(shards, max(2 * threads, 4) - len(waiting)):
                waiting[client.submit(task, shard, key=f"shard-{uuid4().hex}", pure=False)] = shard
            if not waiting:
                return
            done = [future for future in waiting if future.done()]
            for future in done:
                if future.cancelled():  # by a connection that was lost
                    raise CancelledError("it has lost a shard")
                yield future, waiting.pop(future)
            if not done:
                sleep(0.02)
    except (OSError, TimeoutError, CancelledError) as error:
        raise SimulationError(
            f"the scheduler is gone ({_first_line(error)}); what is written stays, and the same command goes on"
        ) from None
    finally:
        waiting.clear()  # which takes the tasks back


def _of_worker(error: BaseException, shard: int) -> BaseException:
    """The error of a shard, in words if workers died over it."""
    if type(error).__name__ == "KilledWorker":
        return SimulationError(f"shard {shard}: {_first_line(error)}; is there memory for a worker?")
    return error


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
