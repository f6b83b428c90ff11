"""What the workers of a cluster run."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...support import machine
from ...support.errors import memory_errors_translated
from ...support.progress import silent
from .store import FileStore
from .tasks import Task

#: What a probe has.
PROBE = "probe"


@dataclass(frozen=True)
class Probed:
    """What a worker says of itself.

    Attributes:
        version: of sparklod.
        host: name of its machine.
        reads: it reads the result that the client wrote.
        writes: empty, or why it cannot write one.
        missing: of the files that were asked for, those that it does not see.
    """

    version: str
    host: str
    reads: bool
    writes: str
    missing: tuple[str, ...]


def probe(store: FileStore | None, name: str, files: Sequence[Path]) -> Probed:
    """Tries whether this worker can do its share: read what others wrote, and write what they read.

    Args:
        store: of the bake, if it has one.
        name: of a result that the client wrote.
        files: that tasks read.
    """
    reads, writes = True, ""
    if store is not None:
        mine = f"{name}-{uuid.uuid4().hex}"
        try:
            store.put(mine, {PROBE: np.arange(2)})
            store.remove(mine)
        except Exception as error:
            writes = f"{type(error).__name__}: {error}"
        try:
            reads = store.has(name) and len(store.get(name)[PROBE]) > 0
        except Exception:
            reads = False
    missing = tuple(str(path) for path in files if not path.exists())
    return Probed(__version__, socket.gethostname(), reads, writes, missing)


def run_task(packed: bytes, task: Task, threads: int) -> tuple[int, int]:
    """Runs a task, unless its result is there: a worker may have been lost after it had put that.

    Args:
        packed: the job, pickled; a copy for each task, so that each counts its own bytes.
        task: to be run.
        threads: to work on.

    Returns:
        bytes that it wrote to the store, and read there.
    """
    job = pickle.loads(packed)
    if not job.store.has(task.name):
        with memory_errors_translated():
            task.run(job, *task.arguments, threads=threads, progress=silent)
        machine.release_memory()
    return job.store.traffic.written, job.store.traffic.read


def run_call(call: Callable[..., Any], arguments: tuple[Any, ...], threads: int) -> Any:
    """Calls a function that returns something small."""
    return call(*arguments, threads=threads)


def dask_setup(worker: Any) -> None:
    """Prepares a worker process that sparklod started: it has no dashboard, and the client ends it, no Ctrl-C."""
    worker.http_server.stop()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
