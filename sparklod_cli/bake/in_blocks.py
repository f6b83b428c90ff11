"""Bakes out of core: tasks sort splats into blocks in a store, build the tree in stages, order and encode it."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..codecs.reader import Reader
from ..codecs.statistics import Statistics
from ..lod.bounds import INVISIBLE, Bounds
from ..lod.stages import NO_FAMILY, drawn_splats, joined
from ..lod.tree_settings import BUILDERS
from ..model.selection import REASONS, SelectionTally
from ..model.sh import width_of
from ..model.splats import FloatArray, Splats
from ..system.errors import InvalidSplatsError
from ..system.progress import Progress
from ..system.threads import blocks_of, on_threads
from .built_tree import BuiltTree, check_transformed, select, transform
from .job import (
    ORDER,
    PUBLISHED,
    ROOT,
    Engine,
    Job,
    Task,
    clean_of,
    cut_into_blocks,
    encoded_of,
    families_of,
    pending_of,
    stage_of,
)
from .order import WINDOW_NODES, Rows, encode, encoded_array, node_stream, put_order, rows_of, splats_of
from .settings import BakeSettings
from .store import Arrays

if TYPE_CHECKING:
    from ..codecs.encoder import Encoder, Windows

#: Largest size of a block, as a multiple of the requested size; a scene with a larger one is divided again. Chosen.
SLACK = 1.3

#: How often a scene is divided at most: by samples of the input, then by an even sample of the selected splats.
ROUNDS = 2

#: Work of a join for each splat below it, as a share of that of a block: a few per cent of the nodes are left. Chosen.
JOIN_WORK = 0.1

#: Splats of an input part, unless blocks are smaller, and most parts, as each makes a file for each group of blocks.
#: Chosen.
PART_SPLATS, MAX_PARTS = 1 << 19, 256

#: Sampled ranges of the input: for each block, least and most in all, and splats of each. Sizes of blocks then differ
#: by a few per cent, even if neighbours in the file are neighbours in space. Chosen.
RANGES_OF_BLOCK, MIN_RANGES, MAX_RANGES, RANGE_SPLATS = 32, 64, 512, 256

#: Approximate size of the sample from which a builder plans, splats. Chosen.
SAMPLE_SPLATS = 1 << 18


@dataclass
class InBlocks:
    """Bake in a scratch folder, whose steps run in the order build, order, encode.

    Attributes:
        job: data of the tasks so far.
        block_splats: approximate size of a block.
        windows: number of windows of nodes to encode at once.
    """

    job: Job
    engine: Engine
    block_splats: int
    windows: int
    progress: Progress

    def build(self, tree: BuiltTree) -> None:
        """Scatter the splats of the input to blocks, and build the tree in stages."""
        settings = self.job.settings
        if not self.job.stream.count:
            settings.selection.check(SelectionTally())
        tally, bounds, sample, statistics = self._scatter()
        tree.end("read")
        assert tree.form is not None
        tree.form.codec().settled(statistics, tree.options)  # reports a tree that the output cannot hold
        setting = getattr(settings, BUILDERS[settings.method].setting)
        plan = self.job.builder().plan(bounds, splats_of(sample), setting)
        self.job = job = dataclasses.replace(self.job, plan=plan)
        self.engine.run("building", list(_stages(job)), job, self.progress)
        tree.end("build")
        baked = tree.baked
        baked.splats, baked.dropped, baked.method = tally.selected, tally.dropped, settings.method
        baked.blocks = job.blocks.count

    def order(self, tree: BuiltTree) -> None:
        """Order the nodes, and put the plan of each window into the store."""
        job = self.job
        stages = [job.store.get(stage_of(stage.number)) for stage in job.blocks.stages]
        self.job = job = dataclasses.replace(job, families=tuple(int(stage["counts"][0]) for stage in stages))
        task = Task(ORDER, put_order, weight=sum(job.families))
        self.engine.run("arranging" if job.in_chunks else "ordering", [task], job, self.progress)
        tree.end("order")
        tree.baked.nodes, tree.baked.levels = job.store.get(ORDER, ["counts"])["counts"].tolist()
        tree.baked.sh_degree = job.sh_degree
        tree.statistics = Statistics.merged([Statistics.from_array(stage["statistics"]) for stage in stages])
        tree.nodes = node_stream(job, tree.baked.nodes)

    def encode(self, tree: BuiltTree, encoder: Encoder) -> Windows:
        """Encode the windows of the tree, and mark in the store that from now on the output may be in place."""
        job = dataclasses.replace(self.job, encoder=encoder)
        tasks = [
            Task(encoded_of(window), encode, (part.start, part.stop), (), part.stop - part.start, self.windows)
            for window, part in enumerate(blocks_of(tree.baked.nodes, WINDOW_NODES))
        ]
        self.engine.run("encoding", tasks, job, self.progress)
        tree.end("encode")
        job.store.put(PUBLISHED, {})
        return functools.partial(encoded_array, job.store)

    def _scatter(self) -> tuple[SelectionTally, Bounds, Rows, Statistics]:
        """Divide the scene into blocks and sort the splats of the input into them.

        Returns:
            the tally of all splats; and of the selected ones their bounds, rows at an even stride, and statistics.
        """
        job, block_splats, count = self.job, self.block_splats, self.job.stream.count
        part_splats = max(min(block_splats, PART_SPLATS), -(-count // MAX_PARTS))
        center, share = _sample_centers(job.stream, job.settings, -(-count // block_splats))
        job = dataclasses.replace(
            job,
            parts=(0, *(part.stop for part in blocks_of(count, part_splats))),
            blocks=cut_into_blocks(center, math.ceil(share * count), block_splats),
        )
        while True:
            tasks = [
                Task(job.part(number), scatter, (number,), weight=stop - start)
                for number, (start, stop) in enumerate(itertools.pairwise(job.parts))
            ]
            self.engine.run("reading", tasks, job, self.progress)
            arrays = [job.store.get(task.name) for task in tasks]
            tallies = [_tally_of(part) for part in arrays]
            tally = functools.reduce(SelectionTally.then, tallies)
            job.settings.selection.check(tally)
            check_transformed(sum(int(part["counts"][0]) for part in arrays))
            limits = np.stack([part["limits"] for part in arrays])
            (*low, smallest), (*high, most) = limits[:, 0].min(axis=0).tolist(), limits[:, 1].max(axis=0).tolist()
            if not smallest > 0:
                raise InvalidSplatsError(INVISIBLE)
            selected = tuple(itertools.accumulate((each.selected for each in tallies), initial=0))
            self.job = job = dataclasses.replace(job, selected=selected)
            largest = int(np.sum([np.diff(each["first"]) for each in arrays], axis=0).max())
            sample = np.concatenate([part["sample"] for part in arrays])
            again = cut_into_blocks(sample[:, :3], tally.selected, block_splats)
            if largest <= SLACK * block_splats or job.round + 1 == ROUNDS or again == job.blocks:
                statistics = [Statistics.from_array(part["statistics"]) for part in arrays]
                bounds = Bounds(np.array(low), np.array(high), smallest, most)
                return tally, bounds, sample, Statistics.merged(statistics)
            for part, group in itertools.product(range(len(arrays)), range(len(job.blocks.groups))):
                job.store.remove(job.splats(part, group))
            job = dataclasses.replace(job, blocks=again, round=job.round + 1)


def _read_leaves(
    stream: Reader, start: int, stop: int, settings: BakeSettings
) -> Iterator[tuple[Splats, SelectionTally, int]]:
    """Read, select and transform a range of the input in pieces.

    Yields:
        the selected splats; the tally of all; and how many of the selected left the range of float32.
    """
    for splats in stream.blocks(start, stop):
        selected, tally = select(splats, settings, start=start, total=stream.count)
        start += len(splats)
        leaves, beyond = transform(selected, settings.transform)
        yield leaves, tally, beyond


def _sample_centers(stream: Reader, settings: BakeSettings, blocks: int) -> tuple[FloatArray, float]:
    """Sample ranges all over the input; return (n, 3) centres of selected splats, and their share of the sample.

    Args:
        blocks: approximate number of blocks; for one, no sample is needed.
    """
    if blocks == 1:
        return np.empty((0, 3), np.float32), 1.0
    ranges = min(max(blocks * RANGES_OF_BLOCK, MIN_RANGES), MAX_RANGES)
    starts = np.linspace(0, max(0, stream.count - RANGE_SPLATS), ranges).astype(np.int64).tolist()
    centers, seen, end = [np.empty((0, 3), np.float32)], 0, 0
    for start in starts:
        begin, end = max(start, end), min(start + RANGE_SPLATS, stream.count)
        for leaves, tally, _ in _read_leaves(stream, begin, end, settings):
            seen += tally.count
            centers.append(leaves.center[leaves.is_valid()])
    center = np.concatenate(centers)
    return center, len(center) / max(1, seen)


def _tally_of(part: Arrays) -> SelectionTally:
    """Return the tally of an input part from its result of `scatter`."""
    _, count, first, *dropped = part["counts"].tolist()
    reasons = {reason: number for reason, number in zip(REASONS, dropped, strict=True) if number}
    return SelectionTally(count, reasons, None if first < 0 else first)


def scatter(job: Job, number: int, *, threads: int, progress: Progress) -> None:
    """Sort the splats of an input part into blocks, as a task.

    Results, by group of blocks: `rows`, sorted by block, and `index`, places among the selected splats of this part;
    then a summary: `first`, the first splat of each block; `counts`: splats beyond the range of float32, all splats,
    number of the first invalid one or -1, and dropped ones by reason; `limits`, (2, 4) float64 least and largest centre
    and size; `sample`, rows at an even stride; and `statistics`.
    """
    start, stop = job.parts[number : number + 2]
    rows = np.empty((stop - start, width_of(job.sh_degree)), np.float32)
    used, tally, beyond = 0, SelectionTally(), 0
    for leaves, read, outside in _read_leaves(job.stream, start, stop, job.settings):
        rows_of(leaves, threads, rows[used : used + len(leaves)])
        used += len(leaves)
        tally, beyond = tally.then(read), beyond + outside
        progress("reading", tally.count, stop - start, "splat")
    rows = rows[:used]
    index, first = job.blocks.sort(rows[:, :3])
    for group, members in enumerate(job.blocks.groups):
        here = index[first[members.start] : first[members.stop]]
        job.store.put(job.splats(number, group), {"rows": rows[here], "index": here.astype(np.int32)})
    stride = max(1, job.stream.count // SAMPLE_SPLATS)
    invalid = -1 if tally.first_invalid is None else tally.first_invalid
    counts = [beyond, tally.count, invalid, *(tally.dropped.get(reason, 0) for reason in REASONS)]
    with on_threads(threads):
        splats = splats_of(rows, threads)
        bounds, statistics = Bounds.of(splats), Statistics.of(splats, needed=job.needed)
    limits = np.array([[*bounds.low, bounds.smallest], [*bounds.high, bounds.largest]])
    summary = {"counts": np.array(counts, np.int64), "limits": limits, "sample": rows[::stride]}
    job.store.put(job.part(number), {**summary, "statistics": statistics.array(), "first": first})


def _stages(job: Job) -> Iterator[Task]:
    """Yield the tasks of all stages, and tasks that remove splats as soon as no stage needs them."""
    blocks = job.blocks
    ends = {group.stop - 1: number for number, group in enumerate(blocks.groups)}
    share = job.selected[-1] // blocks.count
    begun = {stage.block: stage_of(stage.number) for stage in blocks.stages}
    for stage in blocks.stages:
        needs = tuple(stage_of(child) for child in stage.children)
        weight = share if stage.block is not None else math.ceil(JOIN_WORK * share * stage.blocks)
        yield Task(stage_of(stage.number), build_stage, (stage.number,), needs, weight)
        if stage.block in ends:
            group = ends[stage.block]
            yield Task(clean_of(group), clean, (group,), tuple(begun[block] for block in blocks.groups[group]))


def build_stage(job: Job, number: int, *, threads: int, progress: Progress) -> None:
    """Run a stage of the build, as a task.

    Results: families, whose nodes are `rows`; the nodes without a parent, or the root from the last stage; then counts
    and statistics of the nodes.
    """
    stage, builder = job.blocks.stages[number], job.builder()
    with on_threads(threads):
        if stage.block is None:
            pending = joined([job.store.get(pending_of(child)) for child in stage.children])
        else:
            pending = builder.leaves(*_read_block(job, stage.block, threads), job.plan)
        families, left = builder.advance(pending, stage.region, number, job.plan, progress=progress)
        del pending
        columns = dict(vars(families))
        job.store.put(families_of(number), {"rows": rows_of(columns.pop("nodes"), threads), **columns})
        statistics = [Statistics.of(families.nodes, families.family == NO_FAMILY, job.needed)]
        if stage.region is None:
            root, family = drawn_splats(left), int(left["family"][0])
            job.store.put(ROOT, {"rows": rows_of(root), "family": np.array([family], np.int64)})
            statistics.append(Statistics.of(root, np.array([family == NO_FAMILY]), job.needed))
        else:
            job.store.put(pending_of(number), left)
    counts = np.array([len(families), len(families.family)], np.int64)
    job.store.put(stage_of(number), {"counts": counts, "statistics": Statistics.merged(statistics).array()})


def clean(job: Job, group: int, *, threads: int, progress: Progress) -> None:
    """Remove the splats of a group of blocks whose stages are done, as a task."""
    for part in range(len(job.parts) - 1):
        job.store.remove(job.splats(part, group))
    job.store.put(clean_of(group), {})


def _read_block(job: Job, block: int, threads: int) -> tuple[Splats, NDArray[np.int64]]:
    """Read the splats of a block, and the place of each among all selected splats."""
    group = next(number for number, blocks in enumerate(job.blocks.groups) if block in blocks)
    begin = job.blocks.groups[group].start
    ranges = []
    for part in range(len(job.parts) - 1):
        first = job.store.get(job.part(part), ["first"])["first"]
        ranges.append((first[block : block + 2] - first[begin]).tolist())
    total = sum(stop - start for start, stop in ranges)
    rows: Rows = np.empty((total, width_of(job.sh_degree)), np.float32)
    index, at = np.empty(total, np.int64), 0
    for part, (start, stop) in enumerate(ranges):
        if start == stop:
            continue
        here, name = slice(at, at + stop - start), job.splats(part, group)
        rows[here] = job.store.rows(name, "rows", start, stop)
        index[here] = job.store.rows(name, "index", start, stop)
        index[here] += job.selected[part]
        at = here.stop
    return splats_of(rows, threads), index
