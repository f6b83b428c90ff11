"""What a process that a test starts must not inherit."""

from __future__ import annotations

import signal


def heed_signals() -> None:
    """Called in a new process: takes back whatever the one that runs the tests ignores or blocks.

    An ignored signal stays ignored in `sparklod`, as under nohup, so that it would serve for ever.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, [])
