"""make_dataset: prepares patients, renders shards here or on a Dask cluster, and finishes the set."""

from __future__ import annotations

import logging
import os
import signal
import threading
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

#: A worker's memory, bytes; seconds in which a scheduler answers or is gone, and between questions
WORKER_BYTES, _ANSWER_S, _ASKED_EVERY_S = 600e6, 4.0, 2.0

#: (images done, largest memory in MB of the process) of a shard
Task = Callable[[str, str, int], tuple[int, float]]


@dataclass
class Made:
    """What is done so far, and at the end."""

    folder: Path
    images: int
    done: int = 0
    #: Of earlier runs, which say nothing of the rate
    found: int = 0
    seconds: float = 0.0
    #: {patient's file: why its images are missing}
    skipped: dict[str, str] = field(default_factory=dict)
    #: Largest memory of a process that rendered, MB; 0 where that is not known
    peak_mb: float = 0.0

    @property
    def rate(self) -> float:
        """Images per second of this run."""
        return (self.done - self.found) / self.seconds if self.seconds else 0.0

    def __str__(self) -> str:
        left = f", {(self.images - self.done) / self.rate:.0f} s left" if self.rate else ""
        return f"{self.done} of {self.images} images, {self.rate:.1f} images/s{left}"


def render_task(out: str, files: str, shard: int) -> tuple[int, float]:
    """Render and write a shard of the set in the folder `out`, unless its record is there: a Task.

    `files` is the folder of the recipe's files. It does the same on every worker and however often it is done.
    """
    from SlicerUSSim.Logic.datasets.rendering import render, scene  # which workers alone wait for

    recipe, folder = _recipe(out, files), Path(out)
    numbers, case, began = recipe.images_of(shard), recipe.case_of(shard), perf_counter()
    if not record_path(folder, shard).exists():
        with collected_warnings() as warned:
            arrays, parameters = render(recipe, folder, shard)
        write_shard(recipe, folder, shard, arrays, {
            "images": [numbers.start, numbers.stop], "patient": recipe.patients[case.patient].file,
            "case": case.number, "tissues": scene(recipe, folder, case).names, "version": __version__,
            "device": str(choose_device(None)[0]), "seconds": round(perf_counter() - began, 3),
            "peak_mb": round(peak_mb(), 1), "warnings": sorted({str(one) for one in warned}), "parameters": parameters,
        })  # fmt: skip
    return len(numbers), peak_mb()


@lru_cache(maxsize=1)
def _recipe(out: str, files: str) -> Recipe:
    path = Path(out) / RECIPE
    return Recipe.of_text(path.read_text(encoding="utf-8"), str(path), Path(files))


def peak_mb() -> float:
    """Largest resident memory of this process so far, MB, as Linux says; 0 elsewhere."""
    try:  # getrusage would have that of the process which started this one
        with open("/proc/self/status") as lines:
            return 1.024e-3 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        return 0.0


def make_dataset(
    recipe: Recipe, out: str | os.PathLike, *, scheduler: str | None = None, workers: int | None = None,
    progress: Callable[[Made], None] = lambda _: None, task: Task = render_task,
) -> Made:  # fmt: skip
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
    folder = _own_folder(recipe, Path(out).absolute())
    made, began = Made(folder, recipe.settings.images), perf_counter()
    there = {shard for shard in range(recipe.shards) if record_path(folder, shard).exists()}
    made.done = made.found = sum(len(recipe.images_of(shard)) for shard in there)
    shards = _prepared_shards(recipe, folder, there, made)
    work = partial(task, str(folder), str(recipe.folder.absolute())), shards
    workers = best_workers() if workers is None else workers
    if len(there) < recipe.shards:
        done = _one_by_one(*work) if workers == 1 and scheduler is None else _on_dask(scheduler, workers, *work)
        for shard, found in done:
            if isinstance(found, PatientError):
                made.skipped.setdefault(recipe.patients[recipe.case_of(shard).patient].file, str(found))
                continue
            made.done, made.peak_mb = made.done + found[0], max(made.peak_mb, found[1])
            made.seconds = perf_counter() - began
            progress(made)
    write_datasheet(recipe, folder, made.skipped)
    return made


def best_workers() -> int:
    """As many processes as help on this computer: one for each core, two for a GPU, if there is memory for them."""
    from SlicerUSSim.Logic.imaging.batch import free_memory

    is_gpu = "gpu" in str(choose_device(None)[0]).lower()
    return max(int(min(2 if is_gpu else os.cpu_count() or 1, free_memory() / WORKER_BYTES)), 1)


