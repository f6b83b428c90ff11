"""Bakes out of core as jobs: division into blocks, tasks with results in a store, and an engine that runs them."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..codecs.reader import Reader
from ..lod.stages import Region, StagedBuilder
from ..model.splats import FloatArray
from ..system import machine
from ..system.progress import Progress, silent
from ..system.threads import ordered_map
from .settings import BakeSettings
from .store import Store

if TYPE_CHECKING:
    from ..codecs.encoder import Encoder

#: Levels of splits whose regions are joined at once.
JOINED_SPLITS = 3

#: Share of the centres at either end of an axis that its extent leaves out, as a few splats of a scan lie far away.
OUTLIERS = 0.02


@dataclass(frozen=True)
class BuildStage:
    """Stage of the build.

    Attributes:
        number: greater than those of its children.
        region: of the scene; None for the whole scene, the last stage.
        block: number of the block of which the stage builds trees; None for a join of other stages.
        children: numbers of the joined stages, in ascending order of their blocks.
        blocks: number of blocks below the stage.
    """

    number: int
    region: Region | None
    block: int | None
    children: tuple[int, ...]
    blocks: int


@dataclass(frozen=True)
class BlockDivision:
    """Division of a scene into blocks.

    Attributes:
        splits: (axis, value, low, high): centres below the value are on the low side. A side is the number of another
            split, or ~number of a block.
        stages: by number, children first.
    """

    splits: tuple[Split, ...]
    stages: tuple[BuildStage, ...]

    @property
    def count(self) -> int:
        """Number of blocks."""
        return self.stages[-1].blocks

    @property
    def groups(self) -> tuple[range, ...]:
        """Ranges of blocks whose stages have the same parent."""
        parents = {child: stage.number for stage in self.stages for child in stage.children}
        joined = [parents.get(stage.number) for stage in self.stages if stage.block is not None]
        ends = [*(k for k in range(1, self.count) if joined[k] != joined[k - 1]), self.count]
        return tuple(range(start, stop) for start, stop in zip([0, *ends], ends, strict=False))

    def sort(self, center: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Sort splats stably by block; return (N,) their order, and (blocks + 1,) the first of each block, and N."""
        parts: list[NDArray[np.int64]] = [np.empty(0, np.int64)] * self.count
        pending = [(0 if self.splits else ~0, np.arange(len(center)))]
        while pending:
            number, index = pending.pop()
            if number < 0:
                parts[~number] = index
                continue
            axis, value, low, high = self.splits[number]
            below = center[index, axis] < np.float32(value)
            pending += [(low, index[below]), (high, index[~below])]
        return np.concatenate(parts), np.cumsum([0, *map(len, parts)])


#: A split, see `BlockDivision`; and a part of a scene: a side of a split, and its region.
Split = tuple[int, float, int, int]
Part = tuple[int, Region]


