"""Scenes for viewing, shared by their instances: plain ones and trees."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..codecs.formats import PRECISIONS
from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import Scene
from ..model.splats import COLUMNS, Splats
from ..model.traversed import Nodes
from .cut import Forest, TreeInstance, Viewer
from .spark import SparkViewer, header_answers
from .viewer_settings import FETCHERS, LodSettings

if TYPE_CHECKING:
    from ..model.file_coding import FileCoding

Index = NDArray[np.signedinteger]

#: What a scene without a file is called in messages and titles.
UNNAMED = "scene"

#: What viewers draw cuts of.
TREE, STREAMED_SOG, TILES = "a Level-of-Detail tree", "Streamed SOG", "3D Tiles"

#: Columns that nodes are made of.
TRAVERSED = ("center", "scale", "opacity")


@dataclass(frozen=True, eq=False)
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

    @property
    def name(self) -> str:
        return self.file.name if self.file is not None else UNNAMED

    @property
    def kind(self) -> str | None:
        """Kind of scene that cuts are drawn of: `TREE`, `STREAMED_SOG` or `TILES`; None for a plain scene."""
        return None if self.scene.tree is None else TREE

    def viewer(
        self,
        forest: Forest[Any],
        instances: Sequence[TreeInstance],
        settings: LodSettings,
        *,
        fixed: int,
        remembers: bool,
    ) -> Viewer:
        """Return the viewer of scenes of this kind; see `Scenes.viewer`, and `PlayCanvasViewer` for `fixed`."""
        return SparkViewer(forest, instances)

    def fill(self, rows: NDArray[np.void]) -> None:
        """Fill (N,) `NODE` with the nodes of the tree."""
        scene = self.scene
        assert scene.tree is not None
        nodes_of(scene.splats, scene.tree, scene.coding, precision=self.precision, threads=self.threads).fill(rows)

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
    def requests(self) -> Sequence[tuple[int, ...]]:
        """For each chunk, bytes of the answer to its first request, and to the others, which are sent together."""
        return [(size,) for size in self.chunk_bytes().tolist()]

    @property
    def headers(self) -> tuple[int, ...]:
        """Bytes of the answers that a viewer waits for before it can ask for a chunk."""
        return header_answers(self.scene.header.get("header_bytes", 0), self.bytes) if self.has_chunks else ()


def nodes_of(splats: Splats, tree: LodTree, coding: FileCoding | None, *, precision: str, threads: int) -> Nodes:
    """Return nodes as a traversal reads them, in one of `codecs.formats.PRECISIONS`."""
    if precision == "float32":
        return Nodes.of(splats, tree)
    from ..codecs.gpu import lod_tree

    if precision == "float16":
        return lod_tree.unpack(lod_tree.pack(splats, tree, threads=threads))
    return lod_tree.nodes(splats, tree, precision, coding, threads=threads)


def bytes_of(splats: Splats) -> int:
    """Return the bytes of the columns."""
    return sum(getattr(splats, name).nbytes for name in COLUMNS)
