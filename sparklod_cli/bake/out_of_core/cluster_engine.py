"""An engine that hands tasks to the workers of a Dask cluster, and what these run."""

from __future__ import annotations

import contextlib
import functools
import os
import pickle
import shutil
import signal
import socket
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...system import machine
from ...system.addresses import Place
from ...system.errors import SparklodError, memory_errors_translated
from ...system.progress import Progress, silent
from .cluster_pool import Connection, Pool
from .store import Store
from .tasks import Task

_INSTALL = f"install sparklod {__version__} with its extra cluster there, and start it again"


class ClusterEngine:
    """Runs tasks on a Dask cluster.

    The client holds the graph: a task is submitted when all that it needs is done. Workers return two numbers, so that
    one which is lost takes no result with it: what it had put is in the store.

    Attributes:
        memory: bytes that a task may take; None where nobody knows.
    """

    def __init__(self, connection: Connection, *, threads: int, memory: int | None = None) -> None:
        """Take the connection to a cluster, and what `threads` and `memory` say."""
        self._connection, self.threads, self.memory = connection, threads, memory
        self._checked: tuple[str, frozenset[str]] | None = None

    def run(self, stage: str, tasks: Sequence[Task], job: Any, progress: Progress) -> None:
        """See `Engine.run`."""
        store: Store = job.store
        left = {task.name: (place, task) for place, task in enumerate(tasks) if not store.has(task.name)}
        total = sum(task.weight for task in tasks)
        done = total - sum(task.weight for _, task in left.values())
        progress(stage, done, total, "splat")
        if not left:
            return
        here = str(store), frozenset(self._connection.workers())
        if here != self._checked:  # other workers may have come
            self.check(store)
            self._checked = here
        packed = pickle.dumps(job)
        needs = {name: {need for need in task.needs if need in left} for name, (_, task) in left.items()}
        heirs: dict[str, list[str]] = {}
        for name, wanted in needs.items():
            for need in wanted:
                heirs.setdefault(need, []).append(name)
        with Pool(self._connection, stage) as pool:

            def submit(name: str) -> None:
                place, task = left[name]
                pool.submit(name, place, run_task, packed, task, self.threads)

            for name in [name for name, wanted in needs.items() if not wanted]:
                submit(name)
            while pool:
                name, result, error = pool.next()
                if error is None:
                    written, read = result
                    store.traffic.add(written=written, read=read)
                elif not store.has(name):
                    raise error
                done += left[name][1].weight
                progress(stage, done, total, "splat")
                for heir in heirs.get(name, ()):
                    needs[heir].discard(name)
                    if not needs[heir]:
                        submit(heir)

    @contextlib.contextmanager
    def map_calls(
        self, stage: str, call: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], progress: Progress, unit: str
    ) -> Iterator[Iterator[Any]]:
        """Call a function with each tuple of arguments, side by side, until the context ends.

        Args:
            call: a function of a module that takes `threads` besides, and returns something small.
            arguments: small, and can be pickled.
            unit: what a call is called.

        Yields:
            what came of each call, in their order: a `SparklodError` where it failed with one.
        """
        with Pool(self._connection, stage) as pool:
            for place, each in enumerate(arguments):
                pool.submit(str(place), place, functools.partial(call, threads=self.threads), *each)
            yield self._outcomes(pool, stage, len(arguments), progress, unit)

    def _outcomes(self, pool: Pool, stage: str, count: int, progress: Progress, unit: str) -> Iterator[Any]:
        outcomes = dict[str, Any]()
        for place in range(count):
            while str(place) not in outcomes:
                progress(stage, place + len(outcomes), count, unit)
                name, result, error = pool.next()
                if error is not None and not isinstance(error, SparklodError):
                    raise error
                outcomes[name] = result if error is None else error
            yield outcomes.pop(str(place))

    def check(self, store: Store | None, files: Sequence[Place] = ()) -> None:
        """Raise a `SparklodError` where a worker cannot do its share: another sparklod, or a folder it does not see.

        Args:
            files: that tasks read; those that are not here are left to the tasks.
        """
        here = [file for file in files if isinstance(file, Path) and file.exists()]
        name = f"{PROBE}/{uuid.uuid4().hex}"
        if store is not None:
            store.put(name, {PROBE: np.arange(2)})
        try:
            with self._connection.guarded():
                found = self._connection.client.run(probe, store, name, here, on_error="return")
        finally:
            if store is not None:
                store.remove(name)
        for worker, answer in found.items():
            _check_answer(worker, answer, store)

    def remove(self, folder: Path) -> None:
        """Remove a folder on the machines of all workers, and on this one."""
        shutil.rmtree(folder, ignore_errors=True)
        if self._connection.alive:
            with contextlib.suppress(SparklodError), self._connection.guarded():
                self._connection.client.run(shutil.rmtree, folder, ignore_errors=True)


def _check_answer(worker: str, answer: Any, store: Store | None) -> None:
    """Raise a `SparklodError` for what a worker said of itself."""
    if not isinstance(answer, Probed):  # an error: it has no sparklod, or one that knows no such question
        raise SparklodError(f"worker {worker} does not run sparklod {__version__} ({answer}): {_INSTALL}")
    place = f"worker {worker} on {answer.host}"
    if answer.version != __version__:
        raise SparklodError(f"{place} has sparklod {answer.version}, not {__version__} as here: {_INSTALL}")
    if not answer.reads:
        raise SparklodError(
            f"{place} does not see what was written to {store}: give --scratch-dir a folder that all machines share, or"
            " a URL such as s3://bucket/scratch"
        )
    if answer.writes:
        raise SparklodError(f"{place} cannot write to {store}: {answer.writes}")
    if answer.missing:
        raise SparklodError(
            f"{place} does not see {', '.join(answer.missing)}: put inputs into a folder that all machines share, or at"
            " a URL"
        )


#: What a probe has.
PROBE = "probe"


@dataclass(frozen=True)
class Probed:
    """Result of probing a worker.

    Attributes:
        reads: it reads the result that the client wrote.
        writes: empty, or why it cannot write one.
        missing: of the files that were asked for, those that it does not see.
    """

    version: str
    host: str
    reads: bool
    writes: str
    missing: tuple[str, ...]


def probe(store: Store | None, name: str, files: Sequence[Path]) -> Probed:
    """Try whether this worker can read what the client wrote, by the name of the result, and write what it reads."""
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
    """Run a task, unless its result is there: a worker may have been lost after it had put that.

    Args:
        packed: the job, pickled; a copy for each task, so that each counts its own bytes.

    Returns:
        bytes that it wrote to the store, and read there.
    """
    job = pickle.loads(packed)
    if not job.store.has(task.name):
        with memory_errors_translated():
            task.run(job, *task.arguments, threads=threads, progress=silent)
        machine.release_memory()
    return job.store.traffic.written, job.store.traffic.read


def dask_setup(worker: Any) -> None:
    """Prepare a worker process that sparklod started: it has no dashboard, and the client ends it, no Ctrl-C."""
    worker.http_server.stop()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
