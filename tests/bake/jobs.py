"""Jobs of small tasks, the plainest engine and a reader of a scene in memory, for tests of bakes out of core."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sparklod_cli.bake.job import Task
from sparklod_cli.bake.store import Store
from sparklod_cli.codecs.merging import copy_rows
from sparklod_cli.codecs.reader import Reader, RowBuffer
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import ScratchError
from sparklod_cli.system.progress import Progress, silent


@dataclass
class Loop:
    """Engine that runs tasks one after the other, with random numbers in any order that their needs allow."""

    rng: np.random.Generator | None = None
    threads: int = 1

    def run(self, stage: str, tasks: Sequence[Task], job: Any, progress: Progress = silent) -> None:
        left = {task.name: task for task in tasks if not job.store.has(task.name)}
        assert len({task.name for task in tasks}) == len(tasks)
        while left:
            ready = [task for task in left.values() if not any(need in left for need in task.needs)]
            task = ready[0] if self.rng is None else ready[self.rng.integers(len(ready))]
            task.run(job, *task.arguments, threads=self.threads, progress=silent)
            assert job.store.has(task.name)
            del left[task.name]


def reader_of(scene: Scene) -> Reader:
    """A reader of a scene in memory."""

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        copy_rows(scene.splats.take(slice(target.start, target.stop)), target.splats)

    return Reader(len(scene), scene.splats.sh_degree, scene.format, fill, scene.antialiased, scene.notes, scene.header)


@dataclass(frozen=True)
class Job:
    """A job that has nothing but a store."""

    store: Store


def add_up(job: Job, name: str, needs: tuple[str, ...], seconds: float, **_: Any) -> None:
    """Puts 1 and the sum of what it needs, and which process it was."""
    time.sleep(seconds)
    total = 1 + sum(int(job.store.get(need)["total"][0]) for need in needs)
    job.store.put(name, {"total": np.array([total]), "process": np.array([os.getpid()])})


def _once(job: Job, name: str) -> bool:
    """Whether this is the first call for a task."""
    first = not job.store.has(f"tried/{name}")
    job.store.put(f"tried/{name}", {"at": np.zeros(1)})
    return first


def die_once(job: Job, name: str, **more: Any) -> None:
    """Kills its process at the first try."""
    if _once(job, name):
        os.kill(os.getpid(), signal.SIGKILL)
    add_up(job, name, (), 0, **more)


def die(job: Job, name: str, **_: Any) -> None:
    """Kills its process."""
    os.kill(os.getpid(), signal.SIGKILL)


def stumble_once(job: Job, name: str, **more: Any) -> None:
    """Loses its connection at the first try."""
    if _once(job, name):
        raise ConnectionResetError("reset by peer")
    add_up(job, name, (), 0, **more)


def fill_disk(job: Job, name: str, **_: Any) -> None:
    """Finds no room; notes each try."""
    tries = sum(job.store.has(f"tried/{name}/{number}") for number in range(9))
    job.store.put(f"tried/{name}/{tries}", {"at": np.zeros(1)})
    raise ScratchError("there is no room left in the scratch folder /scratch")


def devour(job: Job, name: str, **_: Any) -> None:
    """Takes memory until somebody ends it, so slowly that a busy machine has enough until then."""
    held = []
    while True:
        held.append(np.ones(1_000_000))
        time.sleep(0.01)


def tree_of(count: int, *, seconds: float = 0.0) -> list[Task]:
    """Leaves, and joins of four each, until one is left; the last task's total is the number of tasks."""
    tasks, names = [], [f"leaf/{number}" for number in range(count)]
    tasks = [Task(name, add_up, (name, (), seconds), weight=10) for name in names]
    while len(names) > 1:
        groups = [tuple(names[at : at + 4]) for at in range(0, len(names), 4)]
        names = [f"join/{len(tasks) + number}" for number in range(len(groups))]
        tasks += [Task(name, add_up, (name, needs, seconds), needs) for name, needs in zip(names, groups, strict=True)]
    return tasks


def twice(number: int, *, threads: int) -> int:
    """Twice a number; small numbers take longer, and 3 is refused."""
    time.sleep(0.1 / (1 + number))
    if number == 3:
        raise ScratchError("no 3")
    return number * 2