def cut_into_blocks(sample: FloatArray, count: int, block_splats: int) -> BlockDivision:
    """Divide a scene of `count` splats into blocks of about `block_splats` at most.

    Args:
        sample: (n, 3) evenly drawn centres; without any, the scene is one block.
    """
    splits, stages = list[Split](), list[BuildStage]()
    whole = _divide(sample, -(-count // block_splats), splits, itertools.count())
    _add_stage((whole, Region((-math.inf,) * 3, (math.inf,) * 3)), splits, stages)
    stages[-1] = dataclasses.replace(stages[-1], region=None)
    return BlockDivision(tuple(splits), tuple(stages))


def _divide(center: FloatArray, count: int, splits: list[Split], blocks: Iterator[int]) -> int:
    """Divide centres into at most `count` blocks; return their side, see `BlockDivision.splits`."""
    split = _split(center, count) if count > 1 else None
    if split is None:
        return ~next(blocks)
    axis, value = split
    number = len(splits)
    splits.append((axis, value, 0, 0))
    below = center[:, axis] < value
    low = _divide(center[below], count // 2, splits, blocks)
    high = _divide(center[~below], count - count // 2, splits, blocks)
    splits[number] = axis, value, low, high
    return number


def _split(center: FloatArray, count: int) -> tuple[int, float] | None:
    """Return the axis and the value of a split of centres for `count` blocks; None if all centres are equal."""
    if not len(center):
        return None
    low, high = np.quantile(center, [OUTLIERS, 1 - OUTLIERS], axis=0)
    whole = np.ptp(center, axis=0)
    for axis in sorted(range(3), key=lambda axis: (low[axis] - high[axis], -whole[axis])):
        values = np.sort(center[:, axis])
        if values[0] < values[-1]:
            value = values[len(values) * (count // 2) // count]
            return axis, float(max(value, values[np.searchsorted(values, values[0], "right")]))
    return None


def _add_stage(part: Part, splits: Sequence[Split], stages: list[BuildStage]) -> BuildStage:
    """Append the stage of a part of a scene after the stages that it joins, and return it."""
    side, region = part
    below = []
    if side >= 0:
        parts = [part]
        for _ in range(JOINED_SPLITS):
            parts = [half for each in parts for half in _halves(each, splits)]
        below = [_add_stage(each, splits, stages) for each in parts]
    stage = BuildStage(
        number=len(stages),
        region=region,
        block=None if side >= 0 else ~side,
        children=tuple(each.number for each in below),
        blocks=sum(each.blocks for each in below) or 1,
    )
    stages.append(stage)
    return stage


def _halves(part: Part, splits: Sequence[Split]) -> list[Part]:
    """Return the two halves of a part, or a part that is a block."""
    side, region = part
    if side < 0:
        return [part]
    axis, value, low, high = splits[side]

    def moved(corner: tuple[float, ...]) -> Any:
        return (*corner[:axis], value, *corner[axis + 1 :])

    return [(low, Region(region.low, moved(region.high))), (high, Region(moved(region.low), region.high))]


@dataclass(frozen=True)
class Job:
    """Data shared by all tasks of a bake, small enough to be pickled for each.

    Attributes:
        stream: the input.
        needed: statistics that determine how the output is written, see `codecs.statistics`.
        in_chunks: the output has the order for streaming.
        parts: first splat of each part of the input, and the count; empty until the input is divided.
        blocks: division of the scene.
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
    blocks: BlockDivision = BlockDivision((), ())
    round: int = 0
    selected: tuple[int, ...] = ()
    plan: Any = None
    families: tuple[int, ...] = ()
    encoder: Encoder | None = None

    @property
    def sh_degree(self) -> int:
        """SH degree of the tree: that of the input, limited by the settings."""
        return min(self.stream.sh_degree, self.settings.max_sh)

    def builder(self) -> StagedBuilder:
        """Return the builder of the tree in stages."""
        builder: StagedBuilder = import_module(f"..lod.{self.settings.method}_stages", __package__)
        return builder

    def part(self, number: int) -> str:
        """Return the name of the result that summarizes an input part and marks it as scattered to blocks."""
        return f"scatter-{self.round}/{number}"

    def splats(self, part: int, group: int) -> str:
        """Return the name of the result with the splats of an input part in a group of blocks."""
        return f"{self.part(part)}/{group}"


#: Names of results by number: counts of a stage, which mark it as done; its families; its nodes without a parent; plan
#: of a window of nodes; encoded window; and the mark that the splats of a group of blocks were removed.
stage_of, families_of, pending_of = "stage/{}".format, "families/{}".format, "pending/{}".format
window_of, encoded_of, clean_of = "order/{}".format, "encoded/{}".format, "clean/{}".format

#: Names of results: root; counts of the ordered tree; and the mark that the output may be in place.
ROOT, ORDER, PUBLISHED = "root", "order", "published"


def forget(store: Store, damaged: Collection[str]) -> None:
    """Remove damaged results and the results made from them, except those of complete stages."""
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
    """Piece of work that always gives the same result, so that it may be repeated.

    Attributes:
        name: of the task and of its result in the store, which marks the task as done.
        run: function of a module, called as `run(job, *arguments, threads=, progress=)`; it puts the result.
        needs: names of tasks that must be done before.
        weight: amount of work, splats.
        together: number of such tasks, independent of each other, that one process has memory for at once.
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
            job: first argument of each task; it can be pickled, and has a `store`.

        Raises:
            SparklodError: a task failed, repeatedly if repeating could help; the message says what to do.
        """


@dataclass(frozen=True)
class LocalEngine:
    """Engine on threads of this process; an interrupt leaves the results of finished tasks in the store."""

    threads: int = 1

    def run(self, stage: str, tasks: Sequence[Task], job: Any, progress: Progress) -> None:
        """Run tasks as `Engine.run`, but raise errors of tasks unchanged."""
        total, done = sum(task.weight for task in tasks), 0
        together = min([self.threads, *(task.together for task in tasks)])

        def run(task: Task) -> int:
            if not job.store.has(task.name):
                within = _share_of(progress, stage, done, task.weight, total) if together == 1 else silent
                task.run(job, *task.arguments, threads=self.threads // together, progress=within)
                machine.release_memory()  # the next task may need most of it
            return task.weight

        for weight in ordered_map(run, tasks, together):
            done += weight
            progress(stage, done, total, "splat")


def _share_of(progress: Progress, name: str, before: int, weight: int, total_weight: int) -> Progress:
    """Return a progress for one task that reports it as part of all tasks, and never goes back."""
    reached = 0

    def within(stage: str, done: int, total: int, unit: str) -> None:
        nonlocal reached
        share = min(weight * done // max(1, total), weight)
        if share > reached:
            reached = share
            progress(name, before + share, total_weight, "splat")

    return within
