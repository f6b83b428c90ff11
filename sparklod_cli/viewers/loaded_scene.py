"""Scenes for viewing, shared by their instances: plain ones, trees, also page by page, detail levels and tiles."""

from __future__ import annotations

import functools
import itertools
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..cameras.framing import SAMPLE, USED, Balls, balls_of
from ..lod.kernels.pixel_scale import NODE
from ..model.instances import Instance
from ..model.lod_tree import CHUNK_BITS, CHUNK_NODES, LodTree
from ..model.scene import FileCoding, Scene, facts_of
from ..model.splats import COLUMNS, Splats
from ..model.traversed import DetailScene, Nodes, TileScene
from ..system.errors import TreeError, naming
from ..system.machine import available_memory
from ..system.threads import ordered_map
from .playcanvas import DetailFiles
from .spark import Forest, fill_nodes
from .viewer_settings import CESIUM_FETCHERS, CONNECTIONS, PLAYCANVAS_FETCHERS

if TYPE_CHECKING:
    from ..io.rad_file import RadFile

Index = NDArray[np.signedinteger]

#: What a scene without a file is called in messages and titles.
UNNAMED = "scene"


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene, read once however many instances it has.

    Attributes:
        file: None for a scene that was in memory.
        bytes: of the file; of a scene that was in memory, of its columns.
        scene: as the file has it; columns that were not read are 0.
        splats: N, as they are drawn: those of the scene, or what a coding makes of them.
        first_chunk: number of its first chunk, where the chunks of all scenes are counted.
    """

    file: Path | None
    bytes: int
    scene: Scene
    splats: Splats
    first_chunk: int

    @property
    def name(self) -> str:
        return self.file.name if self.file is not None else UNNAMED

    @property
    def is_tree(self) -> bool:
        return self.scene.tree is not None

    @property
    def has_cuts(self) -> bool:
        """Whether a viewer draws cuts of it: of a tree, of detail levels or of tiles."""
        return self.is_tree

    @functools.cached_property
    def depth(self) -> NDArray[np.int32]:
        """(N,) edges from the root to each node; 0 without a tree."""
        return np.zeros(self.count, np.int32) if self.scene.tree is None else self.scene.tree.depths()

    @functools.cached_property
    def every(self) -> Index:
        return np.arange(self.count)

    @functools.cached_property
    def leaves(self) -> Index:
        """(M,) indices of full detail: the leaves of a tree, or all splats."""
        return self.every if self.scene.tree is None else np.flatnonzero(self.scene.tree.is_leaf)

    @functools.cached_property
    def full(self) -> Splats:
        """M splats of full detail, in the space of the scene."""
        return self.splats if self.leaves is self.every else self.rows(self.leaves)

    @property
    def count(self) -> int:
        return len(self.splats)

    @property
    def leaf_count(self) -> int:
        return len(self.leaves)

    @property
    def chunks(self) -> int:
        """Number of chunks, of 65,536 splats each."""
        return -(-self.count // CHUNK_NODES)

    def rows(self, index: Index) -> Splats:
        """Return some splats, in the space of the scene, by their indices, ascending."""
        return self.splats if index is self.every else self.splats.take(index)

    @property
    def has_chunks(self) -> bool:
        """Whether its format has chunks of as many splats as Spark streams (RAD)."""
        sizes, splats = self.scene.chunk_bytes, self.scene.header.get("chunk_size")
        return sizes is not None and len(sizes) == self.chunks and splats == CHUNK_NODES

    def chunk_of(self, index: Index) -> NDArray[np.int64]:
        """Return the (M,) numbers of the chunks that some splats are in, where the chunks of all scenes are counted."""
        return self.first_chunk + index // CHUNK_NODES

    def chunk_bytes(self) -> NDArray[np.int64]:
        """Return the (chunks,) bytes of each; without chunks of its own (SPZ) as if the file were cut evenly."""
        if self.has_chunks:
            return np.array(self.scene.chunk_bytes, np.int64)
        ends = np.minimum(np.arange(1, self.chunks + 1) * CHUNK_NODES, self.count)
        return np.diff(ends * self.bytes // self.count, prepend=0)

    @property
    def header_bytes(self) -> int:
        """Bytes that a viewer needs before it can ask for a chunk; 0 where the format has no chunks."""
        return self.scene.header.get("header_bytes", 0) if self.has_chunks else 0


def nodes_of(splats: Splats, tree: LodTree, coding: FileCoding, *, precision: str, threads: int) -> Nodes:
    """Return nodes as a traversal reads them, in one of `codecs.formats.PRECISIONS`."""
    if precision == "float32":
        return Nodes.of(splats, tree)
    from ..codecs.gpu import lod_tree

    if precision == "float16":
        return lod_tree.unpack(lod_tree.pack(splats, tree, threads=threads))
    return lod_tree.nodes(splats, tree, precision, coding, threads=threads)


class LoadedRuns(LoadedScene):
    """A scene of which viewers draw whole runs of splats, each from a file that a manifest names."""

    #: Chunk files that its viewer fetches at a time.
    fetchers: ClassVar[int]
    #: Requests that a browser has under way at a time; None where the fetchers are the bound.
    connections: ClassVar[int | None] = None

    @property
    def has_cuts(self) -> bool:
        return True

    @property
    def manifest_bytes(self) -> int:
        """Bytes of the manifest, which is read before any other file; 0 for a scene in memory."""
        raise NotImplementedError

    @property
    def requests(self) -> Sequence[tuple[int, ...]]:
        """For each file, bytes of the answer to a first request, and of those that follow it together."""
        return [(size,) for size in self.chunk_bytes().tolist()]

    @property
    def chunks(self) -> int:
        """Number of files."""
        return len(self.chunk_bytes())


@dataclass(frozen=True, eq=False)
class LoadedDetail(LoadedRuns):
    """A scene at several detail levels; `scene` and `splats` have those of all levels, then the environment.

    Attributes:
        detail: its regions.
        files: where its splats are.
    """

    fetchers = PLAYCANVAS_FETCHERS
    connections = CONNECTIONS

    detail: DetailScene = field(kw_only=True)
    files: DetailFiles = field(kw_only=True)

    @property
    def manifest_bytes(self) -> int:
        return self.files.manifest

    @property
    def requests(self) -> Sequence[tuple[int, ...]]:
        return self.files.requests or super().requests

    @functools.cached_property
    def depth(self) -> NDArray[np.int32]:
        """(N,) the detail level of each splat; 0 of the environment."""
        levels = np.repeat(np.arange(self.detail.levels, dtype=np.int32), self.detail.counts.sum(axis=0))
        return np.concatenate([levels, np.zeros(self.count - len(levels), np.int32)])

    @functools.cached_property
    def leaves(self) -> Index:
        """(M,) indices of level 0 and of the environment."""
        return np.flatnonzero(self.depth == 0)

    def chunk_of(self, index: Index) -> NDArray[np.int64]:
        return self.first_chunk + self._file[index]

    @functools.cached_property
    def _file(self) -> NDArray[np.int64]:
        file = np.repeat(self.files.of_run.T.ravel(), self.detail.counts.T.ravel())
        return np.concatenate([file, np.full(self.count - len(file), self.files.environment or 0)])

    def chunk_bytes(self) -> NDArray[np.int64]:
        return self.files.sizes


@dataclass(frozen=True, eq=False)
class LoadedTiles(LoadedRuns):
    """A scene of tiles; `scene` and `splats` have those of all tiles."""

    fetchers = CESIUM_FETCHERS

    tiles: TileScene = field(kw_only=True)

    @property
    def manifest_bytes(self) -> int:
        return 0 if self.tiles.sizes is None else self.bytes - int(self.tiles.sizes.sum())

    @functools.cached_property
    def depth(self) -> NDArray[np.int32]:
        """(N,) the level of the tile of each splat, 0 of the root."""
        return np.repeat(self.tiles.level, self.tiles.counts)

    @functools.cached_property
    def leaves(self) -> Index:
        """(M,) indices of the splats of tiles without children."""
        return np.flatnonzero(np.repeat(self.tiles.is_leaf, self.tiles.counts))

    def chunk_of(self, index: Index) -> NDArray[np.int64]:
        return self.first_chunk + np.searchsorted(np.cumsum(self.tiles.counts), index, side="right")

    def chunk_bytes(self) -> NDArray[np.int64]:
        if self.tiles.sizes is not None:
            return self.tiles.sizes
        return bytes_of(self.splats) * self.tiles.counts // max(1, self.count)


def whole_scene(parts: DetailScene | TileScene) -> Scene:
    """Return all tiles, or all levels and the environment, as one plain scene."""
    splats = parts.splats
    if isinstance(parts, DetailScene) and parts.environment is not None:
        degree = min(splats.sh_degree, parts.environment.sh_degree)
        splats = Splats.concat([part.with_max_sh(degree) for part in (splats, parts.environment)])
    return Scene(splats, **facts_of(parts))


def files_in_memory(detail: DetailScene) -> DetailFiles:
    """Return files for a scene in memory: one for each level, of the bytes of its columns, and the environment."""
    of_run = np.where(detail.counts > 0, np.arange(detail.levels), -1)
    sizes = [bytes_of(detail.splats) * int(count) // max(1, len(detail.splats)) for count in detail.counts.sum(axis=0)]
    if detail.environment is None:
        return DetailFiles(of_run, np.array(sizes, np.int64))
    return DetailFiles(of_run, np.array([*sizes, bytes_of(detail.environment)], np.int64), detail.levels)


def bytes_of(splats: Splats) -> int:
    """Return the bytes of the columns."""
    return sum(getattr(splats, name).nbytes for name in COLUMNS)


#: Makes nodes of the splats, the tree and the coding of a chunk.
NodesOf = Callable[[Splats, LodTree, FileCoding], Nodes]

#: Columns that nodes are made of.
TRAVERSED = ("center", "scale", "opacity")

#: Decoded chunks that are kept for the splats of the next cut: they take at most this share of the free memory, but
#: there are at least so many. Chosen.
KEPT_SHARE, LEAST_KEPT = 0.25, 8

#: Share of the chunks that a cut lacks that is read before the cut is found again, the most important ones first. With
#: fewer, it is found more often; with more, chunks are read that it turns out not to need. Chosen.
READ_SHARE = 0.5


class Pages:
    """The nodes and splats of a RAD file that were needed so far.

    Nodes of chunks that were read stay in memory, 28 bytes each; of decoded splats, only those of some chunks. Several
    threads may use it. Where a chunk is damaged, a `FormatError` names the file.

    Args:
        file: of a tree in chunks of `CHUNK_NODES`.
        name: of the file, for errors.
        threads: to decode splats with.

    Attributes:
        present: (chunks,) bool, those whose nodes are in memory.
        depth: (N,) int32 edges from the root, of the nodes that the present chunks lead to; 0 of others.
    """

    def __init__(self, file: RadFile, name: str, nodes_of: NodesOf, threads: int) -> None:
        self.file, self._name, self._nodes_of, self._threads = file, name, nodes_of, threads
        self.count = file.header.count
        self.present = np.zeros(len(file.header.chunks), np.bool_)
        self.nodes, self.depth = np.zeros(0, NODE), np.zeros(0, np.int32)
        self._lock = threading.Lock()
        self._cache: OrderedDict[int, Splats] = OrderedDict()
        self._kept = LEAST_KEPT
        free = available_memory()
        if free is not None:
            size = CHUNK_NODES * bytes_of(Splats.empty(1, file.header.max_sh))
            self._kept = max(LEAST_KEPT, int(KEPT_SHARE * free / size))

    def place(self, nodes: NDArray[np.void], depth: NDArray[np.int32]) -> None:
        """Set the arrays of zeros, (N,) `NODE` and (N,) int32, that nodes are read into, and read the root's."""
        self.nodes, self.depth = nodes, depth
        self.read([0])

    def read(self, numbers: Sequence[int]) -> None:
        """Read the nodes of chunks that are not present; a `TreeError` if their children are not those of a tree."""
        for number in numbers:
            with self._lock:
                if self.present[number]:
                    continue
                splats, tree, coding = self._decoded(number, TRAVERSED)
                assert tree is not None
                start = number << CHUNK_BITS
                self._check(tree, start)
                fill_nodes(self.nodes[start : start + len(tree)], self._nodes_of(splats, tree, coding))
                self.present[number] = True
                known = start + np.flatnonzero(self.depth[start : start + len(tree)])
                self._descend(known if number else np.concatenate([np.zeros(1, np.int64), known]))

    def _check(self, tree: LodTree, start: int) -> None:
        """Raise a `TreeError` for children that no tree has; `LodTree.validate` has the same texts."""
        first, node = tree.child_start.astype(np.int64), start + np.arange(len(tree))
        for mask, what in (
            (~tree.is_leaf & (first <= node), "comes after one of its children"),
            (~tree.is_leaf & (first + tree.child_count > self.count), "has children past the last node"),
        ):
            if mask.any():
                raise TreeError(f"{self._name}: its tree is broken: node {node[np.argmax(mask)]} {what}")

    def _descend(self, frontier: NDArray[np.int64]) -> None:
        """Set the depths of the nodes below some whose depth is known, in the chunks that are present."""
        while len(frontier):
            count = self.nodes["child_count"][frontier].astype(np.int64)
            inner, count = frontier[count > 0], count[count > 0]
            first = self.nodes["child_start"][inner].astype(np.int64)
            children = np.repeat(first - (np.cumsum(count) - count), count) + np.arange(count.sum())
            twice = self.depth[children] > 0
            if twice.any() or len(np.unique(children)) < len(children):
                node = np.repeat(inner, count)[np.argmax(twice)]
                raise TreeError(f"{self._name}: its tree is broken: node {node} shares children with another node")
            self.depth[children] = np.repeat(self.depth[inner] + 1, count)
            frontier = children[self.present[children >> CHUNK_BITS]]

    def splats(self, index: NDArray[np.integer]) -> Splats:
        """Return some splats by their indices, (M,) ascending; decoded chunks are cached for the next ones."""
        rows = Splats.empty(len(index), self.file.header.max_sh)
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
        """Yield all chunks in order, with these columns; none of them is cached."""
        with naming(self._name):
            for _, splats, tree in self.file.chunks(columns, thorough=False, threads=self._threads):
                assert tree is not None
                yield splats, tree

    def leaf_count(self) -> int:
        return sum(int(np.count_nonzero(tree.is_leaf)) for _, tree in self.blocks(()))

    def leaves(self) -> NDArray[np.int64]:
        found = [np.flatnonzero(tree.is_leaf) for _, tree in self.blocks(())]
        return np.concatenate([number * CHUNK_NODES + leaves for number, leaves in enumerate(found)])

    def _decoded(self, number: int, columns: Collection[str]) -> tuple[Splats, LodTree | None, FileCoding]:
        with naming(self._name):
            return self.file.chunk(number, columns)


