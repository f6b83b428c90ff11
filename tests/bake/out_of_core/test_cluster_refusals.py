"""Schedulers that are not there, or go away."""

from __future__ import annotations

import contextlib
import threading
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("distributed")

import dask
import distributed

from sparklod_cli.bake.out_of_core import cluster as module
from sparklod_cli.bake.out_of_core.cluster import cluster
from sparklod_cli.bake.out_of_core.store import Store
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.system.progress import silent

from .made_up import Job, tree_of

pytestmark = pytest.mark.slow


@pytest.fixture
def scheduler() -> Any:
    """A scheduler with a worker, in this process."""
    with module._quiet():
        yield from _scheduler()


def _scheduler(**how: Any) -> Any:
    own = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, **(how or {"protocol": "tcp"})
    )
    try:
        yield own
    finally:
        with contextlib.suppress(TimeoutError):  # a test closed it
            own.close(timeout=1)


def test_a_scheduler_that_runs_is_used_and_left_alone(scheduler: Any, tmp_path: Path) -> None:
    job, address = Job(Store(tmp_path)), scheduler.scheduler_address.removeprefix("tcp://")
    said: list[str] = []
    for count in (4, 8):
        tasks = tree_of(count)
        with cluster(scheduler=address, say=said.append) as engine:
            engine.run("building", tasks, job, silent)
        assert job.store.has(tasks[-1].name)
    assert len(said) == 4 and "dashboard" in said[0]
    assert said[1].startswith(f"tcp://{address} asks for no credentials: anybody who reaches it can run programs")


def test_a_scheduler_with_certificates_is_used_with_those_of_dask_s_settings(tmp_path: Path) -> None:
    pytest.importorskip("cryptography")
    own, job, said = distributed.Security.temporary(), Job(Store(tmp_path)), list[str]()
    of_dask = "distributed.comm.tls"
    names = {
        f"{of_dask}.ca-file": own.tls_ca_file,
        f"{of_dask}.client.cert": own.tls_client_cert,
        f"{of_dask}.client.key": own.tls_client_key,
    }
    with module._quiet(), contextlib.contextmanager(_scheduler)(protocol="tls", security=own) as running:
        at = running.scheduler_address
        with pytest.raises(SparklodError, match=r"^tls://.* asks for a certificate; set DASK_"), cluster(at):
            pass
        lost = dask.config.set({f"{of_dask}.ca-file": "lost.pem", f"{of_dask}.client.cert": "lost.pem"})
        with lost, pytest.raises(SparklodError, match=r"^a file that DASK_.* name cannot be read"), cluster(at):
            pass
        tasks = tree_of(4)
        with dask.config.set(names), cluster(at, say=said.append) as engine:
            engine.run("building", tasks, job, silent)
    assert job.store.has(tasks[-1].name)
    assert len(said) == 1 and "dashboard" in said[0]


def test_a_scheduler_that_goes_away_keeps_what_is_done(scheduler: Any, tmp_path: Path) -> None:
    job, tasks = Job(Store(tmp_path)), tree_of(64, seconds=0.05)
    with cluster(scheduler=scheduler.scheduler_address) as engine:

        def close() -> None:
            while not job.store.has(tasks[0].name):
                time.sleep(0.01)
            scheduler.loop.add_callback(scheduler.scheduler.close)

        threading.Thread(target=close, daemon=True).start()
        with pytest.raises(SparklodError, match=r"scheduler of the cluster no longer answers.*add --resume"):
            engine.run("building", tasks, job, silent)
    assert job.store.has(tasks[0].name) and not job.store.has(tasks[-1].name)


def test_a_cluster_without_workers_is_refused(scheduler: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    wait = distributed.Client.wait_for_workers
    monkeypatch.setattr(distributed.Client, "wait_for_workers", lambda client, count, timeout: wait(client, count, 0.2))
    scheduler.scale(0)
    while scheduler.scheduler.workers:
        time.sleep(0.01)
    with (
        pytest.raises(SparklodError, match=r"has no workers; start some with dask worker tcp://"),
        cluster(scheduler=scheduler.scheduler_address),
    ):
        pass


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "127.0.0.1:9", "nonsense://x:1"])
def test_an_address_without_a_scheduler_is_refused(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ANSWER_SECONDS", 0.2)
    with (
        pytest.raises(SparklodError, match=r"no scheduler answers at .*; start one with dask scheduler"),
        cluster(scheduler=address),
    ):
        pass
