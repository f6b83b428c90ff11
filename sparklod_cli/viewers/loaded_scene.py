"""Scenes for viewing, shared by their instances: plain ones, trees, and those with runs of splats in files."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..codecs.formats import PRECISIONS
from ..model.gaussian import spark_size
from ..model.lod_tree import CHUNK_NODES, LodTree, Nodes
from ..model.scene import Scene
from ..model.splats import COLUMNS, Splats
from .cut import Forest, TreeCut, TreeInstance, views_of
from .spark import header_answers
from .viewer_settings import FETCHERS

if TYPE_CHECKING:
    from ..cameras.camera import Camera
    from ..model.scene import FileCoding

Index = NDArray[np.signedinteger]

#: What a scene without a file is called in messages and titles.
UNNAMED = "scene"

#: What viewers draw cuts of.
TREE, STREAMED_SOG, TILES = "a Level-of-Detail tree", "Streamed SOG", "3D Tiles"

#: Columns that nodes are made of.
TRAVERSED = ("center", "scale", "opacity")


@dataclass(eq=False)
class LoadedScene:
    """A scene, read once however many instances it has.

    Attributes:
        file: None for a scene that was in memory.
        bytes: of the file; of a scene that was in memory, of its columns.
        scene: as the file has it; columns that were not read are 0.
        splats: N, as they are drawn: those of the scene, or what a coding makes of them.
        first_chunk: number of its first chunk, where the chunks of all scenes are counted.
        precision: one of `PRECISIONS`, of the nodes that cuts are found with.
        threads: to prepare nodes on.
        kind: of scene that cuts are drawn of, `TREE`, `STREAMED_SOG` or `TILES`; None for a plain scene.
        count: number of splats.
        chunks: number of chunks, of 65,536 splats each, or of files.
        has_chunks: its format has chunks of as many splats as Spark streams (RAD).
    """

    #: Whether nodes are read as cuts need them.
    paged: ClassVar[bool] = False
    #: Chunks that its viewer fetches at a time.
    fetchers: ClassVar[int] = FETCHERS
    #: Requests that a browser has under way at a time; None where the fetchers are the bound.
    connections: ClassVar[int | None] = None

    file: Path | None
    bytes: int
    scene: Scene
    splats: Splats
    first_chunk: int
    precision: str = PRECISIONS[0]
    threads: int = 1

    name: str = field(init=False)
    kind: str | None = field(init=False)
    count: int = field(init=False)
    chunks: int = field(init=False)
    has_chunks: bool = field(init=False)

    def __post_init__(self) -> None:
        scene = self.scene
        self.name = UNNAMED if self.file is None else self.file.name
        self.kind = None if scene.tree is None else TREE
        self.count = len(self.splats)
        self.chunks = -(-self.count // CHUNK_NODES)
        sizes, splats = scene.chunk_bytes, scene.header.get("chunk_size")
        self.has_chunks = sizes is not None and len(sizes) == self.chunks and splats == CHUNK_NODES

    def fill(self, rows: NDArray[np.void]) -> None:
        """Fill (N,) `NODE`: nodes of a tree; of other scenes splats, with a child where finer ones replace them."""
        scene = self.scene
        if scene.tree is not None:
            nodes_of(scene.splats, scene.tree, scene.coding, precision=self.precision, threads=self.threads).fill(rows)
            return
        rows["x"], rows["y"], rows["z"] = scene.splats.center.T
        rows["size"] = spark_size(scene.splats)
        rows["child_count"] = 1
        rows["child_count"][self.leaves] = 0

    @functools.cached_property
    def depth(self) -> NDArray[np.int32]:
        """(N,) edges from the root to each node; 0 without a tree."""
        return np.zeros(self.count, np.int32) if self.scene.tree is None else self.scene.tree.depths()

    @functools.cached_property
    def leaves(self) -> Index:
        """(M,) indices of full detail: the leaves of a tree, or all splats."""
        tree = self.scene.tree
        return np.arange(self.count) if tree is None else np.flatnonzero(tree.is_leaf)

    @functools.cached_property
    def full(self) -> Splats:
        """M splats of full detail, in the space of the scene."""
        return self.rows(self.leaves)

    @property
    def leaf_count(self) -> int:
        return len(self.leaves)

    def rows(self, index: Index) -> Splats:
        """Return some splats, in the space of the scene, by their indices, ascending and each once."""
        return self.splats if len(index) == self.count else self.splats.take(index)

    def chunk_of(self, index: Index) -> NDArray[np.int64]:
        """Return the (M,) numbers of the chunks that some splats are in, where the chunks of all scenes are counted."""
        return self.first_chunk + index // CHUNK_NODES

    @property
    def requests(self) -> Sequence[tuple[int, ...]]:
        """For each chunk, bytes of the answer to its first request, and to the others, which are sent together.

        Without chunks of its own (SPZ) they are as if the file were cut evenly.
        """
        if self.scene.chunk_bytes is not None and self.has_chunks:
            return [(size,) for size in self.scene.chunk_bytes]
        ends = np.minimum(np.arange(1, self.chunks + 1) * CHUNK_NODES, self.count)
        return [(size,) for size in np.diff(ends * self.bytes // self.count, prepend=0).tolist()]

    @property
    def headers(self) -> tuple[int, ...]:
        """Bytes of the answers that a viewer waits for before it can ask for a chunk."""
        return header_answers(self.scene.header.get("header_bytes", 0), self.bytes) if self.has_chunks else ()


def cut_of_runs(
    forest: Forest,
    instances: Sequence[TreeInstance],
    view: Camera,
    nodes: Sequence[NDArray[np.uint32]],
    reason: str,
    missing: int,
    demand: NDArray[np.float32],
    start: float,
) -> TreeCut:
    """Return the cut of these splats of each instance, which `time.perf_counter` timed from `start` on."""
    return TreeCut(
        views=views_of(forest, instances, view),
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


def nodes_of(splats: Splats, tree: LodTree, coding: FileCoding | None, *, precision: str, threads: int) -> Nodes:
    """Return nodes as a traversal reads them, in one of `codecs.formats.PRECISIONS`."""
    if precision == "float32":
        return Nodes(splats.center, spark_size(splats), tree)
    from ..codecs import spark_nodes

    if precision == "float16":
        return spark_nodes.unpack(spark_nodes.pack(splats, tree, threads=threads))
    return spark_nodes.nodes(splats, tree, precision, coding, threads=threads)


def bytes_of(splats: Splats) -> int:
    """Return the bytes of the columns."""
    return sum(getattr(splats, name).nbytes for name in COLUMNS)
