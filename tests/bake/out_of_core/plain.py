"""The plainest engine and reader: a loop, and a scene in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sparklod_cli.bake.out_of_core.job import Task
from sparklod_cli.codecs.merging import copy_rows
from sparklod_cli.codecs.reader import Reader, Target
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.progress import Progress, silent


@dataclass
class Loop:
    """Runs tasks one after the other; in any order that their needs allow, if it has random numbers."""

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

    def fill(target: Target, threads: int, progress: Progress) -> None:
        copy_rows(scene.splats.take(slice(target.start, target.stop)), target.splats)

    return Reader(len(scene), scene.splats.sh_degree, scene.format, fill, scene.antialiased, scene.notes, scene.header)
