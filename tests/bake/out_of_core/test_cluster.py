"""An engine on a real Dask cluster of two processes."""

from __future__ import annotations

import functools
import os
import pickle
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cryptography")
pytest.importorskip("distributed")

from sparklod_cli.bake.out_of_core import cluster as module
from sparklod_cli.bake.out_of_core.cluster import ClusterEngine, cluster
from sparklod_cli.bake.out_of_core.job import Task
from sparklod_cli.bake.out_of_core.store import Store
from sparklod_cli.system.errors import OutOfMemoryError, ScratchError, SparklodError
from sparklod_cli.system.progress import silent

from . import made_up
from .made_up import Job, tree_of

pytestmark = pytest.mark.slow

SAID: list[str] = []


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ClusterEngine]:
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
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PAUSES", (0.0, 0.0))
    monkeypatch.setattr(module, "TICK", 0.05)


def test_tasks_run_after_what_they_need_on_all_workers(engine: ClusterEngine, job: Job) -> None:
    tasks, told = tree_of(16, seconds=0.02), list[tuple[str, int, int, str]]()
    engine.run("building", tasks, job, lambda *args: told.append(args))
    assert int(job.store.get(tasks[-1].name)["total"][0]) == len(tasks)
    assert len({int(job.store.get(task.name)["process"][0]) for task in tasks}) == 2
    total = sum(task.weight for task in tasks)
    assert told[0] == ("building", 0, total, "splat") and told[-1] == ("building", total, total, "splat")
    assert [done for _, done, _, _ in told] == sorted(done for _, done, _, _ in told)


def test_what_is_done_is_not_done_again(engine: ClusterEngine, job: Job) -> None:
    tasks = tree_of(4)
    engine.run("building", tasks, job, silent)
    written = job.store.written
    assert written > 0  # what workers wrote
    job.store.remove(tasks[-1].name)
    told: list[int] = []
    engine.run("building", tasks, job, lambda stage, done, total, unit: told.append(done))
    assert told == [40, 41]


def test_a_worker_that_is_killed_is_made_up_for(engine: ClusterEngine, job: Job) -> None:
    tasks = [*tree_of(8, seconds=0.05), Task("dies", made_up.die_once, ("dies",))]
    engine.run("building", tasks, job, silent)
    assert all(job.store.has(task.name) for task in tasks)
    assert any("was lost; to be done again: " in text and "dies" in text for text in SAID)


def test_a_connection_that_breaks_is_tried_again(engine: ClusterEngine, job: Job) -> None:
    engine.run("building", [Task("stumbles", made_up.stumble_once, ("stumbles",))], job, silent)
    assert job.store.has("stumbles")


def test_an_error_for_people_comes_through_and_is_not_tried_again(engine: ClusterEngine, job: Job) -> None:
    tasks = [Task("full", made_up.fill_disk, ("full",)), *tree_of(16, seconds=0.5)]
    with pytest.raises(ScratchError, match=r"^there is no room left in the scratch folder /scratch$"):
        engine.run("building", tasks, job, silent)
    assert job.store.has("tried/full/0") and not job.store.has("tried/full/1")
    assert not job.store.has(tasks[-1].name)


def test_a_task_that_fails_although_its_result_is_there_is_done(engine: ClusterEngine, job: Job) -> None:
    engine.run("building", [Task("tried/twin/0", made_up.fill_disk, ("twin",))], job, silent)


def test_other_errors_come_through_for_those_who_mend_them(engine: ClusterEngine, job: Job) -> None:
    with pytest.raises(TypeError, match=r"add_up"):
        engine.run("building", [Task("wrong", made_up.add_up)], job, silent)


