"""Spark: budgeted cuts through Level-of-Detail trees, the nodes that it draws for a camera."""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lod.kernels import cut_arrays, pixel_scale
from ..lod.kernels.cut import find_cut
from ..lod.view_foveation import set_foveation
from ..model.foveation import Cones, Foveation
from ..model.gaussian import spark_size
from ..model.lod_tree import CHUNK_BITS, CHUNK_NODES
from ..model.splats import Splats
from ..model.traversed import Nodes

#: Initial size of the buffers, in visited nodes per node of a cut: enough if every refined node has two or more
#: children; for other trees the buffers grow.
VISITS = 2

#: The first threshold for a cut, as a share of the last cut's: slightly lower, because visiting some nodes
#: unnecessarily costs less than another round. Chosen; cuts do not depend on it.
GUESS = 0.97

Matrix = NDArray[np.float64]

#: Why a cut is not finer, by the kernel's code.
REASONS = {
    cut_arrays.BUDGET: "budget",
    cut_arrays.PIXEL: "pixel",
    cut_arrays.MISSING: "missing",
    cut_arrays.EXHAUSTED: "exhausted",
}


@dataclass(frozen=True)
class TreeInstance:
    """An instance of tree number `tree` of a `Forest`; see `model.instances.Instance`."""

    tree: int = 0
    object_to_world: Matrix = field(default_factory=lambda: np.eye(4))
    lod_scale: float = 1.0
    foveation: Foveation = field(default_factory=Cones)


@dataclass(frozen=True)
class CutView:
    """A camera for the traversal.

    Attributes:
        camera_to_world: (4, 4), axes of OpenGL: x to the right, y up, looking along -z.
        fov_x, fov_y: radians.
    """

    camera_to_world: Matrix
    fov_x: float
    fov_y: float


