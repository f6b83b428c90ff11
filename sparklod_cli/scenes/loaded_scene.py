"""Scenes that are looked at, each read once however often it stands: plain ones, trees, and several detail levels."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ..codecs.gpu import lod_tree
from ..lod.detail_traversal import DetailFiles
from ..lod.settings import CESIUM_FETCHERS, CONNECTIONS, PLAYCANVAS_FETCHERS
from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import FileCoding, Scene, facts_of
from ..model.splats import COLUMNS, Splats
from ..model.traversed import DetailScene, Nodes, TileScene

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
        """N."""
        return len(self.splats)

    @property
    def leaf_count(self) -> int:
        """M."""
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
