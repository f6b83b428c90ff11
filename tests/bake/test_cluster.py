"""Dask clusters: tasks, bakes, buckets, failures, and attacks by a program without credentials."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import logging
import os
import pickle
import signal
import socket
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cryptography")
pytest.importorskip("distributed")

import dask
import distributed
import psutil

from sparklod_cli.bake import cluster as module
from sparklod_cli.bake.cluster import ClusterEngine, cluster
from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.job import Engine, Task
from sparklod_cli.bake.settings import Baked, BakeSettings, Resources
from sparklod_cli.bake.store import Store
from sparklod_cli.cli import run
from sparklod_cli.codecs.formats import RAD_SUFFIX as RAD
from sparklod_cli.system.addresses import Address, Place
from sparklod_cli.system.errors import OutOfMemoryError, ScratchError, SparklodError
from sparklod_cli.system.progress import Progress, silent
from tests.bake import jobs
from tests.bake.jobs import Job, tree_of
from tests.conftest import FIXTURES

pytestmark = pytest.mark.slow

DEMO = FIXTURES / "demo.ply"

#: Seconds that a client with the credentials waits on a busy machine, and one without them.
PATIENCE, TRIES = 60, 2

#: Messages of the engine of two processes.
SAID: list[str] = []

#: Resources of a bake in some eight blocks.
BLOCKS = Resources(block_splats=4000)


def listening() -> dict[int, int]:
    """Ports on which this process and those that it started listen, with the process of each."""
    here = psutil.Process()
    return {
        connection.laddr.port: process.pid
        for process in (here, *here.children(recursive=True))
        for connection in process.net_connections(kind="inet")
        if connection.status == psutil.CONN_LISTEN
    }


@pytest.fixture(scope="module")
def attacked() -> Iterator[tuple[ClusterEngine, dict[int, int]]]:
    """An engine, and the ports on which its processes listen."""
    before, said = listening(), list[str]()
    with cluster(workers=1, say=said.append) as engine:
        yield engine, {port: pid for port, pid in listening().items() if port not in before}
    assert said == []  # no address of a dashboard


async def answered(security: Any, addresses: list[str], patience: float) -> list[str]:
    """Return the addresses at which a scheduler, nanny or worker answers a request for its identity."""

    async def is_answered(address: str) -> bool:
        server = distributed.rpc(address, timeout=patience, connection_args=security.get_connection_args("client"))
        with contextlib.suppress(OSError):
            await server.identity()
            return True
        return False

    answers = await asyncio.gather(*map(is_answered, addresses))
    return [address for address, answer in zip(addresses, answers, strict=True) if answer]


def test_no_port_answers_without_credentials(attacked: tuple[ClusterEngine, dict[int, int]], tmp_path: Path) -> None:
    engine, ports = attacked
    assert set(ports.values()) == {os.getpid(), *engine.client.run(os.getpid).values()}
    own, tls = engine.client.security, [f"tls://127.0.0.1:{port}" for port in ports]
    assert asyncio.run(answered(own, tls, PATIENCE)) == tls  # nothing else listens
    assert asyncio.run(answered(distributed.Security.temporary(), tls, TRIES)) == []
    tcp = [address.replace("tls", "tcp") for address in tls]
    assert asyncio.run(answered(distributed.Security(), tcp, TRIES)) == []
    job, tasks = Job(Store(tmp_path)), tree_of(4)
    engine.run("building", tasks, job, silent)
    assert job.store.has(tasks[-1].name)


def test_no_port_answers_a_browser(attacked: tuple[ClusterEngine, dict[int, int]]) -> None:
    for port in attacked[1]:
        answer = b""
        with socket.create_connection(("127.0.0.1", port), PATIENCE) as browser, contextlib.suppress(ConnectionError):
            browser.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            answer = browser.recv(4)
        assert answer != b"HTTP"


def test_the_key_is_in_no_command_line_or_environment(attacked: tuple[ClusterEngine, dict[int, int]]) -> None:
    key = attacked[0].client.security.tls_worker_key.splitlines()[1]
    for pid in set(attacked[1].values()):
        process = psutil.Process(pid)
        assert key not in " ".join(process.cmdline())
        assert key not in "".join(process.environ().values())


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ClusterEngine]:
    """An engine of two processes."""
    temporary = tmp_path_factory.mktemp("temporary")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(temporary))
        with cluster(workers=2, threads=2, say=SAID.append) as started:
            assert list(temporary.iterdir())
            yield started
    assert not list(temporary.iterdir())


@pytest.fixture
def job(tmp_path: Path) -> Job:
    SAID.clear()
    return Job(Store(tmp_path / "store"))


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PAUSES", (0.0, 0.0))
    monkeypatch.setattr(module, "TICK", 0.05)


def local_cluster(**options: Any) -> contextlib.AbstractContextManager[Any]:
    """A scheduler with a worker in this process, which sees its addresses."""
    own = {"protocol": "tcp", "dashboard_address": None, "silence_logs": logging.CRITICAL, **options}
    return _closed(distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, **own))


@contextlib.contextmanager
def _closed(running: Any) -> Iterator[Any]:
    try:
        yield running
    finally:
        with contextlib.suppress(TimeoutError):  # a test closed it
            running.close(timeout=1)


@pytest.fixture
def scheduler() -> Iterator[Any]:
    with local_cluster() as running:
        yield running


def test_tasks_run_on_all_workers_after_those_that_they_need(engine: ClusterEngine, job: Job) -> None:
    tasks, progress = tree_of(16, seconds=0.02), list[tuple[str, int, int, str]]()
    engine.run("building", tasks, job, lambda *args: progress.append(args))
    assert int(job.store.get(tasks[-1].name)["total"][0]) == len(tasks)
    assert len({int(job.store.get(task.name)["process"][0]) for task in tasks}) == 2
    total = sum(task.weight for task in tasks)
    assert progress[0] == ("building", 0, total, "splat") and progress[-1] == ("building", total, total, "splat")
    assert [done for _, done, _, _ in progress] == sorted(done for _, done, _, _ in progress)
    assert job.store.written > 0  # by workers
    assert len(pickle.dumps(job)) < 1000
    job.store.remove(tasks[-1].name)
    progress.clear()
    engine.run("building", tasks, job, lambda *args: progress.append(args))
    assert [done for _, done, _, _ in progress] == [total - 1, total]


def test_tasks_are_repeated_after_a_killed_worker_and_a_broken_connection(engine: ClusterEngine, job: Job) -> None:
    tasks = [*tree_of(8, seconds=0.05), Task("dies", jobs.die_once, ("dies",))]
    tasks += [Task("stumbles", jobs.stumble_once, ("stumbles",))]
    engine.run("building", tasks, job, silent)
    assert all(job.store.has(task.name) for task in tasks)
    assert any("was lost; to be done again: " in text and "dies" in text for text in SAID)


def test_an_error_for_users_is_raised_at_the_first_try(engine: ClusterEngine, job: Job) -> None:
    tasks = [Task("full", jobs.fill_disk, ("full",)), *tree_of(16, seconds=0.5)]
    with pytest.raises(ScratchError, match=r"^there is no room left in the scratch folder /scratch$"):
        engine.run("building", tasks, job, silent)
    assert job.store.has("tried/full/0") and not job.store.has("tried/full/1")
    assert not job.store.has(tasks[-1].name)


def test_a_task_that_fails_with_its_result_in_the_store_is_done(engine: ClusterEngine, job: Job) -> None:
    engine.run("building", [Task("tried/twin/0", jobs.fill_disk, ("twin",))], job, silent)


def test_an_error_of_the_program_is_raised_unchanged(engine: ClusterEngine, job: Job) -> None:
    with pytest.raises(TypeError, match=r"add_up"):
        engine.run("building", [Task("wrong", jobs.add_up)], job, silent)


def test_parallel_calls_yield_results_and_errors_in_order(engine: ClusterEngine) -> None:
    progress: list[tuple[str, int, int, str]] = []
    arguments = [(number,) for number in range(6)]
    with engine.map_calls("baking", jobs.twice, arguments, lambda *args: progress.append(args), "scene") as outcomes:
        results = list(outcomes)
    assert [each if isinstance(each, int) else str(each) for each in results] == [0, 2, 4, "no 3", 8, 10]
    assert isinstance(results[3], ScratchError)
    assert progress[0] == ("baking", 0, 6, "scene")
    assert [each[1] for each in progress] == sorted(each[1] for each in progress)
    with engine.map_calls("baking", jobs.twice, [(0,)] * 100, silent, "scene") as outcomes:
        assert next(outcomes) == 0  # the other calls are cancelled
    with engine.map_calls("baking", jobs.twice, [(21,)], silent, "scene") as outcomes:
        assert list(outcomes) == [42]


def test_a_result_lost_with_its_worker_is_waited_for(engine: ClusterEngine) -> None:
    with module.Pool(engine, "baking") as pool:
        pool.submit("twice", 0, functools.partial(jobs.twice, threads=1), 21)
        future = pool._futures["twice"]
        future.result(timeout=60)
        loop, lost = engine.client.loop, threading.Event()
        loop.add_callback(future._state.lose)  # as when the scheduler hears that the worker is gone
        loop.add_callback(lost.set)
        assert lost.wait(60) and future.status == "lost"
        loop.add_callback(loop.call_later, 0.5, future._state.finish)
        assert pool.next() == ("twice", 42, None)


class LocalStore(Store):
    """A folder of one machine: its copy in another process is another folder."""

    def __reduce__(self) -> Any:
        return Store, (self.folder / "there",)


def test_workers_with_another_version_or_other_folders_are_refused(
    engine: ClusterEngine, job: Job, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    engine.check(None, [tmp_path, tmp_path / "missing.ply"])  # a file missing everywhere is reported by its task
    only_here = Path(f"/proc/self/task/{os.getpid()}")
    if only_here.exists():
        with pytest.raises(SparklodError, match=r"does not see /proc/self/task/.*: put inputs into a folder that all"):
            engine.check(None, [only_here])
    with monkeypatch.context() as patch:
        patch.setattr(module, "__version__", "9.9")
        with pytest.raises(SparklodError, match=r"has sparklod .*, not 9\.9 as here: install sparklod"):
            engine.check(job.store)
    with pytest.raises(SparklodError, match=r"does not see what was written to .*--scratch-dir a folder that all"):
        engine.check(LocalStore(tmp_path / "here"))
    assert not list(tmp_path.rglob("*.npy"))


def test_a_worker_without_sparklod_is_refused(engine: ClusterEngine, job: Job) -> None:
    client = engine.client
    client.wait_for_workers(1, timeout=60)  # others that a test killed may only now be replaced
    client.run(_hide, module.__name__)
    try:
        with pytest.raises(SparklodError, match=r"does not run sparklod .*: install sparklod .* extra cluster there"):
            engine.check(job.store)
    finally:
        client.run(_show, module.__name__)


def _hide(module: str) -> None:
    import sys

    sys.modules["hidden"] = sys.modules.pop(module, None)  # type: ignore[assignment]
    sys.modules[module] = None  # type: ignore[assignment]


def _show(module: str) -> None:
    """Undo `_hide`, also on a worker that came since."""
    import sys

    if "hidden" in sys.modules:
        del sys.modules[module]
        if (hidden := sys.modules.pop("hidden")) is not None:
            sys.modules[module] = hidden


def test_a_block_that_does_not_fit_into_memory_is_named(job: Job, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("LOSSES", 0), ("MEMORY_SHARE", 0), ("LEAST_MEMORY", 400_000_000)):
        monkeypatch.setattr(module, name, value)
    with cluster(workers=1) as started:
        with pytest.raises(
            OutOfMemoryError, match=r"^stage/7 does not fit into the memory of a worker; give a smaller"
        ):
            started.run("building", [Task("stage/7", jobs.devour, ("stage/7",))], job, silent)
        with pytest.raises(SparklodError, match=r"^each worker that did stage/8 was lost, the last one tls://"):
            started.run("building", [Task("stage/8", jobs.die, ("stage/8",))], job, silent)


def baked(
    source: Place,
    target: Place,
    settings: BakeSettings,
    engine: Engine | None,
    progress: Progress = silent,
    **resources: Any,
) -> tuple[Baked, bytes]:
    """Bake in blocks; return the result without its times, and the bytes."""
    used = dataclasses.replace(BLOCKS, **resources)
    result = bake(source, target, settings, resources=used, engine=engine, threads=2, progress=progress)
    with target.open("rb") as file:
        return dataclasses.replace(result, seconds={}), file.read()


@pytest.mark.parametrize("settings", [BakeSettings(), BakeSettings(method="quality", suffix=RAD)])
def test_the_bytes_do_not_depend_on_the_workers(
    settings: BakeSettings, engine: ClusterEngine, scheduler: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # workers have other folders
    expected = baked(DEMO, tmp_path / f"none{settings.suffix}", settings, None)
    assert expected[0].blocks is not None and expected[0].blocks > 4
    with cluster(scheduler=scheduler.scheduler_address) as one:
        for name, workers in (("one", one), ("two", engine)):
            result = baked(DEMO, Path(f"{name}{settings.suffix}"), settings, workers)
            assert result[1] == expected[1]
            assert result[0].blocks == expected[0].blocks and result[0].scratch_bytes_written
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [settings.suffix] * 3


class Once:
    """A progress that acts when the first block is built."""

    def __init__(self, act: Callable[[], object]) -> None:
        self.act, self.acted = act, False

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None:
        if stage == "building" and done and not self.acted:
            self.acted = True
            self.act()


def test_a_killed_worker_changes_no_byte(tmp_path: Path) -> None:
    expected = baked(DEMO, tmp_path / "none.spz", BakeSettings(), None)
    said: list[str] = []
    with cluster(workers=2, threads=2, say=said.append) as engine:
        pids = list(engine.client.run(os.getpid).values())
        kill = Once(lambda: os.kill(pids[0], signal.SIGKILL))
        assert baked(DEMO, tmp_path / "killed.spz", BakeSettings(), engine, kill)[1] == expected[1]
        assert kill.acted
        for _ in range(600):  # the bake may have ended before the scheduler knew
            engine.tell_losses()
            if any("was lost" in text for text in said):
                break
            time.sleep(0.1)
        else:
            pytest.fail("the lost worker is not reported")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["killed.spz", "none.spz"]


def test_a_bake_resumes_after_its_scheduler_ended(scheduler: Any, tmp_path: Path) -> None:
    expected = baked(DEMO, tmp_path / "none.spz", BakeSettings(), None)
    close = Once(lambda: scheduler.loop.add_callback(scheduler.scheduler.close))
    target = tmp_path / "gone.spz"
    with (
        cluster(scheduler=scheduler.scheduler_address) as one,
        pytest.raises(
            SparklodError, match=r"scheduler of the cluster no longer answers; finished work is kept.*add --"
        ),
    ):
        baked(DEMO, target, BakeSettings(), one, close)
    assert not target.exists()
    stages: list[tuple[str, int]] = []
    resumed = baked(DEMO, target, BakeSettings(), None, lambda *step: stages.append(step[:2]), resume=True)
    assert resumed[1] == expected[1]
    assert next(done for stage, done in stages if stage == "building") > 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gone.spz", "none.spz"]


def test_a_bake_at_addresses_has_the_bytes_of_one_at_paths(scheduler: Any, tmp_path: Path) -> None:
    folder = Address(f"memory://{uuid.uuid4().hex}")
    for name, block in (("demo.ply", 6000), ("golden/hand-v4.spz", 20)):  # the latter is unpacked first
        source = folder / Path(name).name
        source.write([(FIXTURES / name).read_bytes()])
        expected = baked(FIXTURES / name, tmp_path / f"{source.stem}.spz", BakeSettings(), None, block_splats=block)
        with cluster(scheduler=scheduler.scheduler_address) as one:
            for engine in (None, one):
                target = folder / f"{source.stem}-{engine is None}-lod.spz"
                places = {"scratch_dir": folder / "scratch", "block_splats": block}
                assert baked(source, target, BakeSettings(), engine, **places)[1] == expected[1]
    assert not [name for name in folder.files() if name.startswith("scratch")]


def test_a_scratch_folder_that_processes_do_not_share_is_refused(engine: ClusterEngine) -> None:
    folder = Address(f"memory://{uuid.uuid4().hex}")
    with pytest.raises(
        SparklodError, match=r"does not see what was written to memory://.*: give --scratch-dir a folder"
    ):
        baked(DEMO, folder / "lod.spz", BakeSettings(), engine, scratch_dir=folder)
    assert folder.files() == []


def test_a_running_scheduler_is_used_and_left_running(scheduler: Any, tmp_path: Path) -> None:
    job, address = Job(Store(tmp_path)), scheduler.scheduler_address.removeprefix("tcp://")
    said: list[str] = []
    for count in (4, 8):
        tasks = tree_of(count)
        with cluster(scheduler=address, say=said.append) as engine:
            engine.run("building", tasks, job, silent)
        assert job.store.has(tasks[-1].name)
    assert len(said) == 4 and "dashboard" in said[0]
    assert said[1].startswith(f"tcp://{address} asks for no credentials: anybody who reaches it can run programs")


def test_a_scheduler_with_certificates_needs_those_of_dask_s_configuration(tmp_path: Path) -> None:
    own, job, said = distributed.Security.temporary(), Job(Store(tmp_path)), list[str]()
    prefix = "distributed.comm.tls"
    names = {
        f"{prefix}.ca-file": own.tls_ca_file,
        f"{prefix}.client.cert": own.tls_client_cert,
        f"{prefix}.client.key": own.tls_client_key,
    }
    with local_cluster(protocol="tls", security=own) as running:
        at = running.scheduler_address
        with pytest.raises(SparklodError, match=r"^tls://.* asks for a certificate; set DASK_"), cluster(at):
            pass
        lost = dask.config.set({f"{prefix}.ca-file": "lost.pem", f"{prefix}.client.cert": "lost.pem"})
        with lost, pytest.raises(SparklodError, match=r"^a file that DASK_.* name cannot be read"), cluster(at):
            pass
        tasks = tree_of(4)
        with dask.config.set(names), cluster(at, say=said.append) as engine:
            engine.run("building", tasks, job, silent)
    assert job.store.has(tasks[-1].name)
    assert len(said) == 1 and "dashboard" in said[0]


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


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """An empty bucket of an S3 server in this process."""
    pytest.importorskip("s3fs", reason="s3:// needs the extra cloud")
    server = pytest.importorskip("moto.server", reason="moto[server] is not installed")
    import fsspec

    running = server.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "nobody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "nothing")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    name = f"scans-{uuid.uuid4().hex}"  # the server's buckets are those of the process
    fsspec.filesystem("s3").mkdir(name)
    try:
        yield f"s3://{name}"
    finally:
        running.stop()
        fsspec.filesystem("s3").clear_instance_cache()


def contents(folder: Place, names: list[str]) -> dict[str, bytes]:
    """Bytes of files of a folder by their names."""
    data = {}
    for name in names:
        with (folder / name).open("rb") as file:
            data[name] = file.read()
    return data


@pytest.mark.parametrize(
    "options", [[], ["--format", "rad"], ["--format", "rad-chunked"]], ids=["spz", "rad", "chunks"]
)
def test_the_command_bakes_from_bucket_to_bucket(bucket: str, options: list[str], tmp_path: Path) -> None:
    Address(f"{bucket}/demo.ply").write([DEMO.read_bytes()])
    assert run(["build-lod", f"{bucket}/demo.ply", "--output-dir", f"{bucket}/web", "--quiet", *options]) == 0
    assert run(["build-lod", str(DEMO), "--output-dir", str(tmp_path), "--quiet", *options]) == 0
    folder = Address(f"{bucket}/web")
    assert contents(folder, folder.files()) == contents(tmp_path, [path.name for path in tmp_path.iterdir()])


def test_workers_share_a_scratch_folder_in_a_bucket(bucket: str, tmp_path: Path) -> None:
    Address(f"{bucket}/demo.ply").write([DEMO.read_bytes()])
    resources = Resources(block_splats=14_000, scratch_dir=Address(f"{bucket}/scratch"))
    target = Address(f"{bucket}/demo-lod.spz")
    with cluster(workers=2, threads=2) as engine:
        result = bake(
            Address(f"{bucket}/demo.ply"), target, BakeSettings(), resources=resources, engine=engine, threads=2
        )
    assert result.blocks is not None and result.blocks > 1
    bake(DEMO, tmp_path / "demo-lod.spz", BakeSettings())
    assert contents(Address(bucket), ["demo-lod.spz"]) == contents(tmp_path, ["demo-lod.spz"])
    assert sorted(Address(bucket).files()) == ["demo-lod.spz", "demo.ply"]
