"""Pages of RAD files that are larger than memory: chunks are read as cuts need them."""

from __future__ import annotations

import functools
import itertools
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cameras.framing import SAMPLE, USED, Balls, balls_of
from ..codecs.rad.rad_reader import RadReader
from ..codecs.spark_nodes import Nodes
from ..io.files import reopened
from ..lod.kernels.pixel_scale import NODE
from ..model.instances import Instance
from ..model.lod_tree import CHUNK_BITS, CHUNK_NODES, LodTree
from ..model.scene import FileCoding
from ..model.splats import COLUMNS, Splats
from ..system.errors import TreeError, naming
from ..system.machine import available_memory
from ..system.threads import ordered_map
from .loaded_scene import TRAVERSED, Index, LoadedScene, bytes_of

#: Makes nodes of the splats, the tree and the coding of a chunk.
NodesOf = Callable[[Splats, LodTree, FileCoding], Nodes]

#: Decoded chunks that are kept for the splats of the next cut: they take at most this share of the free memory, but
#: there are at least so many. Chosen.
KEPT_SHARE, LEAST_KEPT = 0.25, 8


class Pages:
    """Nodes and splats of a RAD file that is read chunk by chunk.

    Nodes of all chunks that were read stay in memory, 28 bytes each; decoded splats only of the last ones. Several
    threads may use it. A `FormatError` about a damaged chunk names the file.

    Args:
        reader: of a tree in chunks of `CHUNK_NODES`; its file may be closed.
        threads: to decode splats with.

    Attributes:
        present: (chunks,) bool, chunks whose nodes are in memory.
        depth: (N,) int32 edges from the root to nodes of present chunks and to their children; 0 for others.
    """

    def __init__(self, path: Path, reader: RadReader, nodes_of: NodesOf, threads: int) -> None:
        self._path, self.rad, self._nodes_of, self._threads = path, reader, nodes_of, threads
        self.count = reader.header.count
        self.present = np.zeros(len(reader.header.chunks), np.bool_)
        self.nodes, self.depth = np.zeros(0, NODE), np.zeros(self.count, np.int32)
        self._lock = threading.Lock()
        self._cache: OrderedDict[int, Splats] = OrderedDict()
        self._kept = LEAST_KEPT
        free = available_memory()
        if free is not None:
            size = CHUNK_NODES * bytes_of(Splats.empty(1, reader.header.max_sh))
            self._kept = max(LEAST_KEPT, int(KEPT_SHARE * free / size))

    def place(self, nodes: NDArray[np.void], depth: NDArray[np.int32]) -> None:
        """Set the arrays of zeros, (N,) `NODE` and (N,) int32, that nodes are read into, and read the first chunk.

        Only the first call has an effect.
        """
        if self.present.any():
            return
        self.nodes, self.depth = nodes, depth
        self.read([0])

    def read(self, numbers: Sequence[int]) -> None:
        """Read the nodes of chunks that are not present; raise a `TreeError` if they break the tree."""
        for number in numbers:
            with self._lock:
                if self.present[number]:
                    continue
                splats, tree, coding = self._decoded(number, TRAVERSED)
                assert tree is not None
                start = number << CHUNK_BITS
                self._check(tree, start)
                self._nodes_of(splats, tree, coding).fill(self.nodes[start : start + len(tree)])
                self.present[number] = True
                known = start + np.flatnonzero(self.depth[start : start + len(tree)])
                self._descend(known if number else np.concatenate([np.zeros(1, np.int64), known]))

    def _check(self, tree: LodTree, start: int) -> None:
        """Raise a `TreeError` for children that come too early or past the end, with texts of `LodTree.validate`."""
        first, node = tree.child_start.astype(np.int64), start + np.arange(len(tree))
        for mask, what in (
            (~tree.is_leaf & (first <= node), "comes after one of its children"),
            (~tree.is_leaf & (first + tree.child_count > self.count), "has children past the last node"),
        ):
            if mask.any():
                raise TreeError(f"{self._path}: its tree is broken: node {node[np.argmax(mask)]} {what}")

    def _descend(self, frontier: NDArray[np.int64]) -> None:
        """Set the depths of all nodes below those of the frontier, whose depths are known, in present chunks."""
        while len(frontier):
            count = self.nodes["child_count"][frontier].astype(np.int64)
            inner, count = frontier[count > 0], count[count > 0]
            first = self.nodes["child_start"][inner].astype(np.int64)
            children = np.repeat(first - (np.cumsum(count) - count), count) + np.arange(count.sum())
            twice = self.depth[children] > 0
            if twice.any() or len(np.unique(children)) < len(children):
                node = np.repeat(inner, count)[np.argmax(twice)]
                raise TreeError(f"{self._path}: its tree is broken: node {node} shares children with another node")
            self.depth[children] = np.repeat(self.depth[inner] + 1, count)
            frontier = children[self.present[children >> CHUNK_BITS]]

    def splats(self, index: NDArray[np.integer]) -> Splats:
        """Return splats by their indices, (M,) ascending; decoded chunks are cached for the next call."""
        rows = Splats.empty(len(index), self.rad.header.max_sh)
        numbers, begins = np.unique(index >> CHUNK_BITS, return_index=True)
        ends = itertools.pairwise([*begins.tolist(), len(index)])
        parts = {int(number): slice(*each) for number, each in zip(numbers, ends, strict=True)}

        def put(number: int, splats: Splats) -> None:
            part = parts[number]
            for name in COLUMNS:
                getattr(rows, name)[part] = getattr(splats, name)[index[part] - (number << CHUNK_BITS)]

        def decoded(number: int) -> tuple[int, Splats]:
            return number, self._decoded(number, COLUMNS)[0]

        with self._lock:
            kept = [number for number in parts if number in self._cache]
            for number in kept:
                put(number, self._cache[number])
                self._cache.move_to_end(number)
            missing = [number for number in parts if number not in self._cache]
            for number, splats in ordered_map(decoded, missing, self._threads):
                put(number, splats)
                self._cache[number] = splats
                if len(self._cache) > self._kept:
                    self._cache.popitem(last=False)
        return rows

    def blocks(self, columns: Collection[str]) -> Iterator[tuple[Splats, LodTree]]:
        """Yield all chunks in order, without caching them."""
        with naming(self._path), reopened(self._path, self.rad) as reader:
            for _, splats, tree in reader.chunks(columns, thorough=False, threads=self._threads):
                assert tree is not None
                yield splats, tree

    def _decoded(self, number: int, columns: Collection[str]) -> tuple[Splats, LodTree | None, FileCoding]:
        with naming(self._path), reopened(self._path, self.rad) as reader:
            return reader.chunk(number, columns)


