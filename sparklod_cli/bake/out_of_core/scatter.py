"""Scatters a part of the input: reads it once, and puts what is kept of it where each block finds its splats."""

from __future__ import annotations

import numpy as np

from ...model.selection import Tally
from ...support.parallel import on_threads
from ...support.progress import Progress
from .job import Job
from .parts import Kept, kept_of
from .rows import fill_rows, splats_of, width_of
from .survey import SAMPLE_SPLATS, Findings


def scatter(job: Job, number: int, *, threads: int, progress: Progress) -> None:
    """A task. Results, by group of blocks: `rows`, sorted by block, and `index`, places among those that are kept of
    this part; at last the findings, with `first`, where the splats of each block begin."""
    start, stop = job.parts[number : number + 2]
    rows = np.empty((stop - start, width_of(job.sh_degree)), np.float32)
    used, tally, beyond = 0, Tally(), 0
    for kept in kept_of(job.stream, start, stop, job.settings):
        fill_rows(kept.splats, rows[used : used + len(kept.splats)], threads)
        used += len(kept.splats)
        tally, beyond = tally.then(kept.tally), beyond + kept.beyond
        progress("reading", tally.count, stop - start, "splat")
    rows = rows[:used]
    blocks = job.blocks
    index, first = blocks.sort(rows[:, :3])
    for group, some_blocks in enumerate(blocks.groups):
        some = index[first[some_blocks.start] : first[some_blocks.stop]]
        job.store.put(job.splats(number, group), {"rows": rows[some], "index": some.astype(np.int32)})
    stride = max(1, job.stream.count // SAMPLE_SPLATS)
    with on_threads(threads):
        findings = Findings.of(Kept(splats_of(rows, threads), tally, beyond), stride, job.needed, threads)
    job.store.put(job.part(number), {**findings.arrays(), "first": first})
