"""The protocol of viewers, `Viewer`; the scenes that they load, shared by instances; and their cuts."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..codecs.formats import PRECISIONS
from ..lod.kernels import pixel_scale
from ..model.foveation import Cones, Foveation
from ..model.gaussian import spark_size
from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import FileCoding, Scene
from ..model.splats import COLUMNS, Splats
from .viewer_settings import FETCHERS

if TYPE_CHECKING:
    from ..codecs.spark_nodes import Nodes

Matrix = NDArray[np.float64]


class Viewer(Protocol):
    """A viewer of instances of scenes; several threads may use it.

    A fourth one is a module with two classes, a `Viewer` and a `LoadedScene` with the chunks of a scene, and
    a branch in `Scenes.viewer`.
    """

    forest: Forest
    instances: list[TreeInstance]

    def cut(
        self, camera: Camera, *, budget: int, smallest: float = 0.0, resident: NDArray[np.bool_] | None = None
    ) -> TreeCut:
        """Return the cut that the viewer draws; `TreeCut.wanted` lists the chunks that it requests.

        Args:
            budget: maximum number of splats, all instances together; at least one per instance.
            smallest: nodes of this pixel scale or less are not refined; see `viewer_settings.pixel_limit`.
            resident: (chunks,) bool, of all scenes; all chunks are resident unless given.
        """


class Forest:
    """Scenes in the memory layout of cuts, one after the other.

    Args:
        scenes: each a `LoadedScene`, or `Nodes`: both have numbers of splats (`count`) and of `chunks`, the `depth` of
            each splat, and `fill`, which sets their `pixel_scale.NODE`.

    Attributes:
        node_base: (scenes + 1,) int64 index of each scene's first node.
        chunk_base: (scenes + 1,) int64 index of each scene's first chunk.
    """

    def __init__(self, scenes: Sequence[Any]) -> None:
        self.scenes = scenes
        self.node_base = np.cumsum([0, *(scene.count for scene in scenes)]).astype(np.int64)
        self.chunk_base = np.cumsum([0, *(scene.chunks for scene in scenes)]).astype(np.int64)
        self.chunks = int(self.chunk_base[-1])

    @functools.cached_property
    def nodes(self) -> NDArray[np.void]:
        """(N,) `pixel_scale.NODE` of all scenes."""
        nodes = np.zeros(int(self.node_base[-1]), pixel_scale.NODE)  # no memory is taken before it is written to
        for scene, start in zip(self.scenes, self.node_base.tolist(), strict=False):
            scene.fill(nodes[start : start + scene.count])
        return nodes

    @functools.cached_property
    def depth(self) -> NDArray[np.int32]:
        """(N,) edges from the root to each node, or its detail level; 0 for nodes of pages that were not read."""
        depths = [scene.depth for scene in self.scenes]
        return depths[0] if len(depths) == 1 else np.concatenate(depths)


@dataclass(frozen=True)
class TreeInstance:
    """An instance of scene number `tree` of a `Forest`; see `model.instances.Instance`."""

    tree: int = 0
    object_to_world: Matrix = field(default_factory=lambda: np.eye(4))
    lod_scale: float = 1.0
    foveation: Foveation = field(default_factory=Cones)


@dataclass(frozen=True)
class TreeCut:
    """The S nodes of a cut, of all instances together.

    Attributes:
        views: (instances,) `pixel_scale.VIEW`.
        node: (S,) uint32 index in its tree.
        instance: (S,) uint16.
        limit: (S,) float32, the least pixel scale from the root to the node; negative if the node cannot be refined,
            because it has no children or they are not resident.
        reason: why the cut is not finer, see `Cut.reason`.
        missing: number of nodes that would be refined if their children were resident, and of roots that are not.
        least: the least limit of a refined node; infinite if none was refined.
        stop: (pixel scale, instance, index) of the node that would have exceeded the budget, or None.
        demand: (chunks,) float32, for each chunk of all trees the largest limit of the nodes that are, or should be,
            refined and have children in it; 0 without such nodes.
        seconds: duration of the search, once its chunks were in memory.
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

    def wanted(self) -> list[int]:
        """Return the chunks of all trees that the search reads, or would read if they were resident, by priority.

        Chunks of equal priority are in the order of their numbers; Spark orders them as its queue finds them.
        """
        requested = np.flatnonzero(self.demand > 0)
        order: list[int] = requested[np.argsort(-self.demand[requested], kind="stable")].tolist()
        return order


