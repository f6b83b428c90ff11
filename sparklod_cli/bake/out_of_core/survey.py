"""The survey of a scene: a first look at a few of its splats, and what is known after all were read."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...codecs.statistics import Statistics
from ...lod.check import check_visible
from ...lod.kernels.geometry import find_bounds
from ...lod.stage_records import Survey
from ...model.selection import REASONS, Tally
from ...model.splats import FloatArray
from ...model.streams import SceneStream
from ..checks import check_transformed
from ..settings import BakeSettings
from .contracts import Arrays
from .parts import Kept, kept_of
from .rows import Rows, rows_of, splats_of

#: Ranges of the input that are read for a first look: for each block, at least, and at most; and splats of each. Blocks
#: differ by a few per cent in their splats then, even where neighbours in the file are neighbours in space. Chosen.
RANGES_OF_BLOCK, MIN_RANGES, MAX_RANGES, RANGE_SPLATS = 32, 64, 512, 256

#: Splats of the survey's sample, or a few more. Chosen.
SAMPLE_SPLATS = 1 << 18


def first_look(stream: SceneStream, settings: BakeSettings, blocks: int) -> tuple[FloatArray, float]:
    """(n, 3) centres of splats that are kept, from ranges all over the input, and the share of splats that are kept.

    Args:
        stream: the input.
        settings: of the bake.
        blocks: that the scene will be cut into, about; for a single one nothing is read.
    """
    if blocks == 1:
        return np.empty((0, 3), np.float32), 1.0
    ranges = min(max(blocks * RANGES_OF_BLOCK, MIN_RANGES), MAX_RANGES)
    starts = np.linspace(0, max(0, stream.count - RANGE_SPLATS), ranges).astype(np.int64).tolist()
    centers, seen, end = [np.empty((0, 3), np.float32)], 0, 0
    for start in starts:
        begin, end = max(start, end), min(start + RANGE_SPLATS, stream.count)
        for kept in kept_of(stream, begin, end, settings):
            seen += kept.tally.count
            centers.append(kept.splats.center[kept.splats.is_valid()])
    center = np.concatenate(centers)
    return center, len(center) / max(1, seen)


@dataclass(frozen=True, eq=False)
class Findings:
    """What is known of splats that were read.

    Attributes:
        tally: what became of them.
        beyond: how many of those that are kept left the range of float32 when they were transformed.
        box: (2, 3) float64 corners of the box of the centres that are kept, world units; infinite without any.
        sizes: (2,) float64 range of their sizes, 2 * max(scale), world units.
        sample: rows of an even sample of them.
        statistics: of them.
    """

    tally: Tally
    beyond: int
    box: NDArray[np.float64]
    sizes: NDArray[np.float64]
    sample: Rows
    statistics: Statistics

    @classmethod
    def of(cls, kept: Kept, stride: int, needed: Collection[str], threads: int) -> Findings:
        """Of some splats; every so many of those that are kept are the sample."""
        splats = kept.splats
        low, high, smallest, largest = find_bounds(splats.center, splats.scale, threads)
        sample = rows_of(splats.take(slice(None, None, stride)))
        found = Statistics.of(splats, needed=needed)
        return cls(kept.tally, kept.beyond, np.stack([low, high]), np.array([smallest, largest]), sample, found)

    @classmethod
    def merged(cls, parts: Sequence[Findings]) -> Findings:
        """Those of one part or more, in the order of the parts."""
        tally = Tally()
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
        """The findings of `arrays`."""
        beyond, count, first, *dropped = arrays["counts"].tolist()
        reasons = {reason: number for reason, number in zip(REASONS, dropped, strict=True) if number}
        return cls(
            Tally(count, reasons, None if first < 0 else first),
            beyond,
            arrays["box"],
            arrays["sizes"],
            arrays["sample"],
            Statistics.from_array(arrays["statistics"]),
        )

    def survey(self) -> Survey:
        """What the builder has to know."""
        sample = splats_of(self.sample)
        low, high = (tuple(corner) for corner in self.box.tolist())
        smallest, largest = self.sizes.tolist()
        return Survey(self.tally.kept, sample.sh_degree, low, high, smallest, largest, sample)


def check_findings(findings: Findings, settings: BakeSettings) -> None:
    """Checks that a tree can be made of a whole scene.

    Raises:
        InvalidSplatsError: as `bake`.
    """
    settings.selection.check(findings.tally)
    check_transformed(findings.beyond)
    check_visible(float(findings.sizes[0]))