class PagedForest(Forest):
    """Trees in the memory layout of the traversal; those with pages are read as cuts need them.

    Args:
        trees: whole, each with the depths of its nodes, or pages.

    Attributes:
        depth: (nodes,) int32 edges from the root to each, of the nodes that were read and of their children.
    """

    def __init__(self, trees: Sequence[tuple[Nodes, NDArray[np.int32]] | Pages]) -> None:
        # Zeros take no memory before something is written to them.
        self._make_room([tree.count if isinstance(tree, Pages) else len(tree[1]) for tree in trees], np.zeros)
        self.depth = np.zeros(len(self.nodes), np.int32)
        self._pages = {number: tree for number, tree in enumerate(trees) if isinstance(tree, Pages)}
        for number, tree in enumerate(trees):
            start, stop = self.node_base[number : number + 2]
            if isinstance(tree, Pages):
                tree.place(self.nodes[start:stop], self.depth[start:stop])
            else:
                fill_nodes(self.nodes[start:stop], tree[0])
                self.depth[start:stop] = tree[1]

    def present(self) -> NDArray[np.bool_]:
        """Return the (chunks,) bool, those whose nodes are in memory; not changed later."""
        present = np.ones(self.chunks, np.bool_)
        for number, pages in self._pages.items():
            present[self.chunk_base[number] : self.chunk_base[number + 1]] = pages.present
        return present

    def read(self, chunks: NDArray[np.bool_]) -> None:
        """Read those of these chunks, (chunks,) bool, that are not in memory; errors are those of `Pages.read`."""
        for number, pages in self._pages.items():
            own = chunks[self.chunk_base[number] : self.chunk_base[number + 1]]
            pages.read(np.flatnonzero(own & ~pages.present).tolist())

    def read_some(self, wanted: NDArray[np.float32], present: NDArray[np.bool_]) -> bool:
        """Read the more important half of the chunks that a cut lacked; False if it lacked none.

        The most important one is needed for certain, as a cut takes nodes by their importance; others may turn out not
        to be, once the nodes in that one take their share of the budget.
        """
        missing = np.flatnonzero((wanted > 0) & ~present)
        missing = missing[np.argsort(-wanted[missing], kind="stable")]
        now = np.zeros(self.chunks, np.bool_)
        now[missing[: int(np.ceil(READ_SHARE * len(missing)))]] = True
        self.read(now)
        return len(missing) > 0


