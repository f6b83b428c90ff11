"""Jobs of small tasks, for tests of engines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sparklod_cli.bake.out_of_core.store import Store
from sparklod_cli.bake.out_of_core.tasks import Task
from sparklod_cli.support.progress import Progress

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