def test_calls_side_by_side_give_results_and_failures_in_order(engine: ClusterEngine) -> None:
    told: list[tuple[str, int, int, str]] = []
    arguments = [(number,) for number in range(6)]
    with engine.map_calls("baking", made_up.twice, arguments, lambda *args: told.append(args), "scene") as outcomes:
        found = list(outcomes)
    assert [each if isinstance(each, int) else str(each) for each in found] == [0, 2, 4, "no 3", 8, 10]
    assert isinstance(found[3], ScratchError)
    assert told[0] == ("baking", 0, 6, "scene") and [each[1] for each in told] == sorted(each[1] for each in told)


def test_a_result_that_is_lost_with_its_worker_is_waited_for(engine: ClusterEngine) -> None:
    with module.Pool(engine, "baking") as pool:
        pool.submit("twice", 0, functools.partial(made_up.twice, threads=1), 21)
        future = pool._futures["twice"]
        future.result(timeout=60)
        loop, lost = engine.client.loop, threading.Event()
        loop.add_callback(future._state.lose)  # as when the scheduler hears that the worker is gone
        loop.add_callback(lost.set)
        assert lost.wait(60) and future.status == "lost"
        loop.add_callback(loop.call_later, 0.5, future._state.finish)
        assert pool.next() == ("twice", 42, None)


def test_calls_that_nobody_waits_for_are_cancelled(engine: ClusterEngine) -> None:
    with engine.map_calls("baking", made_up.twice, [(0,)] * 100, silent, "scene") as outcomes:
        assert next(outcomes) == 0
    with engine.map_calls("baking", made_up.twice, [(21,)], silent, "scene") as outcomes:
        assert list(outcomes) == [42]


def test_workers_that_do_not_fit_are_refused(
    engine: ClusterEngine, job: Job, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    engine.check(None, [tmp_path, tmp_path / "missing.ply"])  # which is nowhere, as its task will say
    here_alone = Path(f"/proc/self/task/{os.getpid()}")
    if here_alone.exists():
        with pytest.raises(SparklodError, match=r"does not see /proc/self/task/.*: put inputs into a folder that all"):
            engine.check(None, [here_alone])
    with monkeypatch.context() as patch:
        patch.setattr(module, "__version__", "9.9")
        with pytest.raises(SparklodError, match=r"has sparklod .*, not 9\.9 as here: install sparklod"):
            engine.check(job.store)
    with pytest.raises(SparklodError, match=r"does not see what was written to .*--scratch-dir a folder that all"):
        engine.check(_Elsewhere(tmp_path / "here"))
    assert not list(tmp_path.rglob("*.npy"))


class _Elsewhere(Store):
    """A folder of this machine alone: a copy of the store in another process is another one."""

    def __reduce__(self) -> Any:
        return Store, (self.folder / "there",)


def test_a_worker_without_sparklod_is_told_what_to_do(engine: ClusterEngine, job: Job) -> None:
    client = engine.client
    client.wait_for_workers(2, timeout=60)  # one that another test killed may only now be replaced
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
    """Also on a worker that came since, where it is not hidden."""
    import sys

    if "hidden" in sys.modules:
        del sys.modules[module]
        if (found := sys.modules.pop("hidden")) is not None:
            sys.modules[module] = found


def test_a_block_that_does_not_fit_into_memory_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.bake.out_of_core.cluster.LOSSES", 0)
    monkeypatch.setattr("sparklod_cli.bake.out_of_core.cluster._memory_limit", lambda workers, memory: 400_000_000)
    job = Job(Store(tmp_path / "store"))
    with cluster(workers=1) as started:
        with pytest.raises(
            OutOfMemoryError, match=r"^stage/7 does not fit into the memory of a worker; give a smaller"
        ):
            started.run("building", [Task("stage/7", made_up.devour, ("stage/7",))], job, silent)
        with pytest.raises(SparklodError, match=r"^each worker that did stage/8 was lost, the last one tls://"):
            started.run("building", [Task("stage/8", made_up.die, ("stage/8",))], job, silent)


def test_the_job_is_small(job: Job) -> None:
    assert len(pickle.dumps(job)) < 1000
