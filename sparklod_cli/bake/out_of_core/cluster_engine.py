"""An engine that hands tasks to the workers of a Dask cluster."""

from __future__ import annotations

import pickle
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...support.errors import SparklodError
from ...support.progress import Progress
from .cluster_pool import Connection, Pool
from .cluster_worker import PROBE, Probed, probe, run_call, run_task
from .contracts import Store, Task

_INSTALL = f"pip install 'sparklod[cluster]=={__version__}' there, and start it again"


class ClusterEngine:
    """Runs tasks on a Dask cluster.

    The client holds the graph: a task is submitted when all that it needs is done. Workers return two numbers, so that
    one which is lost takes no result with it: what it had put is in the store.
    """

    def __init__(self, connection: Connection, *, threads: int) -> None:
        """Takes the connection to a cluster, and the number of threads that a task works on."""
        self._connection, self._threads = connection, threads

    def run(self, stage: str, tasks: Sequence[Task], job: Any, progress: Progress) -> None:
        """See `Engine.run`."""
        store: Store = job.store
        left = {task.name: (place, task) for place, task in enumerate(tasks) if not store.has(task.name)}
        total = sum(task.weight for task in tasks)
        done = total - sum(task.weight for _, task in left.values())
        progress(stage, done, total, "splat")
        if not left:
            return
        self.check(store)
        packed = pickle.dumps(job)
        needs = {name: {need for need in task.needs if need in left} for name, (_, task) in left.items()}
        heirs: dict[str, list[str]] = {}
        for name, wanted in needs.items():
            for need in wanted:
                heirs.setdefault(need, []).append(name)
        with Pool(self._connection, stage) as pool:

            def submit(name: str) -> None:
                place, task = left[name]
                pool.submit(name, place, run_task, packed, task, self._threads)

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

    def each(self, stage: str, call: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
        """Calls a function with each tuple of arguments, side by side; yields what came of it, in their order.

        Where a call fails with a `SparklodError`, that is what is yielded.

        Args:
            stage: word for what is done.
            call: a function of a module that returns something small.
            arguments: small, and can be pickled.
        """
        with Pool(self._connection, stage) as pool:
            count, outcomes = 0, dict[str, Any]()
            for place, each in enumerate(arguments):
                pool.submit(str(place), place, run_call, call, each)
                count += 1
            for wanted in map(str, range(count)):
                while wanted not in outcomes:
                    name, result, error = pool.next()
                    if error is not None and not isinstance(error, SparklodError):
                        raise error
                    outcomes[name] = result if error is None else error
                yield outcomes.pop(wanted)

    def check(self, store: Store, files: Sequence[Path] = ()) -> None:
        """Raises a `SparklodError` where a worker cannot do its share: another sparklod, or a folder it does not see.

        Args:
            store: of the bake.
            files: that tasks read.
        """
        name = f"{PROBE}/{uuid.uuid4().hex}"
        store.put(name, {PROBE: np.arange(2)})
        try:
            with self._connection.guarded():
                found = self._connection.client.run(probe, store, name, files, on_error="return")
        finally:
            store.remove(name)
        for worker, answer in found.items():
            _check_answer(worker, answer, store)


def _check_answer(worker: str, answer: Any, store: Store) -> None:
    """Raises a `SparklodError` for what a worker said of itself."""
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
