"""`Scenes`, the scenes of instances, and `Cut`, the splats of them that are drawn."""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.framing import Balls, balls_of
from ..codecs.formats import PRECISIONS
from ..lod.budget import Budget
from ..model.foveation import Foveation
from ..model.gaussian import placed
from ..model.instances import Instance, Matrix
from ..model.scene import Scene, common_axis, rotated_axis, up_notes_of
from ..model.splats import Splats
from ..model.traversed import Nodes
from ..system.units import count_of
from .cesium import TileForest, TileTraversal
from .continuous import ContinuousCuts, faded
from .loaded_scene import (
    Index,
    LoadedDetail,
    LoadedRuns,
    LoadedScene,
    LoadedTiles,
    PagedForest,
    PagedScene,
    nodes_of,
    sampled_balls,
)
from .playcanvas import DetailForest, DetailTraversal
from .spark import CutView, Forest, Traversal, TreeCut, TreeInstance
from .viewer_settings import PLAYCANVAS_BUDGET, LodSettings

Weights = NDArray[np.float64]

#: A cut holds the number of an instance as a uint16.
MAX_INSTANCES = 65_535


@dataclass(frozen=True, eq=False)
class Part:
    """Splats of one instance in a cut.

    Attributes:
        index: (M,) which of the scene's splats are drawn, ascending.
        weight: (M,) float64 by how much, 0..1, in a continuous cut; None for wholly.
        object_to_world: (4, 4) place of the instance.
    """

    scene: LoadedScene
    index: Index
    weight: Weights | None
    object_to_world: Matrix

    @functools.cached_property
    def splats(self) -> Splats:
        """M splats in the space of the scene, with the opacities that are drawn."""
        if self.index is self.scene.leaves:
            return self.scene.full
        splats = self.scene.rows(self.index)
        return splats if self.weight is None else replace(splats, opacity=faded(splats.opacity, self.weight))

    @property
    def depth(self) -> NDArray[np.int32]:
        """(M,) edges from the root to each, or its detail level; 0 of scenes without."""
        return self.scene.depth[self.index]


@dataclass(frozen=True, eq=False, repr=False)
class Cut:
    """Splats of some instances that a camera's picture is drawn from.

    Attributes:
        parts: one for each instance.
        pixel_scale: nodes above it are refined; None where no tree was cut, or nothing refined.
        reason: why the cut has no more nodes: "budget", "pixel" (the limit), "missing" (chunks), "distance" (of detail
            levels) or "exhausted" (full detail); None where all is drawn, or the cut is continuous.
    """

    parts: tuple[Part, ...]
    pixel_scale: float | None = None
    reason: str | None = None

    def __len__(self) -> int:
        return sum(len(part.index) for part in self.parts)

    def __repr__(self) -> str:
        instances = f" of {len(self.parts):,} instances" if len(self.parts) > 1 else ""
        scale = "" if self.pixel_scale is None else f", pixel scale {self.pixel_scale:.4g}"
        return f"Cut({len(self):,} splats{instances}{scale}{f', stopped by {self.reason}' if self.reason else ''})"

    @property
    def nodes(self) -> tuple[Index, ...]:
        """For each instance (M,) which of its splats, or nodes, are drawn, ascending."""
        return tuple(part.index for part in self.parts)

    @functools.cached_property
    def splats(self) -> Splats:
        """All splats in the world; SH of the lowest degree of the scenes, in the directions of their own spaces."""
        parts = []
        degree = min(part.splats.sh_degree for part in self.parts)
        for part in self.parts:
            still = np.array_equal(part.object_to_world, np.eye(4))
            splats = part.splats.with_max_sh(degree)
            parts.append(splats if still else placed(splats, part.object_to_world))
        return parts[0] if len(parts) == 1 else Splats.concat(parts)


