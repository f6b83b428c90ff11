"""Runs the tasks of a bake one after the other, in this process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ...support import machine
from ...support.progress import Progress
from .contracts import Task


@dataclass(frozen=True)
class LocalEngine:
    """An engine without other processes.

    An interrupt leaves the results of all tasks that were done, and nothing of the one that was not.

    Attributes:
        threads: that each task works on.
    """

    threads: int = 1

    def run(self, stage: str, tasks: Sequence[Task], job: Any, progress: Progress) -> None:
        """As `Engine.run`; an error of a task is raised as it is."""
        total, done = sum(task.weight for task in tasks), 0
        for task in tasks:
            if not job.store.has(task.name):
                within = _Within(stage, done, task.weight, total, progress)
                task.run(job, *task.arguments, threads=self.threads, progress=within)
                machine.release_memory()  # for the next one, which may need most
            done += task.weight
            progress(stage, done, total, "splat")


class _Within:
    """The progress of one task, as a part of that of all; a task that has several stages of its own never goes back."""

    def __init__(self, stage: str, before: int, weight: int, total: int, progress: Progress) -> None:
        self._stage, self._before, self._weight, self._total, self._progress = stage, before, weight, total, progress
        self._done = 0

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None:
        share = self._weight * done // max(1, total)
        if share > self._done:
            self._done = min(share, self._weight)
            self._progress(self._stage, self._before + self._done, self._total, "splat")
