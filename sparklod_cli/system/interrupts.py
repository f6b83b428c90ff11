"""Signals that end a run: Ctrl-C, SIGTERM, and SIGHUP from a closed terminal."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn

#: The signals that end a run, if the system has them.
ENDING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]

#: Exit status of an interrupted run: 128 + SIGINT, as in shells.
INTERRUPTED = 130

#: Packages that compile. An exception raised while LLVM calls back into Python is lost and may crash LLVM; and LLVM may
#: compile a kernel for seconds, during which Python handles no signal.
COMPILERS = ("numba", "llvmlite")

#: Seconds to wait for another thread to write the message.
FAREWELL = 0.1

#: Part of the error that Python prints about a second signal that came before the first one reset the handlers.
RACE = "ignored due to race condition"

#: Byte written to the pipe of signals after a lost interruption, and seconds until it is raised again.
LOST, PATIENCE = 0, 0.02

#: Set when a signal has interrupted the run. Later failures are its consequences, as libraries, such as numpy's C
#: modules, turn `KeyboardInterrupt` into errors of their own.
came = threading.Event()


class _Deferral:
    """State of `deferred`, in which the first Ctrl-C only asks the work to stop."""

    lasts = False  # such work is running
    asked = False  # the main thread has handled the first Ctrl-C
    seen = False  # the watching thread has seen it, perhaps before the main thread


_deferral = _Deferral()

#: Held by the first thread that ends the process, which writes the message.
_leaving = threading.Lock()


def handle() -> None:
    """Make signals raise `KeyboardInterrupt`, or end the process at once while kernels are being compiled.

    Ending at once loses nothing: outputs and the kernel cache are consistent at all times.
    """
    came.clear()
    # An ignored signal stays ignored, as under nohup.
    handled = [number for number in ENDING if signal.getsignal(number) != signal.SIG_IGN]

    def interrupt(signum: int, frame: FrameType | None) -> None:
        if signum == signal.SIGINT and _deferral.lasts and not _deferral.asked:
            _deferral.asked = True
            came.set()
            return
        _leave_if_compiling()
        came.set()
        for number in handled:
            signal.signal(number, signal.SIG_DFL)  # a second signal ends the process during the clean-up
        raise KeyboardInterrupt

    for number in handled:
        signal.signal(number, interrupt)
    if handled and os.name == "posix":  # other systems wait for the compilation
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        otherwise = sys.unraisablehook

        def raise_again(lost: sys.UnraisableHookArgs) -> None:
            """Raise an interruption again that Python only prints: inside `__del__` or callbacks of weak references."""
            if lost.exc_type is OSError and RACE in str(lost.exc_value):  # it came together with the first one
                _leave()
            if lost.exc_type is not KeyboardInterrupt:
                otherwise(lost)
                return
            signal.signal(handled[0], interrupt)
            os.write(writer, bytes([LOST]))

        sys.unraisablehook = raise_again
        threading.Thread(target=_watch, args=(reader, handled), daemon=True).start()


@contextlib.contextmanager
def deferred() -> Iterator[Callable[[], bool]]:
    """Let work end in its own way after the first Ctrl-C; yield a function that returns True from then on.

    That Ctrl-C also sets `came`. A second one and other signals interrupt as usual, and so does a Ctrl-C after the
    context. Without `handle`, as in a library, nothing is deferred.
    """
    _deferral.asked = _deferral.seen = False
    _deferral.lasts = True
    try:
        yield lambda: _deferral.asked
    finally:
        _deferral.lasts = False


def ignore() -> None:
    """Ignore the signals from now on: the process ends, and all work is done."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


def _watch(reader: int, handled: list[signal.Signals]) -> None:
    """Read signals from a pipe, in a thread of its own, to end the process even while the main thread is in LLVM."""
    main = threading.main_thread().ident
    assert main is not None
    while True:
        read = os.read(reader, 64)
        if LOST in read:
            time.sleep(PATIENCE)  # until the callback that lost it has returned
            signal.pthread_kill(main, handled[0])
        for number in read:
            if number == signal.SIGINT and _deferral.lasts and not _deferral.seen:
                _deferral.seen = True  # the first Ctrl-C is deferred
            elif number in handled:
                _leave_if_compiling()


def _leave_if_compiling() -> None:
    """End the process if one of its threads is compiling."""
    for frame in sys._current_frames().values():
        at: FrameType | None = frame
        while at is not None:
            if at.f_globals.get("__name__", "").partition(".")[0] in COMPILERS:
                _leave()
            at = at.f_back


def leave_if_lost() -> None:
    """End the process if a library has swallowed an interruption; called before long work."""
    if came.is_set() and not _deferral.asked:
        _leave()


def _leave() -> NoReturn:
    """Report the interruption and end the process without clean-up."""
    # A second thread, or a second signal in the same one, does not wait for the lock.
    if _leaving.acquire(blocking=False):
        with contextlib.suppress(OSError):  # not `sys.stderr`, whose lock the other thread may hold
            os.write(2, b"\r\x1b[Kinterrupted\n" if os.isatty(2) else b"interrupted\n")
    else:
        time.sleep(FAREWELL)
    os._exit(INTERRUPTED)
