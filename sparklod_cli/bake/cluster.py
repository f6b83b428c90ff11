"""Dask clusters: an engine that runs tasks with retries and reports of lost workers, and the code of the workers.

A cluster is already running, or consists of processes on this machine that start and end with a bake.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import functools
import itertools
import logging
import os
import pickle
import queue
import shutil
import signal
import socket
import tempfile
import time
import uuid
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..io.reading import Source, absolute_source, open_reader, places_of
from ..system import machine
from ..system.addresses import Place, absolute
from ..system.errors import FormatError, OutOfMemoryError, SparklodError, memory_errors_translated, optional_import
from ..system.progress import Progress, silent
from ..system.python_process import check_current_folder, safe_path
from ..system.threads import thread_count
from .estimate import default_memory, in_memory_bytes
from .job import Task
from .settings import LARGE, Baked, BakeSettings, Resources
from .store import Store

_INSTALL = f"install sparklod {__version__} with its extra cluster there, and start it again"

#: Seconds to wait before a failed call is repeated: networks recover, and shared folders show files late.
PAUSES = (1.0, 5.0)

#: Seconds between checks of the cluster while no call ends, and until a cluster without workers is reported.
TICK, ALONE_SECONDS = 1.0, 10.0

#: Error numbers that repeating a call does not help: no room, no permission.
LASTING = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG, errno.ENAMETOOLONG}

#: Seconds to wait for the message of a nanny that ended a worker for its memory; it may arrive after the loss.
NANNY_DELAY = 3.0

#: Topics of the scheduler's messages about workers, and of the nannies' about memory.
TOPICS = ("all", "worker-restart-memory")

#: States of a future that has ended. Others are "pending", and "lost" with the worker that held its result.
ENDED = {"finished", "error", "cancelled"}

#: Most task names in a message.
LISTED = 3

GONE = (
    "the scheduler of the cluster no longer answers; finished work is kept: start the cluster again, and add --resume"
)

LESS_MEMORY = (
    "give a smaller --memory, which makes smaller blocks, or let fewer workers share a machine; finished work is"
    " kept, and --resume continues"
)


class ClusterEngine:
    """Engine on a Dask cluster, which reports lost workers to the user by `say`.

    This process holds the graph: it submits a task when all its needs are done. Results are in the store, so that no
    lost worker loses one.

    Attributes:
        client: the `distributed.Client` of the cluster.
        memory: bytes that a task may take; None if unknown.
    """

    def __init__(self, client: Any, say: Callable[[str], None], *, threads: int, memory: int | None = None) -> None:
        self.client, self.say, self.threads, self.memory = client, say, threads, memory
        self._losses: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._starved = set[str]()
        self._alone_since: float | None = None
        self._checked: tuple[str, frozenset[str]] | None = None

    @property
    def alive(self) -> bool:
        """Whether the scheduler answers."""
        return bool(self.client.status == "running")

    def workers(self) -> dict[str, Any]:
        """Return the scheduler's information on each worker, by address."""
        with self.guarded():
            known: dict[str, Any] = dict(self.client.scheduler_info()["workers"])
        return known

    @contextlib.contextmanager
    def guarded(self) -> Iterator[None]:
        """Translate errors of the connection."""
        try:
            yield
        except (OSError, CancelledError, RuntimeError, AttributeError):
            raise SparklodError(GONE) from None

    def look(self) -> None:
        """Report lost workers and a cluster without workers; raise `SparklodError` if the scheduler does not answer."""
        self.tell_losses()
        if not self.alive:
            raise SparklodError(GONE)
        if self.workers():
            self._alone_since = None
        elif self._alone_since is None:
            self._alone_since = time.monotonic()
        elif self._alone_since + ALONE_SECONDS < time.monotonic():
            self.say("the cluster has no workers at the moment; waiting for some (Ctrl-C ends this)")
            self._alone_since = float("inf")

    def tell_losses(self) -> None:
        """Report lost workers and the tasks that are repeated."""
        while not self._losses.empty():  # only this thread takes one
            lost = self._losses.get()
            keys = lost.get("processing-tasks") or ()
            names = sorted(str(key[-1] if isinstance(key, tuple) else key) for key in keys)
            again = f"; to be done again: {', '.join(names[:LISTED])}" if names else ""
            again += f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
            why = "ran out of memory" if lost["worker"] in self._starved else "was lost"
            self.say(f"worker {lost['worker']} {why}{again}")

    def failure(self, name: str, future: Any) -> Exception:
        """Return the error of a failed call."""
        if future.status == "cancelled":
            return SparklodError(GONE)
        with self.guarded():
            error: Exception = future.exception()
        if type(error).__name__ == "KilledWorker":
            worker = str(error.last_worker.address)  # type: ignore[attr-defined]
            deadline = time.monotonic() + NANNY_DELAY
            while worker not in self._starved and time.monotonic() < deadline:
                time.sleep(TICK / 20)
            if worker in self._starved:
                return OutOfMemoryError(f"{name} does not fit into the memory of a worker; {LESS_MEMORY}")
            return SparklodError(
                f"each worker that did {name} was lost, the last one {worker}. Its log may tell why; if the system"
                f" ended them for want of memory, {LESS_MEMORY}"
            )
        if isinstance(error, OutOfMemoryError):
            return OutOfMemoryError(f"{name}: {error}; {LESS_MEMORY}")
        return error

    def keep(self, event: tuple[float, Any]) -> None:
        """Record a message of the scheduler, on the client's thread."""
        message = event[1]
        if not isinstance(message, dict):
            return
        if "rss" in message:
            self._starved.add(str(message.get("worker")))
        elif message.get("action") == "remove-worker" and not message.get("expected"):
            self._losses.put(message)

    def run(self, stage: str, tasks: Sequence[Task], job: Any, progress: Progress) -> None:
        """Run tasks as `Engine.run`."""
        store: Store = job.store
        left = {task.name: (place, task) for place, task in enumerate(tasks) if not store.has(task.name)}
        total = sum(task.weight for task in tasks)
        done = total - sum(task.weight for _, task in left.values())
        progress(stage, done, total, "splat")
        if not left:
            return
        here = str(store), frozenset(self.workers())
        if here != self._checked:  # new workers may have joined
            self.check(store)
            self._checked = here
        packed = pickle.dumps(job)
        graph = TopologicalSorter({name: set(task.needs) & left.keys() for name, (_, task) in left.items()})
        graph.prepare()
        with Pool(self, stage) as pool:
            while graph:
                for name in graph.get_ready():
                    place, task = left[name]
                    pool.submit(name, place, run_task, packed, task, self.threads)
                name, result, error = pool.next()
                if error is None:
                    written, read = result
                    store.count_bytes(written=written, read=read)
                elif not store.has(name):
                    raise error
                graph.done(name)
                done += left[name][1].weight
                progress(stage, done, total, "splat")

    @contextlib.contextmanager
    def map_calls(
        self, stage: str, call: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], progress: Progress, unit: str
    ) -> Iterator[Iterator[Any]]:
        """Call a function with each tuple of arguments in parallel until the context ends.

        Args:
            call: function of a module that also takes `threads`, and returns something small.
            unit: word for a call in the progress.

        Yields:
            an iterator over the result or the `SparklodError` of each call, in order.
        """
        with Pool(self, stage) as pool:
            for place, each in enumerate(arguments):
                pool.submit(str(place), place, functools.partial(call, threads=self.threads), *each)

            def outcomes() -> Iterator[Any]:
                ended = dict[str, Any]()
                for place in range(len(arguments)):
                    while str(place) not in ended:
                        progress(stage, place + len(ended), len(arguments), unit)
                        name, result, error = pool.next()
                        if error is not None and not isinstance(error, SparklodError):
                            raise error
                        ended[name] = error or result
                    yield ended.pop(str(place))

            yield outcomes()

    def check(self, store: Store | None, files: Sequence[Place] = ()) -> None:
        """Raise `SparklodError` if a worker has another version, or does not see the store or input files.

        Args:
            files: inputs; one that is missing on this machine is reported by the task that reads it.
        """
        here = [file for file in files if isinstance(file, Path) and file.exists()]
        name = f"{PROBE}/{uuid.uuid4().hex}"
        if store is not None:
            store.put(name, {PROBE: np.arange(2)})
        try:
            with self.guarded():
                answers = self.client.run(probe, store, name, here, on_error="return")
        finally:
            if store is not None:
                store.remove(name)
        for worker, answer in answers.items():
            if not isinstance(answer, tuple):  # an error: it has no sparklod, or one without `probe`
                raise SparklodError(f"worker {worker} does not run sparklod {__version__} ({answer}): {_INSTALL}")
            version, host, fault = answer
            if version != __version__:
                fault = f"has sparklod {version}, not {__version__} as here: {_INSTALL}"
            if fault:
                raise SparklodError(f"worker {worker} on {host} {fault}")

    def remove(self, folder: Path) -> None:
        """Remove a folder on the machines of all workers, and on this one."""
        shutil.rmtree(folder, ignore_errors=True)
        if self.alive:
            with contextlib.suppress(SparklodError), self.guarded():
                self.client.run(shutil.rmtree, folder, ignore_errors=True)


