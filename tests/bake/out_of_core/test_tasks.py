"""The engine of this process runs what is not done, in order, and tells how much is."""

from __future__ import annotations

from pathlib import Path

import pytest

from sparklod_cli.bake.out_of_core.store import Store
from sparklod_cli.bake.out_of_core.tasks import LocalEngine
from sparklod_cli.support.progress import silent
from tests.bake.out_of_core.jobs import COUNT, SumJob, tasks

SUM = sum(number**2 for number in range(COUNT))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "scratch")


def test_tasks_run_on_the_threads_that_are_given(store: Store) -> None:
    LocalEngine(threads=3).run("building", tasks(), SumJob(store), silent)
    assert store.get("sum")["value"].tolist() == [SUM]
    assert store.get("number/4")["value"].tolist() == [16, 3]


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_what_is_done_is_not_done_again(store: Store, error: type[BaseException]) -> None:
    with pytest.raises(error):
        LocalEngine(threads=1).run("building", tasks(), SumJob(store, 3, error), silent)
    assert store.names() == ["number/0", "number/1", "number/2"]
    LocalEngine(threads=2).run("building", tasks(), SumJob(store), silent)
    assert store.get("sum")["value"].tolist() == [SUM]
    assert [int(store.get(f"number/{number}")["value"][1]) for number in range(COUNT)] == [1, 1, 1, 2, 2, 2]


def test_progress_rises_to_its_total_and_counts_what_was_done_before(store: Store) -> None:
    told: list[tuple[str, int, int, str]] = []
    with pytest.raises(KeyboardInterrupt):
        LocalEngine().run("building", tasks(), SumJob(store, 3), silent)
    LocalEngine().run("building", tasks(), SumJob(store), lambda *what: told.append(what))
    done = [what[1] for what in told]
    assert done == sorted(done)
    assert done[:4] == [100, 200, 300, 325]
    assert told[-1] == ("building", 100 * COUNT + 30, 100 * COUNT + 30, "splat")
    assert {what[0] for what in told} == {"building"}
