"""Tasks of a bake out of core, whose results are files in a store, and the engine that runs them in this process."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from ...codecs.encoder import Encoder
from ...codecs.reader import Reader
from ...lod.builders import BUILDERS
from ...lod.stage_records import StagedBuilder
from ...system import machine
from ...system.progress import Progress, silent
from ...system.threads import ordered_map
from ..settings import BakeSettings
from .blocks import BlockDivision
from .store import Store

#: Division of a scene before it is divided.
NO_BLOCKS = BlockDivision((), ())


@dataclass(frozen=True)
class Job:
    """Data shared by all tasks of a bake; small, so that it can be pickled.

    Attributes:
        stream: the input; can be pickled, too.
        needed: statistics that determine how the output is written, see `codecs.statistics`.
        in_chunks: the output has the order for streaming.
        parts: first splat of each part of the input, and the count; empty until the input is divided.
        blocks: division of the scene; `NO_BLOCKS` until it is divided.
        round: how often the scene was divided before.
        selected: number of selected splats before each part; empty until the input is read.
        plan: of the builder; None until the input is read.
        families: number of families by stage; empty until the tree is built.
        encoder: of the output; None until the tree is in order.
    """

    store: Store
    stream: Reader
    settings: BakeSettings
    needed: frozenset[str]
    in_chunks: bool
    parts: tuple[int, ...] = ()
    blocks: BlockDivision = NO_BLOCKS
    round: int = 0
    selected: tuple[int, ...] = ()
    plan: Any = None
    families: tuple[int, ...] = ()
    encoder: Encoder | None = None

    @property
    def sh_degree(self) -> int:
        """SH degree of the tree."""
        return min(self.stream.sh_degree, self.settings.max_sh)

    def builder(self) -> StagedBuilder:
        """Return the builder of the tree."""
        return BUILDERS[self.settings.method].load()

    def part(self, number: int) -> str:
        """Return the name of the result that marks an input part as scattered to blocks, with its statistics."""
        return f"scatter-{self.round}/{number}"

    def splats(self, part: int, group: int) -> str:
        """Return the name of the result with the splats of an input part in a group of blocks."""
        return f"{self.part(part)}/{group}"


#: Names of results by number: the counts of a stage, which mark the stage as done; its families; the nodes that it
#: hands on; the plan of a window of nodes; the encoded window; and the mark that the splats of a group of blocks were
#: removed.
stage_of, families_of, pending_of = "stage/{}".format, "families/{}".format, "pending/{}".format
window_of, encoded_of, clean_of = "order/{}".format, "encoded/{}".format, "clean/{}".format

#: Names of results: the root; the counts of the ordered tree; and the mark that the output may be in place.
ROOT, ORDER, PUBLISHED = "root", "order", "published"


def forget(store: Store, damaged: Collection[str]) -> None:
    """Remove damaged results and those made from them; complete stages are kept."""
    names = set(damaged)
    if any(name.startswith("order") for name in damaged):
        names |= {ORDER}
    stages = {name.partition("/")[2] for name in damaged if name.startswith(("stage/", "families/", "pending/"))}
    if ROOT in damaged:  # a result of the last stage
        numbers = [int(name.removeprefix("stage/")) for name in store.names() if name.startswith("stage/")]
        stages |= {str(max(numbers, default=0))}
    if stages or any(name.startswith("scatter-") for name in damaged):
        names |= {stage_of(number) for number in stages}
        names |= {name for name in store.names() if name.startswith(("scatter-", "clean/"))}
    for name in sorted(names):
        store.remove(name)


@dataclass(frozen=True)
class Task:
    """Piece of work that may be repeated, with the same result.

    Attributes:
        name: of the task and of its result in the store, which marks the task as done.
        run: function of a module, called as `run(job, *arguments, threads=, progress=)`; it puts the result.
        arguments: small, and can be pickled.
        needs: names of tasks that must be done before.
        weight: amount of work, splats.
        together: number of such tasks that one process has memory for at once, if they do not need each other.
    """

    name: str
    run: Callable[..., None]
    arguments: tuple[Any, ...] = ()
    needs: tuple[str, ...] = ()
    weight: int = 1
    together: int = 1


class Engine(Protocol):
    """Runner of tasks."""

    def run(self, stage: str, tasks: Sequence[Task], job: Any, progress: Progress) -> None:
        """Run the tasks whose results are missing, each after those that it needs.

        Args:
            stage: word for the progress ("building").
            tasks: in an order in which they could run one after the other.
            job: first argument of all of them; can be pickled, and has a `store`.

        Raises:
            SparklodError: a task failed, repeatedly if repeating could help; the message says what to do.
        """


@dataclass(frozen=True)
class LocalEngine:
    """Engine on threads of this process; after an interrupt, the results of finished tasks are in the store."""

    threads: int = 1

    def run(self, stage: str, tasks: Sequence[Task], job: Any, progress: Progress) -> None:
        """Run tasks as `Engine.run`; an error of a task is raised unchanged."""
        total, done = sum(task.weight for task in tasks), 0
        together = min([self.threads, *(task.together for task in tasks)])

        def run(task: Task) -> int:
            if not job.store.has(task.name):
                within = _share_of(progress, stage, done, task.weight, total) if together == 1 else silent
                task.run(job, *task.arguments, threads=self.threads // together, progress=within)
                machine.release_memory()  # for the next task, which may need most of it
            return task.weight

        for weight in ordered_map(run, tasks, together):
            done += weight
            progress(stage, done, total, "splat")


def _share_of(progress: Progress, name: str, before: int, weight: int, total_weight: int) -> Progress:
    """Return a progress for one task that reports it as part of all tasks and never goes back."""
    reached = 0

    def within(stage: str, done: int, total: int, unit: str) -> None:
        nonlocal reached
        share = min(weight * done // max(1, total), weight)
        if share > reached:
            reached = share
            progress(name, before + share, total_weight, "splat")

    return within