class Pool:
    """Unfinished calls on a cluster, which the context cancels at its end."""

    def __init__(self, engine: ClusterEngine, stage: str) -> None:
        self._engine = engine
        self._prefix = f"{stage}-{uuid.uuid4().hex[:8]}"
        self._calls = dict[str, tuple[int, tuple[Any, ...]]]()
        self._futures = dict[str, Any]()
        self._tries = dict[str, int]()
        self._paused: list[tuple[float, str]] = []
        self._ended: queue.SimpleQueue[str] = queue.SimpleQueue()

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        self._engine.tell_losses()
        if self._futures and self._engine.alive:
            with contextlib.suppress(Exception):  # the scheduler is gone by now
                self._engine.client.cancel(list(self._futures.values()), force=True)

    def submit(self, name: str, place: int, *call: Any) -> None:
        """Submit a call of a function with arguments, under a unique name; calls with lower places run first."""
        self._calls[name] = place, call
        key = (f"{self._prefix}-{self._tries.get(name, 0)}", name)
        with self._engine.guarded():
            future = self._engine.client.submit(*call, key=key, pure=False, priority=-place)
        self._futures[name] = future
        future.add_done_callback(lambda _: self._ended.put(name))

    def next(self) -> tuple[str, Any, Exception | None]:
        """Wait until a call ends; return its name and its result, or the error with which it failed."""
        while True:
            for due in [each for each in self._paused if each[0] <= time.monotonic()]:
                self._paused.remove(due)
                place, call = self._calls[due[1]]
                self.submit(due[1], place, *call)
            try:
                name = self._ended.get(timeout=TICK)
            except queue.Empty:
                self._engine.look()
                continue
            status = self._futures[name].status
            if status not in ENDED:  # its worker has been lost since, and the scheduler repeats it
                self._engine.look()
                loop = self._engine.client.loop
                loop.add_callback(loop.call_later, TICK, self._ended.put, name)
                continue
            future = self._futures.pop(name)
            if status == "finished":
                with self._engine.guarded():
                    result = future.result()
                del self._calls[name]
                return name, result, None
            error = self._engine.failure(name, future)
            tried = self._tries.get(name, 0)
            if not isinstance(error, OSError) or error.errno in LASTING or tried >= len(PAUSES):
                del self._calls[name]
                return name, None, error
            self._tries[name] = tried + 1
            self._paused.append((time.monotonic() + PAUSES[tried], name))