def views_of(forest: Forest, instances: Sequence[TreeInstance], view: Camera) -> NDArray[np.void]:
    """Return (instances,) `pixel_scale.VIEW`: the camera in the space of each instance, in Spark's precision."""
    views = np.zeros(len(instances), pixel_scale.VIEW)
    for row, instance in zip(views, instances, strict=True):
        view_to_object = (np.linalg.inv(instance.object_to_world) @ view.camera_to_world).astype(np.float32)
        # Unit vectors as glam, Spark's library, computes them: divided by their length, in float32.
        x, y, z = view_to_object[:3, :3]
        right, up, backward = (view_to_object[:3, :3] / np.sqrt((x * x + y * y) + z * z)).T
        vectors = {"right": right, "up": up, "forward": -backward, "origin": view_to_object[:3, 3]}
        for name, vector in vectors.items():
            row[f"{name}_x"], row[f"{name}_y"], row[f"{name}_z"] = vector
        row["lod_scale"] = instance.lod_scale
        row["node_base"] = forest.node_base[instance.tree]
        row["chunk_base"] = forest.chunk_base[instance.tree]
        pixel_scale.set_foveation(row, instance.foveation, view.fov_x, view.fov_y)
    return views


Index = NDArray[np.signedinteger]

#: Name of a scene without a file, in messages and titles.
UNNAMED = "scene"

#: Kinds of scenes that viewers draw cuts of.
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
        splats: N, as they are drawn: those of the scene, or as a coding rounds them.
        first_chunk: number of its first chunk among the chunks of all scenes.
        precision: one of `PRECISIONS`, of the nodes that cuts are found with.
        threads: to prepare nodes on.
        kind: `TREE`, `STREAMED_SOG` or `TILES`; None for a plain scene, which has no cuts.
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
        """Fill (N,) `NODE` with the nodes of a tree, or with splats; all but those of full detail have a child."""
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
        """Return the splats with strictly ascending indices, in the space of the scene."""
        return self.splats if len(index) == self.count else self.splats.take(index)

    def chunk_of(self, index: Index) -> NDArray[np.int64]:
        """Return the (M,) numbers of the chunks of splats, among the chunks of all scenes."""
        return self.first_chunk + index // CHUNK_NODES

    @property
    def requests(self) -> Sequence[tuple[int, ...]]:
        """For each chunk, bytes of the answer to its first request, and to the others, which are sent together.

        A file without chunks (SPZ) counts as cut evenly.
        """
        if self.scene.chunk_bytes is not None and self.has_chunks:
            return [(size,) for size in self.scene.chunk_bytes]
        ends = np.minimum(np.arange(1, self.chunks + 1) * CHUNK_NODES, self.count)
        return [(size,) for size in np.diff(ends * self.bytes // self.count, prepend=0).tolist()]

    @property
    def headers(self) -> tuple[int, ...]:
        """Bytes of the answers with the header, which a viewer needs before it can request a chunk."""
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
    """Return the cut of these splats of each instance; `start` is the `time.perf_counter` before the search."""
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


#: Bytes of the beginning of a file that Spark's pager requests: the next number while the header is not whole.
HEADER_REQUESTS = (64 << 10, 256 << 10, 1 << 20)


def header_answers(header_bytes: int, file_bytes: int) -> tuple[int, ...]:
    """Return the sizes of the answers with a header, which Spark's pager requests before any chunk of a file.

    It discards the part of the first chunk in them. A format without a header has 0 `header_bytes`, and no answers.
    """
    answers: list[int] = []
    for request in HEADER_REQUESTS:
        if (answers[-1] if answers else 0) < header_bytes:
            answers.append(min(request, file_bytes))
    return tuple(answers)


def nodes_of(splats: Splats, tree: LodTree, coding: FileCoding | None, *, precision: str, threads: int) -> Nodes:
    """Return the nodes of a tree for a traversal, in one of `codecs.formats.PRECISIONS`."""
    from ..codecs import spark_nodes

    if precision == "float32":
        return spark_nodes.Nodes(splats.center, spark_size(splats), tree)
    if precision == "float16":
        from ..codecs import layouts

        return layouts.unpack_nodes(layouts.pack_nodes(splats, tree, threads=threads))
    return spark_nodes.nodes(splats, tree, precision, coding, threads=threads)


def bytes_of(splats: Splats) -> int:
    """Return the bytes of all columns in memory."""
    return sum(getattr(splats, name).nbytes for name in COLUMNS)