def _own_folder(recipe: Recipe, out: Path) -> Path:
    """The folder of a set, with the recipe in it. Raises SimulationError for one that has something else."""
    require_folder(out)
    known = out / RECIPE
    if known.exists():
        is_same = known.read_text(encoding="utf-8") == recipe.text
        require(is_same, f"{out}: has the set of another recipe; give another folder, or delete it")
        return out
    require(not out.exists() or not any(out.iterdir()), f"{out}: has other files, expected a new or empty folder")
    with written_whole(make_folder(out) / RECIPE) as partial_file:
        partial_file.write_text(recipe.text, encoding="utf-8")
    return out


def _prepared_shards(recipe: Recipe, out: Path, there: set[int], made: Made) -> Iterator[int]:
    """The shards to be rendered, each after its patient was prepared. Patients that cannot be are left out."""
    for number, patient in enumerate(recipe.patients):
        cases = [case for case in recipe.cases if case.patient == number]
        shards = [shard for shard in range(cases[0].first, cases[-1].last) if shard not in there]
        try:
            if shards:
                prepare(recipe, number, out)
        except PatientError as error:
            made.skipped[patient.file] = str(error)
        for shard in shards:
            if patient.file not in made.skipped:  # its scene may have failed meanwhile
                yield shard


def _one_by_one(task: Callable[[int], Any], shards: Iterator[int]) -> Iterator[tuple[int, Any]]:
    """(shard, what the task gives or the PatientError that it raises), by this process."""
    for shard in shards:
        try:
            yield shard, task(shard)
        except PatientError as error:
            yield shard, error


# ---- Dask ------------------------------------------------------------------------------------------------------------


def _on_dask(
    scheduler: str | None, workers: int, task: Callable[[int], Any], shards: Iterator[int]
) -> Iterator[tuple[int, Any]]:
    """The same on a cluster, in the order in which shards are done. Raises SimulationError if the scheduler is gone."""
    waiting: dict[Any, int] = {}
    asked, threads = -_ASKED_EVERY_S, 0
    with _client(scheduler, workers) as client:
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
                    shard, error = waiting.pop(future), future.exception()
                    if type(error).__name__ == "KilledWorker":
                        raise SimulationError(f"shard {shard}: {_line(error)}; is there memory for a worker?")
                    if error is not None and not isinstance(error, PatientError):
                        raise error
                    yield shard, error or future.result()
                if not done:
                    sleep(0.02)
        except (OSError, TimeoutError, CancelledError) as error:
            goes_on = "what is written stays, and the same command goes on"
            raise SimulationError(f"the scheduler is gone ({_line(error)}); {goes_on}") from None
        finally:
            waiting.clear()  # which takes the tasks back


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Processes that begin here ignore Ctrl-C, which a terminal sends to all: this process hears it and ends them."""
    is_main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, signal.SIG_IGN) if is_main else None
    try:
        yield
    finally:
        if is_main:
            signal.signal(signal.SIGINT, before or signal.SIG_DFL)


@contextmanager
def _client(scheduler: str | None, workers: int) -> Iterator[Any]:
    """A client of the scheduler, or of new processes on this computer, each with its part of the cores."""
    require_package("distributed", EXTRA, "more than one process")
    from dask import config
    from distributed import Client, LocalCluster

    cluster: Any = nullcontext()
    if scheduler is None:
        config.set({"distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": 2})  # or workers keep what they freed
        cores = str(max((os.cpu_count() or 1) // workers, 1))
        with _without_interrupts():
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, memory_limit=0, dashboard_address="127.0.0.1:0",  # type: ignore
                env=dict.fromkeys(("POCL_CPU_MAX_CU_COUNT", "POCL_MAX_PTHREAD_COUNT", "OMP_NUM_THREADS"), cores),
                silence_logs=logging.CRITICAL,
            )  # fmt: skip
        client = Client(cluster)
    else:
        where: dict[str, Any] = {"address": scheduler} if "://" in scheduler else {"scheduler_file": scheduler}
        is_one = "://" in scheduler or Path(scheduler).is_file()
        require(is_one, f"--scheduler is {scheduler!r}, expected tcp://HOST:PORT, or a scheduler's file")
        try:
            client = Client(**where, timeout=_ANSWER_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise SimulationError(f"no scheduler answers at {scheduler} ({_line(error)})") from None
    with cluster:
        try:
            yield client
        finally:
            with suppress(Exception):  # a scheduler that is gone need not be told
                client.close(timeout=_ANSWER_S)


def _line(error: BaseException | None) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
