"""Tasks: a worker thread for computations; the event loop's thread serves the browser and alone accesses the nodes.

Presenter and logic are written as synchronous code. Here they run in greenlets: during a computation
(UltrasoundSceneLogic, `work`) the greenlet waits, and the event loop runs until the computation is done.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from greenlet import getcurrent, greenlet
from trame_server.utils.asynchronous import get_event_loop

from SlicerUSSim.Logic.mrml.logic import AtOnce

T = TypeVar("T")


class Tasks(AtOnce):
    """Runs functions in the event loop that may wait for computations; the `work` of UltrasoundSceneLogic.

    Parameters
    ----------
    failed : called in the event loop with an exception that a task did not catch.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._loop = get_event_loop()
        # One thread: computations on a device must not be interleaved between tasks.
        self._executor = ThreadPoolExecutor(1, "ultrasound")
        self._unfinished = 0

    @property
    def are_done(self) -> bool:
        """Whether no task is running or about to start."""
        return not self._unfinished

    def start(self, function: Callable[[], object]) -> None:
        """Call `function` soon, in the event loop, as a task that may wait for computations."""
        self._unfinished += 1
        self._loop.call_soon(self._start, function)

    def do(self, function: Callable[[], T]) -> T:
        """The result of `function`, called in the worker thread. Outside a task this blocks the event loop."""
        waiting = getcurrent()
        event_loop = waiting.parent
        if event_loop is None:
            return self._executor.submit(function).result()
        future = self._loop.run_in_executor(self._executor, function)
        future.add_done_callback(lambda _: waiting.switch())
        event_loop.switch()
        return future.result()

    def tell(self, function: Callable[[], None]) -> None:
        """Call `function` soon in the event loop; may be used from any thread."""
        self._loop.call_soon_threadsafe(function)

    def stop(self) -> None:
        """Cancel computations that have not started."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _start(self, function: Callable[[], object]) -> None:
        def run() -> None:
            try:
                function()
            except Exception as error:
                self._failed(error)
            finally:
                self._unfinished -= 1

        greenlet(run).switch()


class AtMost:
    """Limits how often a function is called: at most once per `seconds`; the last call is always followed by one."""

    def __init__(self, seconds: float, function: Callable[[], None]) -> None:
        self._seconds, self._function = seconds, function
        self._next, self._waiting = 0.0, False

    @property
    def is_waiting(self) -> bool:
        """Whether the function is still to be called."""
        return self._waiting

    def __call__(self) -> None:
        loop = get_event_loop()
        if self._waiting:
            return
        if loop.time() >= self._next:
            self._run()
        else:
            self._waiting = True
            loop.call_at(self._next, self._run)

    def _run(self) -> None:
        self._waiting = False
        self._next = get_event_loop().time() + self._seconds
        self._function()
