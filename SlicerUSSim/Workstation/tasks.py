"""Tasks: work in a thread of its own, while the event loop's thread serves the browser and alone touches the nodes.

The presenter and the logic are written as if everything happened at once. Here they run in greenlets: where the logic
has work to do (UltrasoundSceneLogic, `work`), its greenlet waits, and the event loop runs until the work is done.
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
    """Runs functions of the event loop that may wait for work; is what UltrasoundSceneLogic takes as `work`.

    Parameters
    ----------
    failed : told of an exception that no task caught, in the event loop.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._loop = get_event_loop()
        # One: what a device does for one task must not change what it does for another in its midst.
        self._executor = ThreadPoolExecutor(1, "ultrasound")
        self._unfinished = 0

    @property
    def are_done(self) -> bool:
        """Whether no task is under way, or about to start."""
        return not self._unfinished

    def start(self, function: Callable[[], object]) -> None:
        """Call `function` soon, from the event loop, where it may wait for work."""
        self._unfinished += 1
        self._loop.call_soon(self._start, function)

    def do(self, function: Callable[[], T]) -> T:
        """What `function` gives, called in the thread for work. Outside of a task the event loop waits as well."""
        waiting = getcurrent()
        event_loop = waiting.parent
        if event_loop is None:
            return self._executor.submit(function).result()
        future = self._loop.run_in_executor(self._executor, function)
        future.add_done_callback(lambda _: waiting.switch())
        event_loop.switch()
        return future.result()

    def tell(self, function: Callable[[], None]) -> None:
        """From any thread: call `function` soon, from the event loop."""
        self._loop.call_soon_threadsafe(function)

    def stop(self) -> None:
        """Forget the work that has not begun."""
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
    """Calls a function when called itself, but not more often than every so many seconds; the last call counts."""

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