@dataclass(eq=False)
class PagedScene(LoadedScene):
    """A tree that may be larger than memory; `scene` and `splats` have no rows."""

    paged = True

    pages: Pages = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.count, self.chunks = self.pages.count, len(self.pages.present)
        self.has_chunks = True

    def fill(self, rows: NDArray[np.void]) -> None:
        """Leave the rows to `Pages.place`."""

    @property
    def depth(self) -> NDArray[np.int32]:
        """(N,) edges from the root to nodes of present chunks and to their children; 0 for others."""
        return self.pages.depth

    @functools.cached_property
    def leaves(self) -> Index:
        """(M,) indices of full detail, found by reading the whole tree."""
        found = [np.flatnonzero(tree.is_leaf) for _, tree in self.pages.blocks(())]
        return np.concatenate([number * CHUNK_NODES + leaves for number, leaves in enumerate(found)])

    @functools.cached_property
    def leaf_count(self) -> int:
        return sum(int(np.count_nonzero(tree.is_leaf)) for _, tree in self.pages.blocks(()))

    def rows(self, index: Index) -> Splats:
        return self.pages.splats(index)


def sampled_balls(instances: Sequence[Instance], scenes: Sequence[LoadedScene]) -> Balls:
    """Return a sample of the bounding spheres of all splats of instances, for framing cameras."""
    counts = [loaded.leaf_count for loaded in scenes]
    while True:
        every = max(sum(counts) // SAMPLE, 1)
        starts = np.concatenate([[0], np.cumsum(counts)]).tolist()
        parts: list[list[Balls]] = [[] for _ in scenes]
        found, largest = [0] * len(scenes), 0.0
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for loaded in dict.fromkeys(scenes):
            of_loaded = [at for at, each in enumerate(scenes) if each is loaded]
            for (splats, leaves), at in ((each, at) for each in _leaves_of(loaded) for at in of_loaded):
                balls = balls_of(splats, leaves, instances[at].object_to_world)
                some = slice(-(starts[at] + found[at]) % every, None, every)
                parts[at].append(Balls(balls.center[some].copy(), balls.radius[some].copy()))
                found[at] += len(balls.radius)
                largest = max(largest, float(balls.radius.max(initial=0)))
                low = np.minimum(low, balls.center.min(axis=0, initial=np.inf))
                high = np.maximum(high, balls.center.max(axis=0, initial=-np.inf))
        if found == counts:
            break
        counts = found  # without those that are not finite
    whole = Balls.concat([Balls(np.empty((0, 3)), np.empty(0)), *itertools.chain.from_iterable(parts)])
    return Balls(whole.center, whole.radius, np.stack([low, high]), largest)


def _leaves_of(loaded: LoadedScene) -> Iterator[tuple[Splats, Index]]:
    if not isinstance(loaded, PagedScene):
        yield loaded.splats, loaded.leaves
        return
    for splats, tree in loaded.pages.blocks(USED):
        yield splats, np.flatnonzero(tree.is_leaf)
