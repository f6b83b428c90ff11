"""Budgeted cuts through Level-of-Detail trees: the nodes that a viewer draws for a camera."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.instances import Cones, Foveation
from ..model.nodes import CHUNK_BITS, CHUNK_NODES, Nodes
from .cut_search import CutSearch
from .foveation import set_foveation
from .kernels import cut_arrays, pixel_scale

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
    """An instance of a tree of a forest.

    Attributes:
        tree: index of the tree in its `Forest`.
        object_to_world: (4, 4) rotation, uniform scale and translation.
        lod_scale: factor for its pixel scales.
        foveation: weights of its pixel scales by direction.
    """

    tree: int = 0
    object_to_world: Matrix = field(default_factory=lambda: np.eye(4))
    lod_scale: float = 1.0
    foveation: Foveation = field(default_factory=Cones)


@dataclass(frozen=True)
class View:
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
        for number, tree in enumerate(trees):
            self._put(tree, int(self.node_base[number]))

    def _make_room(self, counts: Sequence[int], make: Callable[..., NDArray[Any]]) -> None:
        """For trees of so many nodes."""
        self.node_base = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        chunks = [-(-count // CHUNK_NODES) for count in counts]
        self.chunk_base = np.concatenate([[0], np.cumsum(chunks)]).astype(np.int64)
        self.nodes = make(int(self.node_base[-1]), pixel_scale.NODE)

    def _put(self, tree: Nodes, start: int) -> None:
        """Writes some nodes from an index on."""
        part = self.nodes[start : start + len(tree.size)]
        part["x"], part["y"], part["z"] = tree.center.T
        part["size"] = tree.size
        part["child_start"] = tree.tree.first_child()
        part["child_count"] = tree.tree.child_count

    def __len__(self) -> int:
        return len(self.node_base) - 1

    @property
    def chunks(self) -> int:
        """Number of chunks of all trees."""
        return int(self.chunk_base[-1])

    def present(self) -> NDArray[np.bool_]:
        """(chunks,) bool, those whose nodes are in memory; not changed later."""
        return np.ones(self.chunks, np.bool_)

    def read(self, chunks: NDArray[np.bool_]) -> None:
        """Reads those of these chunks, (chunks,) bool, that are not in memory."""

    def read_some(self, wanted: NDArray[np.float32], present: NDArray[np.bool_]) -> bool:
        """Reads chunks that a cut wants; False if it lacked none.

        Args:
            wanted: (chunks,) float32, of a `TreeCut`.
            present: (chunks,) bool that it was found with.
        """
        return False


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
        wanted: (chunks,) float32, for each chunk of all trees the largest limit of the nodes that are, or should be,
            refined and have children in it; 0 if there is none.
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
    wanted: NDArray[np.float32]
    seconds: float = 0.0

    def __len__(self) -> int:
        return len(self.node)

    def indices(self) -> list[NDArray[np.uint32]]:
        """The nodes of the cut in each instance, ascending."""
        return [np.sort(self.node[self.instance == number]) for number in range(len(self.views))]

    def chunks(self) -> list[int]:
        """The chunks of all trees that finding the cut reads, or would read if they were resident, by priority.

        Those of equal priority are in the order of their numbers; Spark has them in the order that its queue finds.
        """
        wanted = np.flatnonzero(self.wanted > 0)
        order: list[int] = wanted[np.argsort(-self.wanted[wanted], kind="stable")].tolist()
        return order


class Traversal:
    """Finds cuts. Each thread has its own buffers, which are reused from one cut to the next.

    Args:
        forest: the trees.
        instances: instances of them, at most 65,535.
    """

    def __init__(self, forest: Forest, instances: Sequence[TreeInstance]) -> None:
        self.forest, self.instances = forest, list(instances)
        self._local = threading.local()
        sizes = np.diff(forest.node_base)
        self._most = sum(int(sizes[instance.tree]) for instance in self.instances)

    def cut(
        self,
        view: View,
        *,
        budget: int,
        smallest: float = 0.0,
        resident: NDArray[np.bool_] | None = None,
        threads: int = 1,
    ) -> TreeCut:
        """The cut that a viewer draws.

        Args:
            view: the camera.
            budget: maximum number of splats, all instances together; at least one per instance.
            smallest: nodes of this pixel scale or less are not refined; see `settings.pixel_limit`.
            resident: (chunks,) bool, of all trees; all chunks are resident unless given.
            threads: that find a large cut, if all chunks are resident; the cut is the same for any number. For several
                cuts, it is faster to find one on each thread.
        """
        if resident is not None:
            self.forest.read(resident)
            return self._cut(view, budget, smallest, resident, threads)
        while True:
            # As long as chunks are not in memory that would be read next, the cut is one of a viewer that lacks them.
            present = self.forest.present()
            found = self._cut(view, budget, smallest, present, threads)
            if not self.forest.read_some(found.wanted, present):
                return found

    def _cut(self, view: View, budget: int, smallest: float, present: NDArray[np.bool_], threads: int) -> TreeCut:
        """The cut with these chunks, which are in memory."""
        start = time.perf_counter()
        views = views_of(self.forest, self.instances, view)
        trees = cut_arrays.Trees(self.forest.nodes, views, present, CHUNK_BITS)
        found = self._search().find(trees, smallest, budget, threads)
        return TreeCut(
            views=views,
            node=found.nodes.node,
            instance=found.nodes.instance,
            limit=found.nodes.limit.view(np.float32),
            reason=REASONS[found.reason],
            missing=found.missing,
            least=found.least,
            stop=found.stop,
            wanted=found.wanted,
            seconds=time.perf_counter() - start,
        )

    def forget(self) -> None:
        """Discards the threshold of this thread's last cut. The next cut is the same either way."""
        self._search().guess = 0.0

    def _search(self) -> CutSearch:
        """This thread's."""
        search: CutSearch | None = getattr(self._local, "search", None)
        if search is None:
            search = self._local.search = CutSearch(self._most)
        return search


def views_of(forest: Forest, instances: Sequence[TreeInstance], view: View) -> NDArray[np.void]:
    """(instances,) `pixel_scale.VIEW`: the camera in the space of each instance, in Spark's precision."""
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
    """A unit vector as glam, Spark's library, computes it: divided by its length, in float32."""
    x, y, z = vector
    unit: NDArray[np.float32] = vector / np.sqrt((x * x + y * y) + z * z)
    return unit
