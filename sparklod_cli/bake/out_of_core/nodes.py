"""The nodes of a tree in their final order, gathered from the results of the stages."""

from __future__ import annotations

import bisect
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ...lod.stages.records import NO_FAMILY
from ...model.lod_tree import LodTree
from ...model.splats import Splats
from ...model.streams import NodeStream
from .contracts import Store
from .job import ROOT, Job, families_of
from .order import Order
from .rows import splats_of, width_of

#: Rows that are not wanted and read with those around them, rather than in another go. Chosen: some 10 KB.
GAP = 128


class Gathered:
    """Reads nodes in their final order.

    Attributes:
        store: of the stages' results.
        order: of the families.
        width: numbers of a row.
    """

    def __init__(self, job: Job, order: Order) -> None:
        self.store: Store = job.store
        self.order = order
        self.width = width_of(job.sh_degree)
        self._root = job.store.get(ROOT)

    def read(self, start: int, stop: int) -> tuple[Splats, LodTree]:
        """As `NodeStream.read`."""
        rows, family = np.empty((stop - start, self.width), np.float32), np.empty(stop - start, np.int64)
        if start == 0 < stop:
            rows[:1], family[:1] = self._root["rows"], self._root["family"]
        for stage, number in self._stages(start, stop):
            self._fill(stage, number, start, rows, family)
        inner = np.flatnonzero(family != NO_FAMILY)
        number = self.order.numbers(family[inner])
        tree = LodTree(np.zeros(len(rows), np.uint16), np.zeros(len(rows), np.uint32))
        tree.child_count[inner] = self.order.count[number]
        tree.child_start[inner] = self.order.child_start[number]
        return splats_of(rows), tree

    def _stages(self, start: int, stop: int) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """The families that have nodes in a range, ascending, by stage."""
        order = self.order
        begin, end = (
            bisect.bisect_right(order.sequence, place, key=lambda number: int(order.child_start[number]))
            for place in (start, stop - 1)
        )
        number = np.sort(order.sequence[max(0, begin - 1) : end])
        at = np.searchsorted(number, order.begin)
        for stage in np.flatnonzero(np.diff(at)).tolist():
            yield stage, number[at[stage] : at[stage + 1]].astype(np.int64)

    def _fill(
        self, stage: int, number: NDArray[np.int64], start: int, rows: NDArray[np.float32], family: NDArray[np.int64]
    ) -> None:
        """Fills the nodes of some families of a stage, as far as they lie in the range that begins at `start`."""
        name, order = families_of(stage), self.order
        count, row = order.count[number].astype(np.int64), order.row[number].astype(np.int64)
        target = order.child_start[number].astype(np.int64) - start
        # What lies before the range, and beyond its end.
        before = np.maximum(-target, 0)
        row, count, target = row + before, count - before, target + before
        count = np.minimum(count, len(rows) - target)
        runs = np.flatnonzero(row[1:] > row[:-1] + count[:-1] + GAP) + 1
        for part in np.split(np.arange(len(row)), runs):
            first, last = int(row[part[0]]), int(row[part[-1]] + count[part[-1]])
            some = count[part]
            step = np.arange(some.sum()) - np.repeat(np.cumsum(some) - some, some)
            place = np.repeat(target[part], some) + step
            found, of_nodes = (self.store.rows(name, key, first, last) for key in ("rows", "family"))
            if len(place) < len(found):
                wanted = np.repeat(row[part] - first, some) + step
                found, of_nodes = found[wanted], of_nodes[wanted]
            rows[place], family[place] = found, of_nodes


def node_stream(job: Job, order: Order, leaves: int, *, antialiased: bool) -> NodeStream:
    """The nodes of a tree, all of whose stages are done."""
    count = 1 + int(order.count.sum(dtype=np.int64))
    return NodeStream(count, leaves, job.sh_degree, antialiased, Gathered(job, order).read)
