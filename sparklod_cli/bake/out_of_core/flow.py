"""From splats to a Level-of-Detail file in pieces, of which only a few are in memory at a time."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ...codecs.statistics import Statistics
from ...lod.builders import BUILDERS
from ...model.scene import Scene
from ...model.selection import Tally
from ...model.streams import NodeStream, SceneStream
from ...support.progress import Progress, silent
from ...support.threads import on_threads
from ..clock import Clock
from ..output import Output, WrittenTree
from ..settings import BakeSettings
from .blocks import cut_into_blocks
from .contracts import Engine, Store, Task
from .job import ORDER, Job, clean_of, stage_of
from .nodes import node_stream
from .order import Order, put_order
from .parts import parts_of
from .scatter import scatter
from .stages import build, clean
from .survey import Findings, check_findings, first_look

#: How many times larger than asked for a block may be before the scene is cut again, by what was found of all of it.
SLACK = 1.3

#: How often a scene is cut at most: by the first look, and by an even sample of what is kept.
ROUNDS = 2

#: Work of a join for each splat below it, as a share of that of a block: a few per cent of the nodes are left. Chosen.
JOIN_WORK = 0.1


@dataclass(frozen=True, eq=False)
class Staged:
    """A tree whose nodes are in a store.

    Attributes:
        nodes: of it.
        order: of its families.
        statistics: of its nodes.
        findings: of the splats of the input.
        blocks: that it was built of.
    """

    nodes: NodeStream
    order: Order
    statistics: Statistics
    findings: Findings
    blocks: int


def build_in_store(
    stream: SceneStream,
    settings: BakeSettings,
    *,
    store: Store,
    engine: Engine,
    block_splats: int,
    check: Callable[[Statistics], None],
    clock: Clock,
    progress: Progress,
) -> Staged:
    """Builds the tree of a scene that need not fit into memory.

    Args:
        stream: the scene; picklable, if the engine has other processes.
        settings: how.
        store: of the results of tasks, some of which may be there already.
        engine: runs the tasks.
        block_splats: of a block, about.
        check: called with the statistics of the splats that are kept; raises where a tree of them cannot be written.
        clock: is told when a stage ends.
        progress: told of the stages.

    Raises:
        FormatError, InvalidSplatsError: as `bake`.
        SparklodError: a task failed for good.
    """
    job, findings = _scattered(stream, settings, store, engine, block_splats, progress)
    clock.end("read")
    check(findings.statistics)
    setting = getattr(settings, BUILDERS[settings.method].setting)
    job = dataclasses.replace(job, plan=job.builder().plan(findings.survey(), setting))
    engine.run("building", list(_stages(job)), job, progress)
    clock.end("build")
    stages = [store.get(stage_of(stage.number)) for stage in job.blocks.stages]
    job = dataclasses.replace(job, families=tuple(int(stage["counts"][0]) for stage in stages))
    engine.run("ordering", [Task(ORDER, put_order, weight=sum(job.families))], job, progress)
    order = Order.from_arrays(store.get(ORDER))
    clock.end("order")
    return Staged(
        node_stream(job, order, findings.tally.kept, antialiased=stream.antialiased),
        order,
        Statistics.merged([Statistics.from_array(stage["statistics"]) for stage in stages]),
        findings,
        job.blocks.count,
    )


def _scattered(
    stream: SceneStream, settings: BakeSettings, store: Store, engine: Engine, block_splats: int, progress: Progress
) -> tuple[Job, Findings]:
    """The job after all parts of the input are in blocks, and what was found of them."""
    if not stream.count:
        settings.selection.check(Tally())
    center, share = first_look(stream, settings)
    blocks = cut_into_blocks(center, math.ceil(share * stream.count), block_splats)
    job = Job(store, stream, settings, parts_of(stream.count, block_splats), blocks)
    while True:
        tasks = [
            Task(job.part(number), scatter, (number,), weight=stop - start)
            for number, (start, stop) in enumerate(itertools.pairwise(job.parts))
        ]
        engine.run("reading", tasks, job, progress)
        found = [store.get(task.name) for task in tasks]
        parts = [Findings.from_arrays(each) for each in found]
        findings = Findings.merged(parts)
        check_findings(findings, settings)
        kept = tuple(itertools.accumulate((part.tally.kept for part in parts), initial=0))
        job = dataclasses.replace(job, kept=kept)
        largest = int(np.sum([np.diff(each["first"]) for each in found], axis=0).max())
        again = cut_into_blocks(findings.sample[:, :3], findings.tally.kept, block_splats)
        if largest <= SLACK * block_splats or job.round + 1 == ROUNDS or again == blocks:
            return job, findings
        for part, group in itertools.product(range(len(parts)), range(len(blocks.groups))):
            store.remove(job.splats(part, group))
        job = dataclasses.replace(job, blocks=again, round=job.round + 1)


def _stages(job: Job) -> Iterator[Task]:
    """The tasks of all stages, and those that remove what they no longer need, as soon as that can be."""
    blocks = job.blocks
    ends = {group.stop - 1: number for number, group in enumerate(blocks.groups)}
    share = job.kept[-1] // blocks.count
    begun = {stage.block: stage_of(stage.number) for stage in blocks.stages}
    for stage in blocks.stages:
        needs = tuple(stage_of(child) for child in stage.children)
        weight = share if stage.block is not None else math.ceil(JOIN_WORK * share * stage.blocks)
        yield Task(stage_of(stage.number), build, (stage.number,), needs, weight)
        if stage.block in ends:
            group = ends[stage.block]
            yield Task(clean_of(group), clean, (group,), tuple(begun[block] for block in blocks.groups[group]))


@dataclass(frozen=True)
class BakedOutOfCore:
    """What was baked out of core.

    Attributes:
        written: about the output.
        findings: of the splats of the input.
        nodes, levels: of the tree; levels is its depth and 1.
        blocks: that it was built of.
        seconds: by stage.
    """

    written: WrittenTree
    findings: Findings
    nodes: int
    levels: int
    blocks: int
    seconds: dict[str, float]


def bake_out_of_core(
    stream: SceneStream,
    output: Output,
    settings: BakeSettings,
    *,
    store: Store,
    engine: Engine,
    block_splats: int,
    threads: int = 1,
    progress: Progress = silent,
) -> BakedOutOfCore:
    """Builds a tree in a store and writes it.

    Args:
        stream, settings, store, engine, block_splats, progress: as for `build_in_store`.
        output: writes the tree.
        threads: of this process, to write with.

    Raises:
        FormatError, InvalidSplatsError, OutputError: as `bake`.
        SparklodError: a task failed for good.
    """
    clock = Clock()
    tree = build_in_store(
        stream,
        settings,
        store=store,
        engine=engine,
        block_splats=block_splats,
        check=output.check_statistics,
        clock=clock,
        progress=progress,
    )
    nodes, links = tree.nodes.read(0, tree.nodes.count)
    if output.in_chunks:
        with on_threads(threads):
            from ...lod.chunk_order import arrange

            nodes, links = arrange(nodes, links, progress=progress)
        clock.end("arrange")
    written = output.write(Scene(nodes, links, stream.antialiased), threads, progress)
    clock.end("write")
    return BakedOutOfCore(written, tree.findings, tree.nodes.count, tree.order.levels, tree.blocks, clock.seconds)
