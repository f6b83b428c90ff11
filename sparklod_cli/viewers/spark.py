"""Spark: budgeted cuts through Level-of-Detail trees, the nodes that it draws for a camera."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..lod.kernels import cut
from ..lod.kernels.cut import find_cut
from ..model.lod_tree import CHUNK_BITS, CHUNK_NODES
from .loaded_scene import Forest, TreeCut, TreeInstance, views_of

#: Initial size of the buffers, in visited nodes per node of a cut: enough if every refined node has two or more
#: children; for other trees the buffers grow.
VISITS = 2

#: The first threshold for a cut, as a share of the last cut's: slightly lower, because visiting some nodes
#: unnecessarily costs less than another round. Chosen; cuts do not depend on it.
GUESS = 0.97

#: Share of the missing chunks of a cut, the most important ones, that is read before the cut is found again. A smaller
#: share takes more rounds; a larger one reads chunks that the cut turns out not to need. Chosen.
READ_SHARE = 0.5

#: Why a cut is not finer, by the kernel's code.
REASONS = {cut.BUDGET: "budget", cut.PIXEL: "pixel", cut.MISSING: "missing", cut.EXHAUSTED: "exhausted"}


class SparkViewer:
    """Finds cuts of at most 65,535 instances. Each thread has its own buffers, which are reused for the next cut."""

    def __init__(self, forest: Forest, instances: Sequence[TreeInstance]) -> None:
        self.forest, self.instances = forest, list(instances)
        self._nodes = forest.nodes
        # The buffers of a thread, `slots`, and the threshold that its next cut begins with, `guess`.
        self._memory = threading.local()
        sizes = np.diff(forest.node_base)
        self._most = sum(int(sizes[instance.tree]) for instance in self.instances)
        # Trees that are read as cuts need them, and the numbers of their chunks.
        self._pages: list[tuple[slice, Any]] = []
        bases = (itertools.pairwise(base.tolist()) for base in (forest.node_base, forest.chunk_base))
        for scene, nodes, chunks in zip(forest.scenes, *bases, strict=True):
            if scene.paged:
                scene.pages.place(forest.nodes[slice(*nodes)], forest.depth[slice(*nodes)])
                self._pages.append((slice(*chunks), scene.pages))

    def cut(
        self, camera: Camera, *, budget: int, smallest: float = 0.0, resident: NDArray[np.bool_] | None = None
    ) -> TreeCut:
        """Return the cut that Spark draws; see `Viewer.cut`."""
        if resident is not None:
            self._read(resident)
            return self._cut(camera, budget, smallest, resident)
        while True:
            # This cut takes the chunks in memory for resident, so its demand names those to be read next.
            present = np.ones(self.forest.chunks, np.bool_)
            for chunks, pages in self._pages:
                present[chunks] = pages.present
            cut = self._cut(camera, budget, smallest, present)
            missing = np.flatnonzero((cut.demand > 0) & ~present)
            if not len(missing):
                return cut
            # The most important chunk is needed for certain, since a cut refines nodes by their importance; others may
            # not be, once the nodes of that chunk take their share of the budget.
            missing = missing[np.argsort(-cut.demand[missing], kind="stable")]
            now = np.zeros(len(present), np.bool_)
            now[missing[: int(np.ceil(READ_SHARE * len(missing)))]] = True
            self._read(now)

    def _read(self, wanted: NDArray[np.bool_]) -> None:
        """Read the wanted chunks, (chunks,) bool, that are not in memory; errors are those of `Pages.read`."""
        for chunks, pages in self._pages:
            pages.read(np.flatnonzero(wanted[chunks] & ~pages.present).tolist())

    def _cut(self, view: Camera, budget: int, smallest: float, present: NDArray[np.bool_]) -> TreeCut:
        """Return the cut of a view that uses the resident chunks only.

        Args:
            smallest: pixel-scale limit.
            present: (chunks,) whether each chunk is resident.
        """
        start = time.perf_counter()
        views = views_of(self.forest, self.instances, view)
        trees = cut.Trees(self._nodes, views, present, CHUNK_BITS)
        stop = cut.Stop(np.float32(smallest).view(np.int32), budget)
        room = min(budget, self._most) + 1  # the kernel writes one more before it knows whether that is drawn
        nodes = cut.CutNodes(np.empty(room, np.uint32), np.empty(room, np.int32), np.empty(room, np.uint16))
        demand, memory = np.empty(len(present), np.float32), self._memory
        slots, guess = getattr(memory, "slots", None), np.float32(getattr(memory, "guess", 0.0))
        size = VISITS * budget + CHUNK_NODES
        while True:
            size = min(size, 2 * self._most)  # a node is visited by its threshold, and once more by the queue
            if slots is None or len(slots.node) <= size:
                slots = memory.slots = cut.Slots(
                    node=np.empty(size + 1, np.uint32),
                    instance=np.empty(size + 1, np.uint16),
                    sums=np.empty(cut.BUCKETS, np.int32),
                    tally=np.empty(cut.TALLIES, np.int64),
                    **{name: np.empty(size + 1, np.int32) for name in ("limit", "first", "queue", "pending", "heap")},
                )
            selected, reason, missing, least, last = find_cut(trees, stop, guess, slots, demand, nodes)
            if reason != cut.FULL:
                break
            size = 2 * len(slots.node)
        # The next cut is likely to be similar.
        memory.guess = GUESS * float(least) if reason == cut.BUDGET else smallest
        at = None
        if last >= 0:
            at = float(slots.limit.view(np.float32)[last]), int(slots.instance[last]), int(slots.node[last])
        return TreeCut(
            views=views,
            node=nodes.node[:selected],
            instance=nodes.instance[:selected],
            limit=nodes.limit[:selected].view(np.float32),
            reason=REASONS[reason],
            missing=missing,
            least=float(least),
            stop=at,
            demand=demand,
            seconds=time.perf_counter() - start,
        )
