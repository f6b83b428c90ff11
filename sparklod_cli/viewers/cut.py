"""The protocol of viewers: `Viewer`, the scenes that it holds (`Forest`), and the cuts that it draws."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..lod.kernels import pixel_scale
from ..model.foveation import Cones, Foveation

if TYPE_CHECKING:
    from ..cameras.camera import Camera

Matrix = NDArray[np.float64]


class Viewer(Protocol):
    """A viewer of instances of some scenes; several threads may ask it.

    A fourth one is a module with two classes, this one and a `loaded_scene.LoadedScene` with the chunks of a scene, and
    a row in `Scenes.viewer`.
    """

    forest: Forest
    instances: list[TreeInstance]

    def cut(
        self, camera: Camera, *, budget: int, smallest: float = 0.0, resident: NDArray[np.bool_] | None = None
    ) -> TreeCut:
        """Return the cut that it draws; `TreeCut.wanted` lists the chunks that it asks for.

        Args:
            budget: maximum number of splats, all instances together; at least one per instance.
            smallest: nodes of this pixel scale or less are not refined; see `viewer_settings.pixel_limit`.
            resident: (chunks,) bool, of all scenes; all chunks are resident unless given.
        """


class Forest:
    """Scenes in the memory layout of cuts, one after the other.

    Args:
        scenes: each a `LoadedScene`, or `Nodes`: with numbers of splats (`count`) and of `chunks`, and the `depth` of
            each splat; `fill` sets their `pixel_scale.NODE`.

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
        """(N,) edges from the root to each node that was read, or its detail level."""
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
        limit: (S,) float32, the least pixel scale from the root to the node; negative if the queue took it out, because
            it has no children or they are not resident.
        reason: why the cut is not finer, see `Cut.reason`.
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

    def wanted(self) -> list[int]:
        """Return the chunks of all trees that finding the cut reads, or would read if they were resident, by priority.

        Those of equal priority are in the order of their numbers; Spark has them in the order that its queue finds.
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