@dataclass(frozen=True, eq=False)
class Scenes:
    """Instances and the scenes that they are of; made by `read_scenes`.

    Attributes:
        instances: at least one.
        loaded: each scene once.
        of_instance: of each instance, its scene.
        notes: what a person should know of the files.
        precision: one of `PRECISIONS`, of the nodes that cuts are found with.
        threads: to prepare nodes on.
    """

    instances: Sequence[Instance]
    loaded: Sequence[LoadedScene]
    of_instance: Sequence[LoadedScene]
    notes: Sequence[str] = ()
    precision: str = PRECISIONS[0]
    threads: int = 1

    @property
    def title(self) -> str:
        return ", ".join(dict.fromkeys(loaded.name for loaded in self.loaded))

    @property
    def up(self) -> str | None:
        """The axis of the world that points up, one of `scene.AXES`, where it is the same for all files; else None."""
        return common_axis(axis for _, axis, _ in self._axes)

    @property
    def axis_notes(self) -> list[str]:
        """Lines for a user whose cameras take `up`: who says it, and whether files differ."""
        return up_notes_of(self._axes)

    @property
    def _axes(self) -> list[tuple[str, str | None, str]]:
        """For each instance the name of its file, the axis of the world that is up, and which specification says so."""
        axes = list[tuple[str, str | None, str]]()
        for instance, loaded in zip(self.instances, self.of_instance, strict=True):
            up = rotated_axis(loaded.scene.up, instance.object_to_world[:3, :3])
            axes.append((loaded.name, up, loaded.scene.up_by if up == loaded.scene.up else ""))
        return axes

    @functools.cached_property
    def trees(self) -> list[LoadedScene]:
        """The scenes that have trees, in the order of `forest`."""
        return [loaded for loaded in self.loaded if loaded.is_tree]

    @functools.cached_property
    def details(self) -> list[LoadedDetail]:
        """The scenes at several detail levels, in the order of `forest`."""
        return [loaded for loaded in self.loaded if isinstance(loaded, LoadedDetail)]

    @functools.cached_property
    def tiled(self) -> list[LoadedTiles]:
        """The scenes of tiles, in the order of `forest`."""
        return [loaded for loaded in self.loaded if isinstance(loaded, LoadedTiles)]

    @property
    def in_runs(self) -> Sequence[LoadedRuns]:
        """The scenes of which viewers draw whole runs of splats, in the order of `forest`."""
        return self.details or self.tiled

    @property
    def with_cuts(self) -> Sequence[LoadedScene]:
        """The scenes of which viewers draw cuts, in the order of `forest`: trees, detail levels or tiles.

        `ValueError` for two kinds of them, which no viewer draws.
        """
        kinds: dict[str, Sequence[LoadedScene]] = {
            "a Level-of-Detail tree": self.trees,
            "Streamed SOG": self.details,
            "3D Tiles": self.tiled,
        }
        found = [(kind, scenes[0]) for kind, scenes in kinds.items() if scenes]
        if len(found) > 1:
            (kind, first), (other, second) = found[:2]
            raise ValueError(
                f"{first.name} is {kind} and {second.name} is {other}, whose viewers choose splats in different ways;"
                " look at one of them at a time, or at full detail"
            )
        return self.in_runs or self.trees

    @functools.cached_property
    def leaves(self) -> int:
        """Splats of full detail of all instances of which cuts are drawn: what budgets are shares of."""
        return sum(loaded.leaf_count for loaded in self.of_instance if loaded.has_cuts)

    def splats_of(self, budget: Budget) -> int:
        if budget.by_default and self.details:
            budget = replace(budget, count=PLAYCANVAS_BUDGET)
        if self.tiled:  # CesiumJS has no budget
            return max(1, self.leaves)
        return budget.of(self.leaves if budget.share is not None else 0)

    @functools.cached_property
    def forest(self) -> Forest:
        if self.details:
            return DetailForest(
                *zip(*((each.detail, each.scene.splats, each.files) for each in self.details), strict=True)
            )
        if self.tiled:
            return TileForest([each.tiles for each in self.tiled], [each.scene.splats for each in self.tiled])
        if not any(isinstance(loaded, PagedScene) for loaded in self.trees):
            return Forest([self._nodes(loaded.scene) for loaded in self.trees])
        return PagedForest(
            [
                loaded.pages if isinstance(loaded, PagedScene) else (self._nodes(loaded.scene), loaded.depth)
                for loaded in self.trees
            ]
        )

    @functools.cached_property
    def depth(self) -> NDArray[np.int32]:
        """(nodes,) edges from the root to each node of `forest` that was read, or the detail level of each."""
        if isinstance(self.forest, PagedForest):
            return self.forest.depth
        return np.concatenate([loaded.depth for loaded in self.with_cuts])

    def _nodes(self, scene: Scene) -> Nodes:
        assert scene.tree is not None
        return nodes_of(scene.splats, scene.tree, scene.coding, precision=self.precision, threads=self.threads)

    def tree_instances(self, foveation: Foveation) -> list[TreeInstance]:
        """Return the instances of which cuts are drawn; those without a foveation of their own have this one."""
        numbers = {id(loaded): number for number, loaded in enumerate(self.with_cuts)}
        return [
            TreeInstance(numbers[id(loaded)], at.object_to_world, at.lod_scale, at.foveation or foveation)
            for at, loaded in zip(self.instances, self.of_instance, strict=True)
            if loaded.has_cuts
        ]

    def traversal(
        self, settings: LodSettings, *, remembers: bool = False
    ) -> Traversal | DetailTraversal | TileTraversal:
        """Find the cuts of the instances of trees, of scenes at several detail levels, or of tiles.

        Args:
            remembers: of `DetailTraversal`: cuts are found one after the other, along a path.

        Raises:
            ValueError: the budget is too small for the roots, there are too many instances, or trees as well as scenes
                at several detail levels; or the settings are for trees alone.
        """
        instances = self.tree_instances(settings.foveation)
        if settings.budget < len(instances):
            budget = count_of(settings.budget, "splat")
            raise ValueError(f"a budget of {budget} is less than one for each of {len(instances)} instances")
        if len(instances) > MAX_INSTANCES:
            raise ValueError(f"{len(instances):,} instances are more than {MAX_INSTANCES:,}")
        if not self.in_runs:
            return Traversal(self.forest, instances)
        kind = "Streamed SOG" if self.details else "3D Tiles"
        if settings.continuous is not None:
            raise ValueError(f"{self.in_runs[0].name} is {kind}; continuous cuts are of trees alone")
        for at, loaded in zip(self.instances, self.of_instance, strict=True):
            if loaded.has_cuts and at.foveation is not None:
                raise ValueError(f"{at.name} is {kind}, and has a foveation, which is for trees alone; leave it out")
        if isinstance(self.forest, TileForest):
            return TileTraversal(self.forest, instances)
        assert isinstance(self.forest, DetailForest)
        fixed = sum(loaded.leaf_count for loaded in self.of_instance if not loaded.has_cuts)
        return DetailTraversal(self.forest, instances, settings.detail, fixed=fixed, remembers=remembers)

    def full(self) -> Cut:
        """Full detail: all leaves, and all splats of scenes without trees."""
        return Cut(tuple(map(self._whole, range(len(self.instances)))))

    def cut_of(self, found: TreeCut) -> Cut:
        least = found.least if np.isfinite(found.least) else None
        return Cut(self.parts_of([(nodes, None) for nodes in found.indices()]), least, found.reason)

    def parts_of(self, of_trees: Sequence[tuple[NDArray[np.uint32], Weights | None]]) -> tuple[Part, ...]:
        """Return what is drawn of each instance: of those with cuts, in order, these nodes; of others all."""
        found = iter(of_trees)
        parts = []
        for number, (at, loaded) in enumerate(zip(self.instances, self.of_instance, strict=True)):
            if loaded.has_cuts:
                nodes, weight = next(found)
                parts.append(Part(loaded, nodes.astype(np.int64), weight, at.object_to_world))
            else:
                parts.append(self._whole(number))
        return tuple(parts)

    def _whole(self, number: int) -> Part:
        loaded = self.of_instance[number]
        return Part(loaded, loaded.leaves, None, self.instances[number].object_to_world)

    def balls(self) -> Balls:
        if any(isinstance(loaded, PagedScene) for loaded in self.loaded):
            return sampled_balls(self.instances, self.of_instance)
        return Balls.concat(
            balls_of(loaded.splats, loaded.leaves, at.object_to_world)
            for at, loaded in zip(self.instances, self.of_instance, strict=True)
        )