@dataclass(frozen=True, eq=False)
class PagedScene(LoadedScene):
    """A tree that may be larger than memory; `scene` and `splats` have no rows."""

    pages: Pages = field(kw_only=True)

    @property
    def depth(self) -> NDArray[np.int32]:
        """(N,) edges from the root to each node that was read, and to their children."""
        return self.pages.depth

    @property
    def count(self) -> int:
        return self.pages.count

    @functools.cached_property
    def leaves(self) -> Index:
        """(M,) indices of full detail, for which the children of all nodes are read."""
        return self.pages.leaves()

    @functools.cached_property
    def leaf_count(self) -> int:
        return self.pages.leaf_count()

    def rows(self, index: Index) -> Splats:
        return self.pages.splats(index)


def sampled_balls(instances: Sequence[Instance], scenes: Sequence[LoadedScene]) -> Balls:
    """Return the sample of what the splats of instances cover that cameras are framed by."""
    counts = [loaded.leaf_count for loaded in scenes]
    while True:
        every = max(sum(counts) // SAMPLE, 1)
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        samples = [_Sample(int(start), every) for start in starts[:-1]]
        for loaded in dict.fromkeys(scenes):
            of_loaded = [at for at, each in enumerate(scenes) if each is loaded]
            for splats, leaves in _leaves_of(loaded):
                for at in of_loaded:
                    samples[at].add(balls_of(splats, leaves, instances[at].object_to_world))
        found = [sample.count for sample in samples]
        if found == counts:
            break
        counts = found  # some are not finite, and do not count
    whole = Balls.concat(part for sample in samples for part in sample.parts)
    low = np.min([sample.low for sample in samples], axis=0)
    high = np.max([sample.high for sample in samples], axis=0)
    return Balls(whole.center, whole.radius, np.stack([low, high]), max(sample.largest for sample in samples))


class _Sample:
    """Every n-th ball of an instance, and the bounds of all of them; the first one has the number `start` of all."""

    def __init__(self, start: int, every: int) -> None:
        self._start, self._every = start, every
        self.count, self.largest = 0, 0.0
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.parts: list[Balls] = [Balls(np.empty((0, 3)), np.empty(0))]

    def add(self, balls: Balls) -> None:
        first = -(self._start + self.count) % self._every
        self.parts.append(Balls(balls.center[first :: self._every].copy(), balls.radius[first :: self._every].copy()))
        self.count += len(balls.radius)
        self.largest = max(self.largest, float(balls.radius.max(initial=0)))
        self.low = np.minimum(self.low, balls.center.min(axis=0, initial=np.inf))
        self.high = np.maximum(self.high, balls.center.max(axis=0, initial=-np.inf))


def _leaves_of(loaded: LoadedScene) -> Iterator[tuple[Splats, Index]]:
    if not isinstance(loaded, PagedScene):
        yield loaded.splats, loaded.leaves
        return
    for splats, tree in loaded.pages.blocks(USED):
        yield splats, np.flatnonzero(tree.is_leaf)
