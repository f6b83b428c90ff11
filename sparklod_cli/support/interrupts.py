"""Signals that end a run: Ctrl-C, a polite kill, a terminal that is closed."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from types import FrameType

#: What ends a run, where the system has it.
ENDING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]

#: Exit status of a run that was interrupted, as shells say it of SIGINT.
INTERRUPTED = 130

#: Packages that compile. LLVM calls back into Python: an exception there is lost, and what LLVM gets instead of an
#: answer can crash the process. And one kernel can take LLVM seconds, in which Python handles no signal.
COMPILERS = ("numba", "llvmlite")

#: Seconds in which another thread says that the run was interrupted.
FAREWELL = 0.1

#: Both the main thread and the one that watches may want to end the process; it is said once.
_leaving = threading.Lock()


def handle() -> None:
    """Lets signals end this process: as `KeyboardInterrupt`, which cleans up, or at once while kernels are compiled.

    Nothing is lost by that: the cache of kernels and outputs are whole at any moment.
    """
    handled = [number for number in ENDING if signal.getsignal(number) != signal.SIG_IGN]  # nohup and the like hold

    def interrupt(signum: int, frame: FrameType | None) -> None:
        _leave_if_compiling()
        for number in handled:
            signal.signal(number, signal.SIG_DFL)  # a second one does not wait for the cleaning up
        raise KeyboardInterrupt

    for number in handled:
        signal.signal(number, interrupt)
    if handled and os.name == "posix":  # elsewhere a compilation is waited for
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        threading.Thread(target=_watch, args=(reader, handled), daemon=True).start()


def ignore() -> None:
    """Lets the process end as it was about to: what there was to do is done."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


def _watch(reader: int, handled: list[signal.Signals]) -> None:
    """Ends the process for the main thread while that is inside LLVM; runs in a thread of its own."""
    while True:
        if any(number in handled for number in os.read(reader, 64)):
            _leave_if_compiling()


def _leave_if_compiling() -> None:
    """Ends the process if any of its threads compiles."""
    for frame in sys._current_frames().values():
        at: FrameType | None = frame
        while at is not None:
            if at.f_globals.get("__name__", "").partition(".")[0] in COMPILERS:
                # Whoever comes second, another thread or the same one at a second signal, waits for nobody.
                if _leaving.acquire(blocking=False):
                    with contextlib.suppress(OSError):  # not by `sys.stderr`, which the other thread may hold
                        os.write(2, b"\r\x1b[Kinterrupted\n" if os.isatty(2) else b"interrupted\n")
                    os._exit(INTERRUPTED)
                time.sleep(FAREWELL)
                os._exit(INTERRUPTED)
            at = at.f_back
