"""Tasks of a bake out of core, whose results are files in a store, and the engine that runs them in this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from ...system import machine
from ...system.progress import Progress, silent
from ...system.threads import ordered_map


@dataclass(frozen=True)
class Task:
    """A piece of work, which may be done again: it gives the same result.

    Attributes:
        name: its own, and that of its result in the store; a task whose result is there is done.
        run: a function of a module, called as `run(job, *arguments, threads=, progress=)`; it puts the result.
        arguments: small, and can be pickled.
        needs: names of the tasks that must be done before.
        weight: how much work it is, splats.
        together: how many tasks like it one process has memory for, if they need none of each other.
    """

    name: str
    run: Callable[..., None]
    arguments: tuple[Any, ...] = ()
    needs: tuple[str, ...] = ()
    weight: int = 1
    together: int = 1


class Engine(Protocol):
    """Runs tasks."""

    def run(self, stage: str, tasks: Sequence[Task], job: Any, progress: Progress) -> None:
        """Run those tasks whose results are not there, each after what it needs.

        Args:
            stage: word for the progress ("building").
            tasks: in an order in which they could run one after the other.
            job: the first argument of all of them; can be pickled, and has a `store`.

        Raises:
            SparklodError: a task failed, after it was tried again where that could help; the text says what to do.
        """


@dataclass(frozen=True)
class LocalEngine:
    """Engine without other processes, on some threads; an interrupt leaves the results of all tasks that were done."""

    threads: int = 1

    def run(self, stage: str, tasks: Sequence[Task], job: Any, progress: Progress) -> None:
        """Run tasks as `Engine.run`; an error of a task is raised as it is."""
        total, done = sum(task.weight for task in tasks), 0
        together = min([self.threads, *(task.together for task in tasks)])

        def run(task: Task) -> int:
            if not job.store.has(task.name):
                within = _share_of(progress, stage, done, task.weight, total) if together == 1 else silent
                task.run(job, *task.arguments, threads=self.threads // together, progress=within)
                machine.release_memory()  # for the next one, which may need most
            return task.weight

        for weight in ordered_map(run, tasks, together):
            done += weight
            progress(stage, done, total, "splat")


def _share_of(progress: Progress, name: str, before: int, weight: int, all_weights: int) -> Progress:
    """Return the progress of one task as a part of that of all; one with several stages of its own never goes back."""
    reached = 0

    def within(stage: str, done: int, total: int, unit: str) -> None:
        nonlocal reached
        share = min(weight * done // max(1, total), weight)
        if share > reached:
            reached = share
            progress(name, before + share, all_weights, "splat")

    return within