#: Name of the results of probes, and of their array.
PROBE = "probe"


def probe(store: Store | None, name: str, files: Sequence[Path]) -> tuple[str, str, str]:
    """Check on a worker that it sees files, can write results, and can read the result that the client wrote.

    Returns:
        version of sparklod, host, and the fault as the end of a sentence, empty without one.
    """
    missing, fault = [str(path) for path in files if not path.exists()], ""
    if missing:
        fault = f"does not see {', '.join(missing)}: put inputs into a folder that all machines share, or at a URL"
    if store is not None:
        mine, reads = f"{name}-{uuid.uuid4().hex}", False
        try:
            store.put(mine, {PROBE: np.arange(2)})
            store.remove(mine)
        except Exception as error:
            fault = f"cannot write to {store}: {type(error).__name__}: {error}"
        with contextlib.suppress(Exception):
            reads = store.has(name) and len(store.get(name)[PROBE]) > 0
        if not reads:
            fault = (
                f"does not see what was written to {store}: give --scratch-dir a folder that all machines share, or a"
                " URL such as s3://bucket/scratch"
            )
    return __version__, socket.gethostname(), fault


def run_task(packed: bytes, task: Task, threads: int) -> tuple[int, int]:
    """Run a task on a worker, unless a worker that was lost has left its result.

    Args:
        packed: pickled job; each task unpickles its own, so that it counts its own bytes.

    Returns:
        number of bytes that the task wrote to the store, and read from it.
    """
    job = pickle.loads(packed)
    if not job.store.has(task.name):
        with memory_errors_translated():
            task.run(job, *task.arguments, threads=threads, progress=silent)
        machine.release_memory()
    return job.store.written, job.store.read


def dask_setup(worker: Any) -> None:
    """Stop the dashboard of a worker process of this machine, and leave Ctrl-C to the client."""
    worker.http_server.stop()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")


#: Seconds to wait for a scheduler, or for workers.
ANSWER_SECONDS = 30

#: How often a task is repeated on another worker after one was lost with it.
LOSSES = 2

