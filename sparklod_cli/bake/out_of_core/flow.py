"""From splats to a Level-of-Detail file in pieces, of which only a few are in memory at a time."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...codecs.statistics import Statistics
from ...lod.builders import BUILDERS
from ...model.selection import Tally
from ...model.streams import NodeStream, SceneStream
from ...support.parallel import blocks_of
from ...support.progress import Progress, silent
from ..clock import Clock
from ..output import Output
from ..settings import BakeSettings
from ..written import WrittenTree
from .blocks import cut_into_blocks
from .contracts import Engine, Store, Task
from .job import ORDER, PUBLISHED, Job, clean_of, encoded_of, stage_of
from .nodes import encode, encoded_chunk, node_stream
from .order import WINDOW_NODES, put_order
from .parts import parts_of
from .scatter import scatter
from .stages import build_stage, clean
from .survey import Findings, check_findings, first_look

#: How many times larger than asked for a block may be before the scene is cut again, by what was found of all of it.
SLACK = 1.3

#: How often a scene is cut at most: by the first look, and by an even sample of what is kept.
ROUNDS = 2

#: Work of a join for each splat below it, as a share of that of a block: a few per cent of the nodes are left. Chosen.
JOIN_WORK = 0.1


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
    """Builds the tree of a scene that need not fit into memory, and writes it.

    Args:
        stream: the scene; picklable, if the engine has other processes.
        output: writes the tree.
        settings: how.
        store: of the results of tasks, some of which may be there already.
        engine: runs the tasks.
        block_splats: of a block, about.
        threads: of this process, to write with.
        progress: told of the stages.

    Raises:
        FormatError, InvalidSplatsError, OutputError: as `bake`.
        SparklodError: a task failed for good.
    """
    clock = Clock()
    if not stream.count:
        settings.selection.check(Tally())
    job = Job(store, stream, settings, output.needed, output.in_chunks, parts_of(stream.count, block_splats))
    job, findings = scattered(job, engine, block_splats, progress)
    clock.end("read")
    output.check_statistics(findings.statistics)
    tree = build(job, findings, engine, clock, progress)
    encoder = output.encoder(tree.nodes, tree.statistics, threads, progress)
    job = dataclasses.replace(job, encoder=encoder)
    tasks = [
        Task(encoded_of(window), encode, (window,), weight=part.stop - part.start)
        for window, part in enumerate(blocks_of(encoder.count, WINDOW_NODES))
    ]
    engine.run("encoding", tasks, job, progress)
    clock.end("encode")
    store.put(PUBLISHED, {})
    written = output.write_windows(encoder, functools.partial(encoded_chunk, store), threads, progress)
    clock.end("write")
    return BakedOutOfCore(written, findings, tree.nodes.count, tree.levels, job.blocks.count, clock.seconds)


@dataclass(frozen=True, eq=False)
class Built:
    """A tree whose nodes are in a store, in order.

    Attributes:
        nodes: of it.
        levels: of it.
        statistics: of its nodes.
    """

    nodes: NodeStream
    levels: int
    statistics: Statistics


def build(job: Job, findings: Findings, engine: Engine, clock: Clock, progress: Progress) -> Built:
    """Builds the tree of splats that are in blocks, and puts its nodes in order."""
    settings, store = job.settings, job.store
    setting = getattr(settings, BUILDERS[settings.method].setting)
    job = dataclasses.replace(job, plan=job.builder().plan(findings.survey(), setting))
    engine.run("building", list(_stages(job)), job, progress)
    clock.end("build")
    stages = [store.get(stage_of(stage.number)) for stage in job.blocks.stages]
    job = dataclasses.replace(job, families=tuple(int(stage["counts"][0]) for stage in stages))
    engine.run("ordering", [Task(ORDER, put_order, weight=sum(job.families))], job, progress)
    clock.end("order")
    nodes, levels = store.get(ORDER, ["counts"])["counts"].tolist()
    statistics = Statistics.merged([Statistics.from_array(stage["statistics"]) for stage in stages])
    return Built(node_stream(job, nodes, findings.tally.kept), levels, statistics)


def scattered(job: Job, engine: Engine, block_splats: int, progress: Progress) -> tuple[Job, Findings]:
    """Reads the input and puts its splats in blocks; returns the job that knows them, and what was found.

    Raises:
        InvalidSplatsError: no tree can be made of them.
    """
    store, settings = job.store, job.settings
    center, share = first_look(job.stream, settings, -(-job.stream.count // block_splats))
    blocks = cut_into_blocks(center, math.ceil(share * job.stream.count), block_splats)
    job = dataclasses.replace(job, blocks=blocks)
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
        if largest <= SLACK * block_splats or job.round + 1 == ROUNDS or again == job.blocks:
            return job, findings
        for part, group in itertools.product(range(len(parts)), range(len(job.blocks.groups))):
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
        yield Task(stage_of(stage.number), build_stage, (stage.number,), needs, weight)
        if stage.block in ends:
            group = ends[stage.block]
            yield Task(clean_of(group), clean, (group,), tuple(begun[block] for block in blocks.groups[group]))
