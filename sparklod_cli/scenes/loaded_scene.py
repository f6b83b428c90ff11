"""`LoadedScene`, a scene that is looked at, read once however often it stands."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..codecs.gpu import loaded_nodes, lod_tree
from ..model.lod_tree import LodTree
from ..model.nodes import CHUNK_NODES, Nodes
from ..model.scene import FileCoding, Scene
from ..model.splats import Splats

Index = NDArray[np.signedinteger]

#: What a scene without a file is called in messages and titles.
UNNAMED = "scene"


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene that instances are of, read once however often it stands.

    Attributes:
        file: that it was read from; None for a scene that was in memory.
        bytes: of the file; of a scene that was in memory, of its columns.
        scene: as the file has it; columns that were not asked for are 0.
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
        """For messages and titles: that of the file."""
        return self.file.name if self.file is not None else UNNAMED

    @property
    def is_tree(self) -> bool:
        """Whether it has a Level-of-Detail tree, so that cuts of it can be drawn."""
        return self.scene.tree is not None

    @property
    def has_cuts(self) -> bool:
        """Whether a viewer draws cuts of it, by what a camera sees: of a tree, or of detail levels."""
        return self.is_tree

    @functools.cached_property
    def depth(self) -> NDArray[np.int32] | None:
        """(N,) edges from the root to each node; None without a tree."""
        return None if self.scene.tree is None else self.scene.tree.depths()

    @functools.cached_property
    def every(self) -> Index:
        """(N,) indices of all splats."""
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
        """N."""
        return len(self.splats)

    @property
    def leaf_count(self) -> int:
        """M."""
        return len(self.leaves)

    @property
    def chunks(self) -> int:
        """How many chunks it has, of 65,536 splats each."""
        return -(-self.count // CHUNK_NODES)

    def rows(self, index: Index) -> Splats:
        """Some splats, in the space of the scene, by their indices, ascending."""
        return self.splats if index is self.every else self.splats.take(index)

    @property
    def has_chunks(self) -> bool:
        """Whether its format has chunks of as many splats as Spark streams (RAD)."""
        sizes, splats = self.scene.chunk_bytes, self.scene.header.get("chunk_size")
        return sizes is not None and len(sizes) == self.chunks and splats == CHUNK_NODES

    def chunk_of(self, index: Index) -> NDArray[np.int64]:
        """(M,) numbers of the chunks that some splats are in, where the chunks of all scenes are counted."""
        return self.first_chunk + index // CHUNK_NODES

    def chunk_bytes(self) -> NDArray[np.int64]:
        """(chunks,) bytes of each in the file; without chunks of its own (SPZ) as if the file were cut evenly."""
        if self.has_chunks:
            return np.array(self.scene.chunk_bytes, np.int64)
        nodes = self.count
        ends = np.minimum(np.arange(1, self.chunks + 1) * CHUNK_NODES, nodes)
        return np.diff(ends * self.bytes // nodes, prepend=0)

    @property
    def header_bytes(self) -> int:
        """Bytes that a viewer needs before it can ask for a chunk; 0 where the format has no chunks."""
        return self.scene.header.get("header_bytes", 0) if self.has_chunks else 0


def depth_of(loaded: LoadedScene) -> NDArray[np.int32]:
    """(N,) edges from the root to each node of a tree."""
    assert loaded.depth is not None
    return loaded.depth


def nodes_of(splats: Splats, tree: LodTree, coding: FileCoding, *, precision: str, threads: int) -> Nodes:
    """Nodes as a traversal reads them, in one of `gpu.table.PRECISIONS`."""
    if precision == "float32":
        return Nodes.of(splats, tree)
    if precision == "float16":
        return lod_tree.unpack(lod_tree.pack(splats, tree, threads=threads))
    return loaded_nodes.nodes(splats, tree, precision, coding, threads=threads)