#: Share of the machine's free memory at which a worker started here ends, before the system ends another process.
MEMORY_SHARE = 0.9

#: Share of the memory of a worker of a running cluster for its tasks: Dask pauses it at 0.8 and ends it at 0.95.
TASK_SHARE = 0.7

#: Bytes of a process before it reads inputs: Python, Dask, numba and compiled kernels.
LEAST_MEMORY = 500_000_000

#: Dask configuration of processes started here.
OWN_CONFIG = {
    # It would set variables in this process's environment, too.
    "distributed.nanny.pre-spawn-environ": {},
    # Tasks hold what they need in arrays of their own, which Dask can neither spill nor wait for.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    # Their HTTP servers know no credentials: they serve nothing until they are stopped, as soon as they have started.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}

#: Loggers of Dask and its libraries, and a level that no message reaches.
TALKERS, SILENT = ("distributed", "tornado"), logging.CRITICAL + 1

#: Address that only this machine reaches.
LOOPBACK = "127.0.0.1"

#: Scheme of schedulers that authenticate their clients by certificates.
TLS = "tls://"

#: Variables that name the files of certificates for Dask.
CERTIFICATES = "DASK_DISTRIBUTED__COMM__TLS__CA_FILE, ..__CLIENT__CERT and ..__CLIENT__KEY"


@contextlib.contextmanager
def cluster(
    scheduler: str | None = None,
    *,
    workers: int = 1,
    threads: int | None = None,
    memory: int | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[ClusterEngine]:
    """Connect to a cluster, or start one for the duration of the context, and yield its engine.

    Args:
        scheduler: address of a running cluster, as tcp://host:8786; None starts processes on this machine.
        workers: number of these processes.
        threads: of a task on a running cluster; shared by all processes started here.
        memory: bytes shared by workers started here, or for a task of a running cluster; None for the default share of
            the available memory, or of the memory of a worker.
        say: receives one-line messages for the user.

    Raises:
        SparklodError: distributed is not installed, or no scheduler or worker answers.
    """
    with optional_import("--workers and --scheduler need Dask", "cluster"):
        import distributed  # noqa: F401  # sets its loggers up
    with contextlib.ExitStack() as stack:
        stack.enter_context(_quiet())
        if scheduler is None:
            threads = max(1, thread_count(threads) // workers)
            client = stack.enter_context(_started(workers, threads, memory))
            shared = default_memory() if memory is None else memory
            limit = None if shared is None else shared // workers
        else:
            threads = threads or 1
            client = stack.enter_context(_connected(scheduler))
            known = client.scheduler_info()["workers"].values()
            limits = [each["memory_limit"] // each["nthreads"] for each in known if each["memory_limit"]]
            shares = [int(TASK_SHARE * each) for each in limits]
            limit = min(shares if memory is None else [*shares, memory], default=None)
            say(f"the cluster's dashboard is at {client.dashboard_link}")
            if not client.scheduler.address.startswith(TLS):
                say(
                    f"{client.scheduler.address} asks for no credentials: anybody who reaches it can run programs on"
                    " its workers; docs/cluster.md says how to use TLS"
                )
        engine = ClusterEngine(client, say, threads=threads, memory=limit)
        for topic in TOPICS:
            client.subscribe_topic(topic, engine.keep)
        try:
            yield engine
        finally:
            for topic in TOPICS if engine.alive else ():
                client.unsubscribe_topic(topic)


@contextlib.contextmanager
def _connected(address: str) -> Iterator[Any]:
    """Connect to a running cluster, and yield the client."""
    from distributed import Client

    whole = address if "://" in address else f"tcp://{address}"
    try:
        client = Client(whole, timeout=ANSWER_SECONDS, security=_credentials(whole), set_as_default=False)
    except (OSError, ValueError) as error:
        raise SparklodError(
            f"no scheduler answers at {whole} ({error}); start one with dask scheduler, and dask worker {whole}"
        ) from None
    try:
        try:
            client.wait_for_workers(1, timeout=ANSWER_SECONDS)
        except TimeoutError:
            raise SparklodError(
                f"the cluster at {whole} has no workers; start some with dask worker {whole} --nthreads 1"
            ) from None
        yield client
    finally:
        with contextlib.suppress(TimeoutError):  # the scheduler is gone
            client.close(timeout=1)


def _credentials(address: str) -> Any:
    """Read the certificates that Dask's configuration names; fail if they are missing or unreadable.

    Without this check, Dask fails a minute later, at the end of the process.
    """
    from distributed import Security

    security = Security()
    try:
        context = security.get_connection_args("client")["ssl_context"]
    except OSError as error:
        raise SparklodError(f"a file that {CERTIFICATES} name cannot be read ({error})") from None
    if context is None and address.startswith(TLS):
        raise SparklodError(f"{address} asks for a certificate; set {CERTIFICATES}")
    return security


@contextlib.contextmanager
def _started(workers: int, threads: int, memory: int | None) -> Iterator[Any]:
    """Start processes on this machine, and yield their only client: certificates keep other users off the ports."""
    import dask
    from distributed import Client, LocalCluster, Security

    with optional_import("--workers needs cryptography", "cluster"):
        security = Security.temporary()  # for this cluster only; workers get the key through pipes
    with contextlib.ExitStack() as stack:
        check_current_folder()
        stack.enter_context(safe_path())  # until the end, as lost workers start again
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="sparklod-"))
        # Set here, as an argument of LocalCluster would not reach the scheduler, which has a folder, too.
        stack.enter_context(dask.config.set(OWN_CONFIG | {"temporary-directory": folder}))
        try:
            own = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host=LOOPBACK,
                security=security,
                dashboard_address=None,
                memory_limit=_memory_limit(workers, memory),
                env={"NUMBA_NUM_THREADS": str(threads)},
                preload=["sparklod_cli.bake.cluster"],
                scheduler_kwargs={"allowed_failures": LOSSES},
                silence_logs=SILENT,
            )
        except (OSError, RuntimeError, TimeoutError) as error:
            raise SparklodError(f"no cluster can be started on this machine: {error}") from None
        stack.callback(_end, own)
        own.loop.add_callback(own.scheduler.http_server.stop)
        client = stack.enter_context(contextlib.closing(Client(own, timeout=ANSWER_SECONDS, set_as_default=False)))
        yield client


def _end(own: Any) -> None:
    """End workers with their tasks; results that are needed are in the store."""
    for nanny in list(own.workers.values()):
        process = getattr(getattr(nanny, "process", None), "process", None)
        nanny.auto_restart = False
        if process is not None:
            with contextlib.suppress(Exception):
                own.sync(process.kill)
    with contextlib.suppress(Exception):
        own.close(timeout=5)


def _memory_limit(workers: int, memory: int | None) -> int:
    """Return the memory limit of a worker started here: its share of --memory, or of free memory if that is more."""
    free = machine.available_memory() or 0
    return max(LEAST_MEMORY, max(memory or 0, int(MEMORY_SHARE * free)) // workers)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the messages of Dask; the engine itself reports problems of workers and the scheduler."""
    names = [name for name in logging.Logger.manager.loggerDict if name.partition(".")[0] in TALKERS]
    before = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(SILENT)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


def bake_side_by_side(
    pairs: Sequence[tuple[Source, Place]],
    *,
    make: Callable[..., Baked | None],
    settings: BakeSettings,
    engine: ClusterEngine,
    resources: Resources,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Generator[Any, None, None]:
    """Bake each scene that fits into a worker as one task.

    Args:
        pairs: inputs and outputs, which all workers see.
        make: function of a module that bakes a scene, such as `flow.bake`.
        resources: of a worker.

    Yields:
        the `Baked` or the `SparklodError` of each scene, in order; `LARGE` for a scene that exceeds a worker's memory.
    """
    small = [_fits_in_memory(source, settings, resources.memory) for source, _ in pairs]
    # Workers have working folders of their own.
    settings = dataclasses.replace(settings, **{name: path.absolute() for name, path in settings.files.items()})
    whole = [(absolute_source(source), absolute(target)) for source, target in pairs]
    engine.check(None, [place for source, _ in whole for place in places_of(source)])
    call = functools.partial(make, settings=settings, overwrite=overwrite, resources=resources)
    calls = list(itertools.compress(whole, small))
    with engine.map_calls("baking", call, calls, progress, "scene") as outcomes:
        for (_, target), is_small in zip(pairs, small, strict=True):
            outcome = next(outcomes) if is_small else LARGE
            if isinstance(outcome, Baked) and isinstance(target, Path) and not target.exists():
                outcome = SparklodError(
                    f"a worker wrote {target} into a folder that is not seen here: give --output-dir a folder that all"
                    " machines share, or a URL"
                )
            yield outcome


def _fits_in_memory(source: Source, settings: BakeSettings, memory: int | None) -> bool:
    """Return whether an input can be baked in this many bytes of memory; trees and unreadable inputs always can."""
    try:
        with open_reader(source) as header:
            needed = in_memory_bytes(settings, header.count, header.sh_degree)
            return header.has_tree or memory is None or needed <= memory
    except FormatError:  # reported when it is baked
        return True