class CutSource(Protocol):
    """Source of the cuts that pictures show: a `CutFinder`, or a `FixedCut`."""

    def cut(self, camera: Camera) -> Cut:
        """Return what a camera sees."""

    def candidates(self) -> Cut:
        """Return all that some camera may see."""


@dataclass(frozen=True)
class FixedCut:
    """One cut for all cameras."""

    whole: Cut

    def cut(self, camera: Camera) -> Cut:
        return self.whole

    def candidates(self) -> Cut:
        return self.whole


class CutFinder:
    """Finds what a viewer draws of scenes; several threads may use it. Without settings it draws full detail.

    `ValueError` if the budget is too small for the roots, or there are too many instances.
    """

    def __init__(self, scenes: Scenes, settings: LodSettings | None) -> None:
        self.scenes, self.settings = scenes, settings
        self._traversal: Traversal | DetailTraversal | TileTraversal | None = None
        self._continuous: ContinuousCuts | None = None
        if settings is not None and scenes.with_cuts:
            self._traversal = scenes.traversal(settings)
            if settings.continuous is not None and isinstance(self._traversal, Traversal):
                self._continuous = ContinuousCuts(self._traversal)

    def with_budget(self, budget: int) -> CutFinder:
        """Return a finder with another budget and its own traversal, as a traversal begins where its last cut ended."""
        twin = copy.copy(self)
        if self.settings is not None and self._traversal is not None:
            twin.settings = replace(self.settings, budget=budget)
            twin._traversal = self.scenes.traversal(twin.settings)
        return twin

    def cut(self, camera: Camera) -> Cut:
        """Return the cut of the trees or detail levels, and all splats of scenes that have none."""
        if self._traversal is None or self.settings is None:
            return self.scenes.full()
        view, limit = view_of(camera), self.settings.limit(camera.fov_y, camera.height)
        if self._continuous is None or self.settings.continuous is None:
            found = self._traversal.cut(view, budget=self.settings.budget, smallest=limit)
            return self.scenes.cut_of(found)
        blended = self._continuous.cut(
            view, budget=self.settings.budget, smallest=limit, width=self.settings.continuous
        )
        masks = [blended.instance == number for number in range(len(self._traversal.instances))]
        nodes = [(blended.node[mask], blended.weight[mask]) for mask in masks]
        return Cut(self.scenes.parts_of(nodes), blended.threshold)

    def candidates(self) -> Cut:
        """Return all that some camera may see: whole trees and all levels where cuts are drawn, else full detail."""
        if self._traversal is None:
            return self.scenes.full()
        return Cut(
            tuple(
                Part(loaded, loaded.every, None, at.object_to_world)
                for at, loaded in zip(self.scenes.instances, self.scenes.of_instance, strict=True)
            )
        )


def view_of(camera: Camera) -> CutView:
    """Return a camera as the traversal sees it."""
    return CutView(camera.camera_to_world, camera.fov_x, camera.fov_y)
