"""Tasks: a worker thread for computations; the event loop's thread serves the browser and alone accesses the nodes.

Presenter and logic are written as synchronous code. Here they run in greenlets: during a computation
(UltrasoundSceneLogic, `work`) the greenlet waits, and the event loop runs until the computation is done.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any, TypeVar

from greenlet import getcurrent, greenlet
from trame_server.utils.asynchronous import get_event_loop

from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.mrml.logic import AtOnce

T = TypeVar("T")
#: Seconds that work has to end by itself after it was cancelled
_PATIENCE_S = 0.6


class _Worker:
    """A thread that computes one thing after the other. It ends with the program, whatever it is computing."""

    def __init__(self, name: str) -> None:
        self._queue: SimpleQueue[tuple[Future, Callable[[], Any]] | None] = SimpleQueue()
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def submit(self, function: Callable[[], Any]) -> Future:
        future: Future = Future()
        self._queue.put((future, function))
        return future

    def end(self) -> None:
        """Start nothing more, once what is computed now is done."""
        self._queue.put(None)

    def _run(self) -> None:
        while (entry := self._queue.get()) is not None:
            future, function = entry
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(function())
            except BaseException as error:
                future.set_exception(error)
            del entry, future, function  # a patient's data, perhaps


class _Waiting:
    """A greenlet that waits for work."""

    def __init__(self, waiting: greenlet, function: Callable[[], Any], is_aside: bool) -> None:
        self.greenlet, self.function, self.is_aside = waiting, function, is_aside
        self.future: Future
        self.is_abandoned = False


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
        self._worker = _Worker("ultrasound")
        self._aside = _Worker("files and surfaces")
        self._waiting: list[_Waiting] = []
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
        return self._wait(function, is_aside=False)

    def doAside(self, function: Callable[[], T]) -> T:
        """The same for what needs no device, such as reading a file: images do not wait for it."""
        return self._wait(function, is_aside=True)

    def ask(self, asked: Callable[[Callable[[T], None]], None]) -> T:
        """What a user answers; `asked` is called with a function that takes the answer, in the event loop.

        Until then the task counts as done: nothing is computed, and everything else continues.
        """
        waiting, answers = getcurrent(), []
        event_loop = waiting.parent
        assert event_loop is not None, "only a task can wait for a user"

        def answered(answer: T) -> None:
            if not answers:
                answers.append(answer)
                self._unfinished += 1
                self._loop.call_soon(waiting.switch)

        asked(answered)
        self._unfinished -= 1
        event_loop.switch()
        return answers[0]

    def _wait(self, function: Callable[[], T], is_aside: bool) -> T:
        waiting = getcurrent()
        event_loop = waiting.parent
        if event_loop is None:
            return (self._aside if is_aside else self._worker).submit(function).result()
        entry = _Waiting(waiting, function, is_aside)
        self._waiting.append(entry)
        self._submit(entry)
        try:
            event_loop.switch()
        finally:
            self._waiting.remove(entry)
        return entry.future.result()

    def _submit(self, entry: _Waiting) -> None:
        worker = self._aside if entry.is_aside else self._worker
        entry.future = worker.submit(entry.function)
        entry.future.add_done_callback(lambda future: self.tell(lambda: self._done(entry, future)))

    def _done(self, entry: _Waiting, future: Future) -> None:
        if not entry.is_abandoned and future is entry.future:
            entry.greenlet.switch()

    def tell(self, function: Callable[[], None]) -> None:
        """Call `function` soon in the event loop; may be used from any thread."""
        self._loop.call_soon_threadsafe(function)

    def abandonSoon(
        self, waiting: greenlet, is_under_way: Callable[[], bool], abandoned: Callable[[], None]
    ) -> None:  # fmt: skip
        """Let a cancelled task continue with Cancelled, even if its work does not notice in time.

        The work then ends in its own time, in a separate thread, and its result is dropped; what waited behind it
        is computed by a new thread. `abandoned` is called then.
        """

        def look() -> None:
            entry = next((entry for entry in self._waiting if entry.greenlet is waiting), None)
            if entry is None or entry.future.done() or not is_under_way():
                return
            entry.is_abandoned = True
            if entry.is_aside:
                self._aside.end()
                self._aside = _Worker("files and surfaces")
            else:
                self._worker.end()
                self._worker = _Worker("ultrasound")
            for other in self._waiting:
                if other.is_aside == entry.is_aside and other.future.cancel():
                    self._submit(other)
            abandoned()
            entry.greenlet.throw(Cancelled)

        self._loop.call_later(_PATIENCE_S, look)

    def stop(self) -> None:
        """Start nothing more that waits."""
        for entry in self._waiting:
            entry.is_abandoned = True
            entry.future.cancel()

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
        self._next = 0.0
        #: Whether the function is still to be called
        self.is_waiting = False

    def __call__(self) -> None:
        loop = get_event_loop()
        if self.is_waiting:
            return
        if loop.time() >= self._next:
            self._run()
        else:
            self.is_waiting = True
            loop.call_at(self._next, self._run)

    def _run(self) -> None:
        self.is_waiting = False
        self._next = get_event_loop().time() + self._seconds
        self._function()
