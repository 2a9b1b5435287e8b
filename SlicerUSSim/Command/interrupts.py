"""Ctrl-C and other signals: a command ends with one line, also while a library computes or is imported."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import socket
import sys
import threading
from types import FrameType

#: Set by handlers, and seconds in which they must run
_seen = threading.Event()
_GRACE_S = 2.0
_WATCHER = "ussim-signals"
#: Seconds after which a signal that came during an import is sent again, and how often in all
_AGAIN_S = 0.05
_again = iter(range(100))


def end_at_signals() -> None:
    """Let SIGINT, SIGTERM and SIGHUP end the command; only in the main thread."""
    _end_even_in_kernels()
    for name in ("SIGTERM", "SIGHUP"):  # Windows has no SIGHUP
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _end)


def end_at_once(status: int = 0) -> None:
    """End the process, after what is registered for its end, while other threads compute.

    Python ends such a thread when it comes back to Python from C++, as in a report of progress to SimpleITK, whose
    handlers take that for an exception: the process was aborted with "FATAL: exception not rethrown". And a thread
    that compiles a kernel has its compiler taken away.
    """
    atexit._run_exitfuncs()  # temporary files and programs that were started
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    os._exit(status)


def _end(number: int, frame: FrameType | None) -> None:
    """End as at Ctrl-C: programs that were started end, too, and temporary files go."""
    _seen.set()
    if not _comes_again(number, frame):
        raise SystemExit(128 + number)


def _interrupt(number: int, frame: FrameType | None) -> None:
    _seen.set()
    if not _comes_again(number, frame):
        signal.default_int_handler(number, frame)


def _comes_again(number: int, frame: FrameType | None) -> bool:
    """Whether a module is being imported: extension modules expect no exception there, and end the process by SIGSEGV.

    The signal is then sent again a little later.
    """
    while frame is not None and frame.f_code.co_filename != "<frozen importlib._bootstrap>":
        frame = frame.f_back
    if frame is None or next(_again, None) is None:
        return False
    timer = threading.Timer(_AGAIN_S, _send_to_main, (number,))
    timer.daemon = True
    timer.start()
    return True


def _send_to_main(number: int) -> None:
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)  # and ends its sleep
    else:
        signal.raise_signal(number)


def _end_even_in_kernels() -> None:
    """End the process at a signal also while it waits for a kernel, where Python's handlers do not run.

    A thread sees every signal. If the handler has not run some seconds later, the main thread is in a library,
    and the process ends at once: files are replaced whole or not at all, and the next run removes the remains beside
    them.
    """
    if any(thread.name == _WATCHER for thread in threading.enumerate()):
        return
    told, tell = socket.socketpair()
    tell.setblocking(False)
    signal.set_wakeup_fd(tell.fileno(), warn_on_full_buffer=False)
    if hasattr(os, "register_at_fork"):  # a fork has no such thread, and would tell this one of its own signals
        os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not ignored, nor a program's own
        signal.signal(signal.SIGINT, _interrupt)
    threading.Thread(target=_watch, args=(told, tell), name=_WATCHER, daemon=True).start()


def _watch(told: socket.socket, _: socket.socket) -> None:
    while number := told.recv(1):
        if signal.getsignal(number[0]) not in (_end, _interrupt):
            continue
        if not _seen.wait(_GRACE_S):
            with contextlib.suppress(OSError):
                os.write(2, b"ussim: interrupted\n")
            os._exit(128 + number[0])
        _seen.clear()
