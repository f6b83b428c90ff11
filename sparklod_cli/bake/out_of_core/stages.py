"""Runs a stage of the build: that of a block of splats, or one that joins others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...codecs.statistics import Statistics
from ...lod.stages.records import NO_FAMILY, Families, Pending
from ...model.splats import Splats
from ...support.parallel import on_threads
from ...support.progress import Progress
from .blocks import Stage
from .job import ROOT, Job, clean_of, families_of, pending_of, stage_of
from .rows import Rows, rows_of, splats_of, width_of


def build_stage(job: Job, number: int, *, threads: int, progress: Progress) -> None:
    """A task. Results: families, whose nodes are `rows`; nodes without a parent, or the root of the last stage; at last
    what is to be known of the nodes."""
    stage, builder = job.blocks.stages[number], job.builder()
    with on_threads(threads):
        pending = _begun(job, stage, threads)
        families, left = builder.advance(pending, stage.region, number, job.plan, progress=progress)
        del pending
        _put_families(job, number, families, threads)
        statistics = [Statistics.of(families.nodes, families.family == NO_FAMILY, job.needed)]
        if stage.region is None:
            root, family = builder.root(left)
            job.store.put(ROOT, {"rows": rows_of(root), "family": np.array([family], np.int64)})
            statistics.append(Statistics.of(root, np.array([family == NO_FAMILY]), job.needed))
        else:
            job.store.put(pending_of(number), left.columns)
    counts = np.array([len(families), len(families.family)], np.int64)
    job.store.put(stage_of(number), {"counts": counts, "statistics": Statistics.merged(statistics).array()})


def clean(job: Job, group: int, *, threads: int, progress: Progress) -> None:
    """A task: removes the splats of a group of blocks, whose stages are done."""
    for part in range(len(job.parts) - 1):
        job.store.remove(job.splats(part, group))
    job.store.put(clean_of(group), {})


def _begun(job: Job, stage: Stage, threads: int) -> Pending:
    """The nodes that a stage begins with."""
    if stage.block is None:
        return Pending.concat([Pending(job.store.get(pending_of(child))) for child in stage.children])
    splats, index = block_of(job, stage.block, threads)
    return job.builder().leaves(splats, index, job.plan)


def block_of(job: Job, block: int, threads: int) -> tuple[Splats, NDArray[np.int64]]:
    """The splats of a block, and the place of each among all that are kept."""
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
        index[here] += job.kept[part]
        at = here.stop
    return splats_of(rows, threads), index


def _put_families(job: Job, number: int, families: Families, threads: int) -> None:
    job.store.put(
        families_of(number),
        {
            "batch": families.batch,
            "key": families.key,
            "count": families.count,
            "rows": rows_of(families.nodes, threads),
            "family": families.family,
            "center": families.center,
            "size": families.size,
        },
    )
