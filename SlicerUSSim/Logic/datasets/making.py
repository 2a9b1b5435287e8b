"""make_dataset: prepares patients, renders shards here or on a Dask cluster, and finishes the set."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
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
from SlicerUSSim.Logic.datasets.patients import PatientError, prepare, prepared_path
from SlicerUSSim.Logic.datasets.recipe import FORMATS, Recipe
from SlicerUSSim.Logic.datasets.writers import record_path, write_datasheet, write_shard
from SlicerUSSim.Logic.imaging.batch import bytes_of, free_memory
from SlicerUSSim.Logic.opencl.devices import choose_device

EXTRA = "SlicerUSSim[datasets]"
#: The recipe in the folder of its set
RECIPE = "recipe.toml"
#: A worker's memory, bytes; seconds in which a scheduler answers or is gone, and between questions
WORKER_BYTES, _ANSWER_S, _ASKED_EVERY_S = 600e6, 6.0, 2.0
#: In workers: a terminal sends Ctrl-C to all processes, but the one that has started them ends them
_NO_INTERRUPTS = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"

#: Renders a shard of the set in the first folder by files in the second; the largest memory so far of the process, MB
Task = Callable[[str, str, int], float]


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

    @property
    def share(self) -> float:
        """Of the images, 0 to 1."""
        return self.done / self.images

    def in_words(self) -> str:
        """For a progress bar."""
        left = f", {(self.images - self.done) / self.rate:.0f} s left" if self.rate else ""
        return f"{self.done} of {self.images} images, {self.rate:.1f} images/s{left}"


def render_task(out: str, files: str, shard: int) -> float:
    """A Task: renders and writes a shard unless its record is there; the same on every worker, however often."""
    from SlicerUSSim.Logic.datasets.rendering import render, scene  # which workers alone wait for

    recipe, folder = _recipe(out, files), Path(out)
    if record_path(folder, shard).exists():
        return 0.0
    numbers, case = recipe.images_of(shard), recipe.case_of(shard)
    with collected_warnings() as warned:
        arrays, parameters = render(recipe, folder, shard)
    made = scene(recipe, folder, case)
    peak_mb = round(1e-6 * bytes_of("/proc/self/status", "VmHWM", 0.0), 1)  # getrusage has that of the parent, too
    write_shard(recipe, folder, shard, arrays, {
        "images": [numbers.start, numbers.stop], "patient": recipe.patients[case.patient].file, "case": case.number,
        "tissues": made.names, "version": __version__, "device": str(choose_device(None)[0]), "peak_mb": peak_mb,
        "warnings": sorted({*made.warnings, *map(str, warned)}), "parameters": parameters,
    })  # fmt: skip
    return peak_mb


@lru_cache(maxsize=1)
def _recipe(out: str, files: str) -> Recipe:
    path = Path(out) / RECIPE
    return Recipe.of_text(path.read_text(encoding="utf-8"), str(path), Path(files))


def make_dataset(
    recipe: Recipe, out: str | os.PathLike, *, scheduler: str | None = None, workers: int | None = None,
    progress: Callable[[Made], None] = lambda _: None, say: Callable[[str], None] = lambda _: None,
    task: Task = render_task,
) -> Made:  # fmt: skip
    """Make the images of a recipe in a folder, or those that an earlier run of it left out.

    Parameters
    ----------
    scheduler : of a Dask cluster, "tcp://host:8786" or its scheduler file, whose workers see the folder by the same
        path and have this package; default: processes on this computer.
    workers : number of these; 1: this process alone, without Dask. Default: best_workers().
    progress : called after every shard; may raise errors.Cancelled.
    say : called with a line about what is waited for: a patient that is prepared, workers.
    task : what renders and writes a shard; another one measures the work around it.

    Patients that cannot be read are left out, see Made.skipped. Raises SimulationError for a folder with another set,
    if a file cannot be written, if a package is missing, and if the scheduler is gone; the same call then resumes.
    """
    form = recipe.settings.format
    require(form != "zarr" or sys.version_info >= (3, 11), 'format zarr needs Python 3.11; write format = "hdf5"')
    if FORMATS[form]:
        require_package(FORMATS[form], EXTRA, f"format {form}")
    folder = _own_folder(recipe, Path(out).absolute())
    made, began = Made(folder, recipe.settings.images), perf_counter()
    there = {shard for shard in range(recipe.shards) if record_path(folder, shard).exists()}
    made.done = made.found = sum(len(recipe.images_of(shard)) for shard in there)
    attempt = partial(_attempted, task, str(folder), str(recipe.folder.absolute()))
    shards, workers = _prepared_shards(recipe, folder, there, made, say), workers or best_workers()
    if (workers == 1 and scheduler is None) or len(there) == recipe.shards:
        done = ((shard, attempt(shard)) for shard in shards)
    else:
        done = _on_dask(scheduler, workers, attempt, shards, say)
    for shard, found in done:
        if isinstance(found, PatientError):
            made.skipped.setdefault(recipe.patients[recipe.case_of(shard).patient].file, str(found))
            continue
        made.done, made.peak_mb = made.done + len(recipe.images_of(shard)), max(made.peak_mb, found)
        made.seconds = perf_counter() - began
        progress(made)
    write_datasheet(recipe, folder, made.skipped)
    return made


def best_workers() -> int:
    """As many processes as help on this computer: one for each core, two for a GPU, if there is memory for them."""
    most = 2 if "gpu" in str(choose_device(None)[0]).lower() else os.cpu_count() or 1
    return max(int(min(most, free_memory() / WORKER_BYTES)), 1)


def _own_folder(recipe: Recipe, out: Path) -> Path:
    """The folder of a set, with the recipe in it. Raises SimulationError for one that has something else."""
    require_folder(out)
    known = out / RECIPE
    if not known.exists():
        require(not out.exists() or not any(out.iterdir()), f"{out}: has other files, expected a new or empty folder")
        with written_whole(make_folder(out) / RECIPE) as partial_file:
            partial_file.write_text(recipe.text, encoding="utf-8")
    is_same = known.read_text(encoding="utf-8") == recipe.text
    require(is_same, f"{out}: has the set of another recipe; give another folder, or delete it")
    return out


def _prepared_shards(
    recipe: Recipe, out: Path, there: set[int], made: Made, say: Callable[[str], None]
) -> Iterator[int]:
    """The shards to be rendered, each after its patient was prepared. Patients that cannot be are left out."""
    for shard in sorted({*range(recipe.shards)} - there):
        number = recipe.case_of(shard).patient
        file = recipe.patients[number].file
        if file not in made.skipped and not prepared_path(out, number).exists():
            say(f"{file}: preparing it ...")
            try:
                prepare(recipe, number, out)
            except PatientError as error:
                made.skipped[file] = str(error)
        if file not in made.skipped:  # its scene may have failed meanwhile
            yield shard


def _attempted(task: Task, out: str, files: str, shard: int) -> float | PatientError:
    try:
        return task(out, files, shard)
    except PatientError as error:
        return error


# ---- Dask ------------------------------------------------------------------------------------------------------------


def _on_dask(
    scheduler: str | None, workers: int, attempt: Callable, shards: Iterator[int], say: Callable[[str], None]
) -> Iterator[tuple[int, float | PatientError]]:
    """(shard, what its attempt gave) as they are done. Raises SimulationError if the scheduler is gone."""
    waiting: dict[Any, int] = {}
    asked, threads = -_ASKED_EVERY_S, -1
    with _client(scheduler, workers) as client:
        try:
            while True:
                if perf_counter() - asked > _ASKED_EVERY_S:
                    about = client.sync(client.scheduler.identity, n_workers=-1, callback_timeout=_ANSWER_S)
                    before, threads = threads, sum(one["nthreads"] for one in about["workers"].values())
                    asked = perf_counter()
                    if not threads and before:
                        say(f"{client.scheduler.address}: waiting for workers ...")
                for shard in islice(shards, max(2 * threads - len(waiting), 4 - len(waiting), 0)):
                    waiting[client.submit(attempt, shard, key=f"shard-{uuid4().hex}", pure=False)] = shard
                if not waiting:
                    return
                done = [future for future in waiting if future.done()]
                for future in done:
                    if future.cancelled():  # by a connection that was lost
                        raise CancelledError("it has lost a shard")
                    shard, error = waiting.pop(future), future.exception()
                    if type(error).__name__ == "KilledWorker":
                        raise SimulationError(f"shard {shard}: {_line(error)}; is there memory for a worker?")
                    if error is not None:
                        raise error
                    yield shard, future.result()
                if not done:
                    sleep(0.02)
        except (OSError, TimeoutError, CancelledError) as error:
            resume = "what is written stays, and the same command resumes"
            raise SimulationError(f"the scheduler is gone ({_line(error)}); {resume}") from None
        finally:
            waiting.clear()  # which takes the tasks back


@contextmanager
def _client(scheduler: str | None, workers: int) -> Iterator[Any]:
    """A client of the scheduler, or of new processes on this computer, each with its part of the cores."""
    require_package("distributed", EXTRA, "more than one process")
    from dask import config
    from distributed import Client, LocalCluster

    with ExitStack() as stack:
        where: dict[str, Any] = {"address": scheduler}
        if scheduler is None:
            config.set({"distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": 2})  # or workers keep what they freed
            cores = str(max((os.cpu_count() or 1) // workers, 1))
            where["address"] = stack.enter_context(LocalCluster(
                n_workers=workers, threads_per_worker=1, memory_limit=0, dashboard_address="127.0.0.1:0",  # type: ignore
                env=dict.fromkeys(("POCL_CPU_MAX_CU_COUNT", "POCL_MAX_PTHREAD_COUNT", "OMP_NUM_THREADS"), cores),
                silence_logs=logging.CRITICAL, preload=[_NO_INTERRUPTS],
            ))  # fmt: skip
        elif "://" not in scheduler:
            is_file = Path(scheduler).is_file()
            require(is_file, f"--scheduler is {scheduler!r}, expected tcp://HOST:PORT, or a scheduler's file")
            where = {"scheduler_file": scheduler}
        try:
            client = Client(**where, timeout=_ANSWER_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise SimulationError(f"no scheduler answers at {scheduler} ({_line(error)})") from None
        try:
            yield client
        finally:
            with suppress(Exception):  # a scheduler that is gone need not be told
                client.close(timeout=_ANSWER_S)


def _line(error: BaseException | None) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
