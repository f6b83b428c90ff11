"""The input of a bake out of core: a first look at a few splats, then each part is read once and put into blocks."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...codecs.statistics import Statistics
from ...lod.check import Bounds, check_visible
from ...model.selection import REASONS, SelectionTally
from ...model.sh import width_of
from ...model.splats import FloatArray, Splats
from ...model.streams import SceneStream
from ...system.progress import Progress
from ...system.threads import blocks_of, on_threads
from ..selecting import check_transformed, select, transform
from ..settings import BakeSettings
from .job import Job
from .nodes import Rows, fill_rows, rows_of, splats_of
from .store import Arrays

#: Splats of a part, unless blocks are smaller, and the most parts: their splats of all blocks are pieces of files, of
#: which there should not be too many. Chosen.
PART_SPLATS, MAX_PARTS = 1 << 19, 256

#: Ranges of the input that are read for a first look: for each block, at least, and at most; and splats of each. Blocks
#: differ by a few per cent in their splats then, even where neighbours in the file are neighbours in space. Chosen.
RANGES_OF_BLOCK, MIN_RANGES, MAX_RANGES, RANGE_SPLATS = 32, 64, 512, 256

#: Splats of the sample that a builder plans by, or a few more. Chosen.
SAMPLE_SPLATS = 1 << 18


def parts_of(count: int, block_splats: int) -> tuple[int, ...]:
    """Return where each part of the input begins, and at last the count; an empty input has no part."""
    length = max(min(block_splats, PART_SPLATS), -(-count // MAX_PARTS))
    return (0, *(part.stop for part in blocks_of(count, length)))


def leaves_of(
    stream: SceneStream, start: int, stop: int, settings: BakeSettings
) -> Iterator[tuple[Splats, SelectionTally, int]]:
    """Yield the leaves that a range of the input becomes, block by block.

    Yields:
        those that are kept, transformed; the tally of all; and how many of those that are kept left the range of
        float32.
    """
    for splats in stream.read(start, stop):
        selected, tally = select(splats, settings, start=start, total=stream.count)
        start += len(splats)
        leaves, beyond = transform(selected, settings.transform)
        yield leaves, tally, beyond


def first_look(stream: SceneStream, settings: BakeSettings, blocks: int) -> tuple[FloatArray, float]:
    """Return (n, 3) centres of selected splats, from ranges all over the input, and the share of selected splats.

    Args:
        blocks: that the scene will be cut into, about; for a single one nothing is read.
    """
    if blocks == 1:
        return np.empty((0, 3), np.float32), 1.0
    ranges = min(max(blocks * RANGES_OF_BLOCK, MIN_RANGES), MAX_RANGES)
    starts = np.linspace(0, max(0, stream.count - RANGE_SPLATS), ranges).astype(np.int64).tolist()
    centers, seen, end = [np.empty((0, 3), np.float32)], 0, 0
    for start in starts:
        begin, end = max(start, end), min(start + RANGE_SPLATS, stream.count)
        for leaves, tally, _ in leaves_of(stream, begin, end, settings):
            seen += tally.count
            centers.append(leaves.center[leaves.is_valid()])
    center = np.concatenate(centers)
    return center, len(center) / max(1, seen)


@dataclass(frozen=True, eq=False)
class Findings:
    """Counts, bounds, sample and statistics of splats that were read.

    Attributes:
        tally: what became of them.
        beyond: how many of those that are kept left the range of float32 when they were transformed.
        box: (2, 3) float64 corners of the box of the centres that are kept, world units; infinite without any.
        sizes: (2,) float64 range of their sizes, 2 * max(scale), world units.
        sample: rows of an even sample of them.
    """

    tally: SelectionTally
    beyond: int
    box: NDArray[np.float64]
    sizes: NDArray[np.float64]
    sample: Rows
    statistics: Statistics

    @classmethod
    def of(cls, splats: Splats, tally: SelectionTally, beyond: int, stride: int, needed: Collection[str]) -> Findings:
        """Examine splats that are kept; every so many are the sample."""
        bounds = Bounds.of(splats)
        sample = rows_of(splats.take(slice(None, None, stride)))
        found = Statistics.of(splats, needed=needed)
        sizes = np.array([bounds.smallest, bounds.largest])
        return cls(tally, beyond, np.stack([bounds.low, bounds.high]), sizes, sample, found)

    @classmethod
    def merged(cls, parts: Sequence[Findings]) -> Findings:
        """Return those of one part or more, in the order of the parts."""
        tally = SelectionTally()
        for part in parts:
            tally = tally.then(part.tally)
        boxes, sizes = (np.stack([getattr(part, name) for part in parts]) for name in ("box", "sizes"))
        return cls(
            tally,
            sum(part.beyond for part in parts),
            np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)]),
            np.array([sizes[:, 0].min(), sizes[:, 1].max()]),
            np.concatenate([part.sample for part in parts]),
            Statistics.merged([part.statistics for part in parts]),
        )

    def arrays(self) -> Arrays:
        """As arrays, of which `from_arrays` makes them again."""
        first = -1 if self.tally.first_invalid is None else self.tally.first_invalid
        counts = [self.beyond, self.tally.count, first, *(self.tally.dropped.get(reason, 0) for reason in REASONS)]
        return {
            "counts": np.array(counts, np.int64),
            "box": self.box,
            "sizes": self.sizes,
            "sample": self.sample,
            "statistics": self.statistics.array(),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> Findings:
        """Return the findings of `arrays`."""
        beyond, count, first, *dropped = arrays["counts"].tolist()
        reasons = {reason: number for reason, number in zip(REASONS, dropped, strict=True) if number}
        return cls(
            SelectionTally(count, reasons, None if first < 0 else first),
            beyond,
            arrays["box"],
            arrays["sizes"],
            arrays["sample"],
            Statistics.from_array(arrays["statistics"]),
        )

    @property
    def bounds(self) -> Bounds:
        """Bounds of the splats that are kept."""
        smallest, largest = self.sizes.tolist()
        return Bounds(self.box[0], self.box[1], smallest, largest)


def check_findings(findings: Findings, settings: BakeSettings) -> None:
    """Check that a tree can be made of a whole scene; raise `InvalidSplatsError` as `bake` does."""
    settings.selection.check(findings.tally)
    check_transformed(findings.beyond)
    check_visible(float(findings.sizes[0]))


def scatter(job: Job, number: int, *, threads: int, progress: Progress) -> None:
    """Put the splats of a part of the input into blocks; a task.

    Results, by group of blocks: `rows`, sorted by block, and `index`, places among those that are kept of this part; at
    last the findings, with `first`, where the splats of each block begin.
    """
    start, stop = job.parts[number : number + 2]
    rows = np.empty((stop - start, width_of(job.sh_degree)), np.float32)
    used, tally, beyond = 0, SelectionTally(), 0
    for leaves, dropped, outside in leaves_of(job.stream, start, stop, job.settings):
        fill_rows(leaves, rows[used : used + len(leaves)], threads)
        used += len(leaves)
        tally, beyond = tally.then(dropped), beyond + outside
        progress("reading", tally.count, stop - start, "splat")
    rows = rows[:used]
    blocks = job.blocks
    index, first = blocks.sort(rows[:, :3])
    for group, members in enumerate(blocks.groups):
        here = index[first[members.start] : first[members.stop]]
        job.store.put(job.splats(number, group), {"rows": rows[here], "index": here.astype(np.int32)})
    stride = max(1, job.stream.count // SAMPLE_SPLATS)
    with on_threads(threads):
        findings = Findings.of(splats_of(rows, threads), tally, beyond, stride, job.needed)
    job.store.put(job.part(number), {**findings.arrays(), "first": first})