class Forest:
    """Trees in the memory layout of the traversal.

    Attributes:
        nodes: `pixel_scale.NODE` of all trees, one after the other.
        node_base: (trees + 1,) int64 index of each tree's first node.
        chunk_base: (trees + 1,) int64 index of each tree's first chunk.
    """

    def __init__(self, trees: Sequence[Nodes]) -> None:
        self._make_room([len(tree.size) for tree in trees], np.empty)
        for tree, start in zip(trees, self.node_base.tolist(), strict=False):
            fill_nodes(self.nodes[start : start + len(tree.size)], tree)

    def _make_room(self, counts: Sequence[int], make: Callable[..., NDArray[Any]]) -> None:
        self.node_base = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        chunks = [-(-count // CHUNK_NODES) for count in counts]
        self.chunk_base = np.concatenate([[0], np.cumsum(chunks)]).astype(np.int64)
        self.nodes = make(int(self.node_base[-1]), pixel_scale.NODE)

    def __len__(self) -> int:
        return len(self.node_base) - 1

    @property
    def chunks(self) -> int:
        """Number of chunks of all trees."""
        return int(self.chunk_base[-1])

    def present(self) -> NDArray[np.bool_]:
        """Return the (chunks,) bool, those whose nodes are in memory; not changed later."""
        return np.ones(self.chunks, np.bool_)

    def read(self, chunks: NDArray[np.bool_]) -> None:
        """Read those of these chunks, (chunks,) bool, that are not in memory."""

    def read_some(self, demand: NDArray[np.float32], present: NDArray[np.bool_]) -> bool:
        """Read chunks that a cut wants; False if it lacked none.

        Args:
            demand, present: (chunks,), of a `TreeCut`, and the chunks that it was found with.
        """
        return False


class SplatForest(Forest):
    """Scenes of which viewers draw whole runs of splats: splats as nodes, for statistics of cuts; chunks are files.

    Args:
        coarse: of each scene, (N,) bool, true for splats that finer ones replace; the others count as leaves.
        files: number of files of each.
    """

    def __init__(self, splats: Sequence[Splats], coarse: Sequence[NDArray[np.bool_]], files: Sequence[int]) -> None:
        self._splats, self._coarse = splats, coarse
        self.node_base = np.cumsum([0, *map(len, splats)]).astype(np.int64)
        self.chunk_base = np.cumsum([0, *files]).astype(np.int64)

    @functools.cached_property
    def nodes(self) -> NDArray[np.void]:  # type: ignore[override]  # made when the first statistics are asked for
        """(N,) `pixel_scale.NODE` of all scenes."""
        nodes = np.zeros(int(self.node_base[-1]), pixel_scale.NODE)
        for splats, coarse, start in zip(self._splats, self._coarse, self.node_base.tolist(), strict=False):
            part = nodes[start : start + len(splats)]
            part["x"], part["y"], part["z"] = splats.center.T
            part["size"] = spark_size(splats)
            part["child_count"] = coarse
        return nodes

    def cut_of(
        self,
        instances: Sequence[TreeInstance],
        view: CutView,
        nodes: Sequence[NDArray[np.uint32]],
        reason: str,
        missing: int,
        demand: NDArray[np.float32],
        start: float,
    ) -> TreeCut:
        """Return the cut of these nodes of each instance, which `time.perf_counter` timed from `start` on."""
        return TreeCut(
            views=views_of(self, instances, view),
            node=np.concatenate(nodes),
            instance=np.repeat(np.arange(len(nodes), dtype=np.uint16), [len(each) for each in nodes]),
            limit=np.full(sum(map(len, nodes)), -1, np.float32),
            reason=reason,
            missing=missing,
            least=np.inf,
            stop=None,
            demand=demand,
            seconds=time.perf_counter() - start,
        )


def fill_nodes(rows: NDArray[np.void], nodes: Nodes) -> None:
    """Fill rows of `pixel_scale.NODE`."""
    rows["x"], rows["y"], rows["z"] = nodes.center.T
    rows["size"] = nodes.size
    rows["child_start"], rows["child_count"] = nodes.tree.first_child(), nodes.tree.child_count


@dataclass(frozen=True)
class TreeCut:
    """The S nodes of a cut, of all instances together.

    Attributes:
        views: (instances,) `pixel_scale.VIEW`.
        node: (S,) uint32 index in its tree.
        instance: (S,) uint16.
        limit: (S,) float32, the least pixel scale from the root to the node; negative if the queue took it out, because
            it has no children or they are not resident.
        reason: why the cut is not finer, a value of `REASONS`.
        missing: number of nodes that would be refined if their children were resident, and of roots that are not.
        least: the least limit of a refined node; infinite if none was refined.
        stop: (pixel scale, instance, index) of the node that would have exceeded the budget, or None.
        demand: (chunks,) float32, for each chunk of all trees the largest limit of the nodes that are, or should be,
            refined and have children in it; 0 without such nodes.
        seconds: that it took to find, once its chunks were in memory.
    """

    views: NDArray[np.void]
    node: NDArray[np.uint32]
    instance: NDArray[np.uint16]
    limit: NDArray[np.float32]
    reason: str
    missing: int
    least: float
    stop: tuple[float, int, int] | None
    demand: NDArray[np.float32]
    seconds: float = 0.0

    def __len__(self) -> int:
        return len(self.node)

    def indices(self) -> list[NDArray[np.uint32]]:
        """Return the nodes of the cut in each instance, ascending."""
        return [np.sort(self.node[self.instance == number]) for number in range(len(self.views))]

    def chunks(self) -> list[int]:
        """Return the chunks of all trees that finding the cut reads, or would read if they were resident, by priority.

        Those of equal priority are in the order of their numbers; Spark has them in the order that its queue finds.
        """
        requested = np.flatnonzero(self.demand > 0)
        order: list[int] = requested[np.argsort(-self.demand[requested], kind="stable")].tolist()
        return order


class Traversal:
    """Finds cuts of at most 65,535 instances. Each thread has its own buffers, which are reused for the next cut."""

    def __init__(self, forest: Forest, instances: Sequence[TreeInstance]) -> None:
        self.forest, self.instances = forest, list(instances)
        self._memory = _Memory()
        sizes = np.diff(forest.node_base)
        self._most = sum(int(sizes[instance.tree]) for instance in self.instances)

    def cut(
        self, view: CutView, *, budget: int, smallest: float = 0.0, resident: NDArray[np.bool_] | None = None
    ) -> TreeCut:
        """Return the cut that a viewer draws.

        Args:
            budget: maximum number of splats, all instances together; at least one per instance.
            smallest: nodes of this pixel scale or less are not refined; see `settings.pixel_limit`.
            resident: (chunks,) bool, of all trees; all chunks are resident unless given.
        """
        if resident is not None:
            self.forest.read(resident)
            return self._cut(view, budget, smallest, resident)
        while True:
            # As long as chunks are not in memory that would be read next, the cut is one of a viewer that lacks them.
            present = self.forest.present()
            cut = self._cut(view, budget, smallest, present)
            if not self.forest.read_some(cut.demand, present):
                return cut

    def _cut(self, view: CutView, budget: int, smallest: float, present: NDArray[np.bool_]) -> TreeCut:
        """Return the cut with these chunks, which are in memory."""
        start = time.perf_counter()
        views = views_of(self.forest, self.instances, view)
        trees = cut_arrays.Trees(self.forest.nodes, views, present, CHUNK_BITS)
        stop = cut_arrays.Stop(np.float32(smallest).view(np.int32), budget)
        room = min(budget, self._most) + 1  # the kernel writes one more before it knows whether that is drawn
        nodes = cut_arrays.CutNodes(np.empty(room, np.uint32), np.empty(room, np.int32), np.empty(room, np.uint16))
        demand, memory = np.empty(len(present), np.float32), self._memory
        size = VISITS * budget + CHUNK_NODES
        while True:
            size = min(size, 2 * self._most)  # a node is visited by its threshold, and once more by the queue
            if memory.slots is None or len(memory.slots.node) <= size:
                memory.slots = _slots(size)
            slots, guess = memory.slots, np.float32(memory.guess)
            selected, reason, missing, least, last = find_cut(trees, stop, guess, slots, demand, nodes)
            if reason != cut_arrays.FULL:
                break
            size = 2 * len(slots.node)
        # The next cut is likely to be similar.
        memory.guess = GUESS * float(least) if reason == cut_arrays.BUDGET else smallest
        return TreeCut(
            views=views,
            node=nodes.node[:selected],
            instance=nodes.instance[:selected],
            limit=nodes.limit[:selected].view(np.float32),
            reason=REASONS[reason],
            missing=missing,
            least=float(least),
            stop=None if last < 0 else _node_at(slots, last),
            demand=demand,
            seconds=time.perf_counter() - start,
        )

    def forget(self) -> None:
        """Discard the threshold of this thread's last cut. The next cut is the same either way."""
        self._memory.guess = 0.0


class _Memory(threading.local):
    """Buffers of a thread, and the threshold that its next cut begins with; 0 for none."""

    slots: cut_arrays.Slots | None = None
    guess = 0.0


def _slots(size: int) -> cut_arrays.Slots:
    return cut_arrays.Slots(
        node=np.empty(size + 1, np.uint32),
        instance=np.empty(size + 1, np.uint16),
        sums=np.empty(cut_arrays.BUCKETS, np.int32),
        tally=np.empty(cut_arrays.TALLIES, np.int64),
        **{name: np.empty(size + 1, np.int32) for name in ("limit", "first", "queue", "pending", "heap")},
    )


def _node_at(slots: cut_arrays.Slots, at: int) -> tuple[float, int, int]:
    """Return the pixel scale, instance and index of the node in a slot."""
    return float(slots.limit.view(np.float32)[at]), int(slots.instance[at]), int(slots.node[at])


def views_of(forest: Forest, instances: Sequence[TreeInstance], view: CutView) -> NDArray[np.void]:
    """Return (instances,) `pixel_scale.VIEW`: the camera in the space of each instance, in Spark's precision."""
    views = np.zeros(len(instances), pixel_scale.VIEW)
    for row, instance in zip(views, instances, strict=True):
        view_to_object = (np.linalg.inv(instance.object_to_world) @ view.camera_to_world).astype(np.float32)
        right, up, backward, origin = view_to_object[:3].T
        for name, vector in (
            ("right", _unit(right)),
            ("up", _unit(up)),
            ("forward", -_unit(backward)),
            ("origin", origin),
        ):
            row[f"{name}_x"], row[f"{name}_y"], row[f"{name}_z"] = vector
        row["lod_scale"] = instance.lod_scale
        row["node_base"] = forest.node_base[instance.tree]
        row["chunk_base"] = forest.chunk_base[instance.tree]
        set_foveation(row, instance.foveation, view.fov_x, view.fov_y)
    return views


def _unit(vector: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a unit vector as glam, Spark's library, computes it: divided by its length, in float32."""
    x, y, z = vector
    unit: NDArray[np.float32] = vector / np.sqrt((x * x + y * y) + z * z)
    return unit
