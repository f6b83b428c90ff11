"""The plainest engine and stream: a loop, and a scene in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sparklod_cli.bake.out_of_core.job import Task
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.model.streams import SceneStream
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


def stream_of(scene: Scene, block: int = 1000) -> SceneStream:
    """A scene as a stream whose blocks are that long."""

    def read(start: int, stop: int) -> Iterator[Splats]:
        for at in range(start, stop, block):
            yield scene.splats.take(slice(at, min(at + block, stop)))

    return SceneStream(
        len(scene), scene.splats.sh_degree, read, scene.antialiased, scene.format, scene.notes, scene.header
    )
