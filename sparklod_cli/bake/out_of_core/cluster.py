"""Dask clusters: a running one, or processes on this machine that are started and ended with a bake."""

from __future__ import annotations

import contextlib
import logging
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from ...system import machine
from ...system.errors import SparklodError
from ...system.optional import optional_import
from ...system.python_process import check_current_folder, safe_path
from ...system.threads import thread_count
from ..estimate import default_memory
from .cluster_engine import ClusterEngine, Connection

#: Seconds to wait for a scheduler, or for workers.
PATIENCE = 30

#: How often a task is repeated on another worker after one was lost with it.
LOSSES = 2

#: Share of the machine's free memory at which a worker started here is ended, before the system ends another process.
MEMORY_SHARE = 0.9

#: Share of the memory of a worker of a running cluster for its tasks: Dask pauses it at 0.8 and ends it at 0.95.
TASK_SHARE = 0.7

#: Bytes of a process that has read nothing: Python, Dask, numba and compiled kernels.
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


@dataclass(frozen=True)
class ClusterSettings:
    """Cluster that runs the tasks of a bake.

    Attributes:
        scheduler: address of a running cluster, as tcp://host:8786; None starts processes on this machine.
        workers: number of these processes.
        threads: of a task on a running cluster; shared by all processes started here.
    """

    scheduler: str | None = None
    workers: int = 1
    threads: int | None = None


@contextlib.contextmanager
def cluster(
    settings: ClusterSettings,
    *,
    memory: int | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[ClusterEngine]:
    """Yield an engine on a cluster, which is ended with the context if it was started here.

    Args:
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
        if settings.scheduler is None:
            threads = max(1, thread_count(settings.threads) // settings.workers)
            client = stack.enter_context(_started(settings.workers, threads, memory))
            shared = default_memory() if memory is None else memory
            limit = None if shared is None else shared // settings.workers
        else:
            threads = settings.threads or 1
            client = stack.enter_context(_connected(settings.scheduler))
            limit = _least_memory(client, memory)
            say(f"the cluster's dashboard is at {client.dashboard_link}")
            if not client.scheduler.address.startswith(TLS):
                say(
                    f"{client.scheduler.address} asks for no credentials: anybody who reaches it can run programs on"
                    " its workers; docs/cluster.md says how to use TLS"
                )
        with Connection(client, say) as connection:
            yield ClusterEngine(connection, threads=threads, memory=limit)


@contextlib.contextmanager
def _connected(address: str) -> Iterator[Any]:
    """Yield a client of a running cluster."""
    from distributed import Client

    whole = address if "://" in address else f"tcp://{address}"
    try:
        client = Client(whole, timeout=PATIENCE, security=_credentials(whole), set_as_default=False)
    except (OSError, ValueError) as error:
        raise SparklodError(
            f"no scheduler answers at {whole} ({error}); start one with dask scheduler, and dask worker {whole}"
        ) from None
    try:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise SparklodError(
                f"the cluster at {whole} has no workers; start some with dask worker {whole} --nthreads 1"
            ) from None
        yield client
    finally:
        with contextlib.suppress(TimeoutError):  # the scheduler is gone
            client.close(timeout=1)


def _credentials(address: str) -> Any:
    """Return the certificates that Dask's configuration names; fail if they are missing or unreadable.

    Without this check, Dask fails at the end of the process, after a minute.
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
    """Yield a client of processes on this machine. They answer no other client: other users reach their ports."""
    import dask
    from distributed import Client, LocalCluster, Security

    with optional_import("--workers needs cryptography", "cluster"):
        security = Security.temporary()  # for this cluster alone; workers get the key through pipes
    with contextlib.ExitStack() as stack:
        check_current_folder()
        stack.enter_context(safe_path())  # until the end, as lost workers are started again
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="sparklod-"))
        # An argument of LocalCluster reaches its workers only, and the scheduler has a folder, too.
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
                preload=["sparklod_cli.bake.out_of_core.cluster_engine"],
                scheduler_kwargs={"allowed_failures": LOSSES},
                silence_logs=SILENT,
            )
        except (OSError, RuntimeError, TimeoutError) as error:
            raise SparklodError(f"no cluster can be started on this machine: {error}") from None
        stack.callback(_end, own)
        own.loop.add_callback(own.scheduler.http_server.stop)
        client = stack.enter_context(contextlib.closing(Client(own, timeout=PATIENCE, set_as_default=False)))
        yield client


def _end(own: Any) -> None:
    """End workers and their tasks: all results needed are in the store."""
    for nanny in list(own.workers.values()):
        process = getattr(getattr(nanny, "process", None), "process", None)
        nanny.auto_restart = False
        if process is not None:
            with contextlib.suppress(Exception):
                own.sync(process.kill)
    with contextlib.suppress(Exception):
        own.close(timeout=5)


def _least_memory(client: Any, memory: int | None) -> int | None:
    """Return the memory of a task in bytes: the least of all workers and of --memory; None for no limit."""
    workers = client.scheduler_info()["workers"].values()
    limits = [each["memory_limit"] // each["nthreads"] for each in workers if each["memory_limit"]]
    return min([int(TASK_SHARE * limit) for limit in limits] + ([] if memory is None else [memory]), default=None)


def _memory_limit(workers: int, memory: int | None) -> int:
    """Return the memory at which a worker started here is ended: its share of --memory, or of free memory if more."""
    free = machine.available_memory() or 0
    return max(LEAST_MEMORY, max(memory or 0, int(MEMORY_SHARE * free)) // workers)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence Dask's own messages; the engine reports worker and scheduler problems itself."""
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
