"""`CutSearch`: runs the kernels that find a cut, on one thread or several."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.nodes import CHUNK_NODES
from .kernels import cut_arrays, cut_parts
from .kernels.cut_arrays import CutNodes, Slots, Stop, Trees

#: Initial size of the buffers, in visited nodes per node of a cut: enough if every refined node has two or more
#: children; for other trees the buffers grow.
VISITS = 2

#: The first threshold for a cut, as a share of the last cut's: slightly lower, because visiting some nodes
#: unnecessarily costs less than another round. Chosen; cuts do not depend on it.
GUESS = 0.97

#: Least budget for which several threads find a cut: below, waking them takes as long as they save.
#: See docs/decisions/2026-11-22-first-frame.md.
PARALLEL_BUDGET = 100_000

#: Number of nodes for each thread that the top of the trees is refined to before its subtrees are dealt out: enough for
#: the threads to take equally long, few enough for one not to work alone for long. Chosen; cuts do not depend on it.
TOP_NODES = 2048


@dataclass(frozen=True)
class Found:
    """What was found: see `traversal.TreeCut`.

    Attributes:
        nodes: of the cut.
        reason: the kernel's code.
    """

    nodes: CutNodes
    reason: int
    missing: int
    least: float
    stop: tuple[float, int, int] | None
    wanted: NDArray[np.float32]


class CutSearch:
    """Finds cuts; its buffers, and the threshold at which a cut ended, are used for the next one. For one thread.

    Args:
        most: number of nodes of all instances.

    Attributes:
        guess: the threshold to begin with; 0 for none.
    """

    def __init__(self, most: int) -> None:
        self.guess = 0.0
        self._most = most
        self._alone: Slots | None = None
        self._together: Slots | None = None
        self._others: ThreadPoolExecutor | None = None

    def find(self, trees: Trees, smallest: float, budget: int, threads: int) -> Found:
        """The cut.

        Args:
            trees: as a camera sees them.
            smallest: nodes of this pixel scale or less are not refined.
            budget: number of nodes.
            threads: that find the cut, if it is large.
        """
        stop = Stop(np.float32(smallest).view(np.int32), budget)
        most = min(budget, self._most)
        length = most + threads  # each thread writes one more before it knows whether that is drawn
        nodes = CutNodes(np.empty(length, np.uint32), np.empty(length, np.int32), np.empty(length, np.uint16))
        found = None
        if threads > 1 and most >= PARALLEL_BUDGET and trees.resident.all():
            found = self._find_together(trees, stop, nodes, threads)
        found = found or self._find_alone(trees, stop, nodes)
        # The next cut is likely to be similar.
        self.guess = GUESS * found.least if found.reason == cut_arrays.BUDGET else smallest
        return found

    def _find_alone(self, trees: Trees, stop: Stop, nodes: CutNodes) -> Found:
        wanted = np.empty((1, len(trees.resident)), np.float32)
        size = VISITS * stop.budget + CHUNK_NODES
        while True:
            size = min(size, 2 * self._most)  # a node is visited by its threshold, and once more by the queue
            if self._alone is None or self._alone.node.shape[1] <= size:
                self._alone = _slots(1, size)
            slots = self._alone
            selected, reason, *rest = cut_parts.take_step(
                cut_parts.WHOLE, 0, trees, stop, np.float32(self.guess), slots, wanted, nodes
            )
            if reason != cut_arrays.FULL:
                return _found(nodes, slots, wanted, selected, reason, *rest)
            size = 2 * slots.node.shape[1]

    def _find_together(self, trees: Trees, stop: Stop, nodes: CutNodes, threads: int) -> Found | None:
        """On several threads; None if their buffers, each with room for twice its share, do not suffice."""
        wanted = np.empty((threads, len(trees.resident)), np.float32)
        size = 2 * VISITS * stop.budget // threads + CHUNK_NODES
        if self._together is None or self._together.node.shape[1] <= size or len(self._together.node) != threads:
            self._together = _slots(threads, size)
            self._others = ThreadPoolExecutor(threads - 1)
        slots, others, guess = self._together, self._others, np.float32(self.guess)
        assert others is not None
        tally = slots.tally

        def take(step: int, part: int = 0) -> tuple[int, int, int, float, int]:
            answer: tuple[int, int, int, float, int] = cut_parts.take_step(
                step, part, trees, stop, guess, slots, wanted, nodes
            )
            return answer

        def take_all(step: int) -> None:
            waiting = [others.submit(take, step, part) for part in range(1, threads)]
            take(step)
            for each in waiting:
                each.result()

        tally[0, cut_arrays.ROOM] = TOP_NODES * threads
        take(cut_parts.SOW)
        while tally[0, cut_arrays.NEXT] == cut_parts.REFINE:
            take_all(cut_parts.REFINE)
            take(cut_parts.PLAN)
        if tally[0, cut_arrays.NEXT] != cut_parts.COLLECT:
            return None
        take_all(cut_parts.COLLECT)
        answer = take(cut_parts.FINISH)
        return None if answer[1] == cut_arrays.FULL else _found(nodes, slots, wanted, *answer)


def _slots(parts: int, size: int) -> Slots:
    """Buffers for so many visited nodes in each part."""
    columns = dict.fromkeys(("limit", "first", "queue", "pending", "heap"), np.int32)
    return Slots(
        node=np.empty((parts, size + 1), np.uint32),
        instance=np.empty((parts, size + 1), np.uint16),
        sums=np.empty((parts, cut_arrays.BUCKETS), np.int32),
        tally=np.empty((parts, cut_arrays.TALLIES), np.int64),
        **{name: np.empty((parts, size + 1), kind) for name, kind in columns.items()},
    )


def _found(
    nodes: CutNodes,
    slots: Slots,
    wanted: NDArray[np.float32],
    selected: int,
    reason: int,
    missing: int,
    least: float,
    last: int,
) -> Found:
    stop = None
    if last >= 0:
        scale = slots.limit.view(np.float32)[0, last]
        stop = float(scale), int(slots.instance[0, last]), int(slots.node[0, last])
    return Found(
        CutNodes(nodes.node[:selected], nodes.limit[:selected], nodes.instance[:selected]),
        reason,
        missing,
        float(least),
        stop,
        wanted.max(axis=0) if len(wanted) > 1 else wanted[0],
    )
