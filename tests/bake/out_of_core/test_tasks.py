"""The engine of this process runs what is not done, in order, and tells how much is."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.bake.out_of_core.job import LocalEngine, Task
from sparklod_cli.bake.out_of_core.store import Store
from sparklod_cli.system.progress import Progress, silent

COUNT = 6


@dataclass(frozen=True)
class SumJob:
    """Sums numbers that tasks put.

    Attributes:
        store: of the results.
        fails: the task that fails; -1 for none.
        error: that it raises.
    """

    store: Store
    fails: int = -1
    error: type[BaseException] = KeyboardInterrupt


def put_number(job: SumJob, number: int, *, threads: int, progress: Progress) -> None:
    """Puts the square of a number."""
    for step in range(1, 5):
        progress("squaring", step, 4, "splat")
    progress("checking", 1, 4, "splat")
    if number == job.fails:
        raise job.error
    job.store.put(f"number/{number}", {"value": np.array([number**2, threads])})


def put_sum(job: SumJob, *, threads: int, progress: Progress) -> None:
    """Puts the sum of all squares."""
    numbers = [int(job.store.get(f"number/{number}")["value"][0]) for number in range(COUNT)]
    job.store.put("sum", {"value": np.array([sum(numbers)])})


def tasks() -> list[Task]:
    """The tasks of a job."""
    each = [Task(f"number/{number}", put_number, (number,), weight=100) for number in range(COUNT)]
    return [*each, Task("sum", put_sum, needs=tuple(task.name for task in each), weight=30)]


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


def test_tasks_that_memory_holds_together_share_the_threads(store: Store) -> None:
    numbers = [dataclasses.replace(task, together=2) for task in tasks()[:-1]]
    done: list[int] = []
    LocalEngine(threads=4).run("encoding", numbers, SumJob(store), lambda stage, now, total, unit: done.append(now))
    found = [store.get(task.name)["value"].tolist() for task in numbers]
    assert found == [[number**2, 2] for number in range(COUNT)]
    assert done == [100 * (number + 1) for number in range(COUNT)]


def test_an_error_of_one_of_them_is_raised(store: Store) -> None:
    numbers = [dataclasses.replace(task, together=2) for task in tasks()[:-1]]
    with pytest.raises(MemoryError):
        LocalEngine(threads=2).run("encoding", numbers, SumJob(store, 3, MemoryError), silent)
    assert "number/3" not in store.names()


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
