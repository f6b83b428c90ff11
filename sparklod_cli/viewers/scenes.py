"""Scenes loaded for viewing, shared by their instances; cuts, the splats of them that a viewer draws."""

from __future__ import annotations

import contextlib
import copy
import functools
import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.framing import Balls, balls_of
from ..codecs.formats import PRECISIONS, RAD
from ..codecs.reader import Reader
from ..io.files import opened, size_of_input
from ..lod.budget import Budget
from ..model.gaussian import placed
from ..model.instances import DetailScene, Instance, Matrix, Source, TileScene
from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import Scene, common_axis, facts_of, rotated_axis
from ..model.selection import Selection, describe
from ..model.splats import COLUMNS, Splats
from ..system.errors import FormatError, InvalidSplatsError, TreeError, UnfitError, memory_errors_translated, naming
from ..system.progress import Progress, silent
from ..system.stdio import DASH
from ..system.units import count_of
from .loaded_scene import (
    STREAMED_SOG,
    TILES,
    TREE,
    UNNAMED,
    Forest,
    Index,
    LoadedScene,
    TreeCut,
    TreeInstance,
    Viewer,
    bytes_of,
    nodes_of,
)
from .spark import SparkViewer
from .viewer_settings import PLAYCANVAS_BUDGET, LodSettings

if TYPE_CHECKING:
    from .continuous import BlendedCut, ContinuousCuts
    from .paging import Pages

Weights = NDArray[np.float64]

#: Values of `LoadedScene.kind`.
KINDS = (None, TREE, STREAMED_SOG, TILES)

#: A cut holds the number of an instance as a uint16.
MAX_INSTANCES = 65_535


@dataclass(frozen=True, eq=False)
class Part:
    """Splats of one instance in a cut.

    Attributes:
        index: (M,) indices of the drawn splats in the scene, ascending.
        weight: (M,) float64 weights of the drawn splats in a continuous cut, 0..1; None if all are 1.
        object_to_world: (4, 4) place of the instance.
    """

    scene: LoadedScene
    index: Index
    weight: Weights | None
    object_to_world: Matrix

    @functools.cached_property
    def splats(self) -> Splats:
        """M splats in the space of the scene, with their opacities times their weights."""
        if self.index is self.scene.leaves:
            return self.scene.full
        splats = self.scene.rows(self.index)
        if self.weight is None:
            return splats
        from .continuous import faded

        return replace(splats, opacity=faded(splats.opacity, self.weight))

    @property
    def depth(self) -> NDArray[np.int32]:
        """(M,) edges from the root to each drawn node, or its detail level; 0 in scenes without either."""
        return self.scene.depth[self.index]


@dataclass(frozen=True, eq=False, repr=False)
class Cut:
    """Splats of instances that a viewer draws for a camera.

    Attributes:
        parts: one for each instance.
        pixel_scale: nodes above it are refined; None if no tree was cut, or no node refined.
        reason: why the cut has no more nodes: "budget", "pixel" (the limit), "missing" (chunks), "distance" (of detail
            levels) or "exhausted" (full detail); None at full detail without a cut, and for continuous cuts.
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
        """For each instance (M,) indices of its splats, or nodes, in the cut, ascending."""
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
    """Instances and their scenes; made by `read_scenes`.

    Attributes:
        instances: at least one.
        loaded: each scene once.
        of_instance: the scene of each instance.
        notes: remarks on the files, for display.
        axes: for each instance the name of its file, the axis of the world that is up, and which specification says so.
    """

    instances: Sequence[Instance]
    loaded: Sequence[LoadedScene]
    of_instance: Sequence[LoadedScene]
    notes: Sequence[str] = ()
    axes: Sequence[tuple[str, str | None, str]] = ()

    @property
    def title(self) -> str:
        return ", ".join(dict.fromkeys(loaded.name for loaded in self.loaded))

    @property
    def up(self) -> str | None:
        """The axis of the world that points up, one of `scene.AXES`; None if files have different ones."""
        return common_axis(axis for _, axis, _ in self.axes)

    @functools.cached_property
    def kind(self) -> str | None:
        """`LoadedScene.kind` of the scenes; the last of several different ones, with which `viewer` fails."""
        return max((loaded.kind for loaded in self.loaded), key=KINDS.index)

    @functools.cached_property
    def with_cuts(self) -> Sequence[LoadedScene]:
        """The trees, scenes at several detail levels, or tiles, in the order of `forest`.

        Raises `UnfitError` for two kinds of them, which no viewer draws together.
        """
        scenes = [loaded for loaded in self.loaded if loaded.kind is not None]
        kinds = {kind: loaded for kind in KINDS for loaded in reversed(scenes) if loaded.kind == kind}
        if len(kinds) > 1:
            (kind, first), (other, second), *_ = kinds.items()
            raise UnfitError(
                f"{first.name} is {kind} and {second.name} is {other}, whose viewers choose splats in different ways;"
                " look at one of them at a time, or at full detail"
            )
        return scenes

    @functools.cached_property
    def leaves(self) -> int:
        """Splats of all instances `with_cuts` at full detail; budgets in percent are shares of it."""
        return sum(loaded.leaf_count for loaded in self.of_instance if loaded.kind is not None)

    def splats_of(self, budget: Budget) -> int:
        if budget.by_default and self.kind == STREAMED_SOG:
            budget = replace(budget, count=PLAYCANVAS_BUDGET)
        if self.kind == TILES:  # CesiumJS has no budget
            return max(1, self.leaves)
        return budget.of(self.leaves if budget.share is not None else 0)

    @functools.cached_property
    def forest(self) -> Forest:
        return Forest(self.with_cuts)

    def viewer(self, settings: LodSettings, *, remembers: bool = False) -> Viewer:
        """Return the viewer of the instances of scenes `with_cuts`.

        Args:
            remembers: see `PlayCanvasViewer`.

        Raises:
            UnfitError: the budget is too small for the roots, there are too many instances, or scenes for several
                viewers; or the settings are for trees alone.
        """
        numbers = {id(loaded): number for number, loaded in enumerate(self.with_cuts)}
        instances = [
            TreeInstance(numbers[id(loaded)], at.object_to_world, at.lod_scale, at.foveation or settings.foveation)
            for at, loaded in zip(self.instances, self.of_instance, strict=True)
            if loaded.kind is not None
        ]
        if settings.budget < len(instances):
            budget = count_of(settings.budget, "splat")
            raise UnfitError(f"a budget of {budget} is less than one for each of {len(instances)} instances")
        if len(instances) > MAX_INSTANCES:
            raise UnfitError(f"{len(instances):,} instances are more than {MAX_INSTANCES:,}")
        if self.kind == TREE:
            return SparkViewer(self.forest, instances)
        first = self.with_cuts[0]
        if settings.continuous is not None:
            raise UnfitError(f"{first.name} is {self.kind}; continuous cuts are of trees alone")
        for at, loaded in zip(self.instances, self.of_instance, strict=True):
            if loaded.kind is not None and at.foveation is not None:
                raise UnfitError(
                    f"{at.name} is {self.kind}, and has a foveation, which is for trees alone; leave it out"
                )
        if self.kind == TILES:
            from .cesium import CesiumViewer

            return CesiumViewer(self.forest, instances)
        from .playcanvas import PlayCanvasViewer

        fixed = sum(loaded.leaf_count for loaded in self.of_instance if loaded.kind is None)
        return PlayCanvasViewer(self.forest, instances, settings.detail, fixed=fixed, remembers=remembers)

    def full(self, *, nodes: bool = False) -> Cut:
        """Return full detail: all leaves, and all splats of scenes without trees; or all `nodes`, of all levels."""
        pairs = zip(self.instances, self.of_instance, strict=True)
        indices = ((np.arange(each.count) if nodes else each.leaves, each, at) for at, each in pairs)
        return Cut(tuple(Part(loaded, index, None, at.object_to_world) for index, loaded, at in indices))

    def cut_of(self, found: TreeCut | BlendedCut) -> Cut:
        """Return the cut of all instances: the nodes of a viewer's cut, and all splats of scenes without cuts."""
        numbers, parts = itertools.count(), list[Part]()
        for at, loaded in zip(self.instances, self.of_instance, strict=True):
            index, weight = loaded.leaves, None
            if loaded.kind is not None:
                mask = found.instance == next(numbers)
                index = np.sort(found.node[mask]).astype(np.int64)
                weight = None if isinstance(found, TreeCut) else found.weight[mask]
            parts.append(Part(loaded, index, weight, at.object_to_world))
        if isinstance(found, TreeCut):
            return Cut(tuple(parts), found.least if np.isfinite(found.least) else None, found.reason)
        return Cut(tuple(parts), found.threshold)

    def balls(self) -> Balls:
        if any(loaded.paged for loaded in self.loaded):
            from .paging import sampled_balls

            return sampled_balls(self.instances, self.of_instance)
        parts = [
            balls_of(loaded.splats, loaded.leaves, at.object_to_world)
            for at, loaded in zip(self.instances, self.of_instance, strict=True)
        ]
        return parts[0] if len(parts) == 1 else Balls.concat(parts)


class CutFinder:
    """Finds cuts of scenes; several threads may use it. Without settings cuts have full detail.

    `remembers` and errors are those of `Scenes.viewer`.
    """

    def __init__(self, scenes: Scenes, settings: LodSettings | None, *, remembers: bool = False) -> None:
        self.scenes, self.settings = scenes, settings
        self.viewer: Viewer | None = None
        self._continuous: ContinuousCuts | None = None
        if settings is not None and scenes.with_cuts:
            self.viewer = scenes.viewer(settings, remembers=remembers)
            if settings.continuous is not None:
                from .continuous import ContinuousCuts

                self._continuous = ContinuousCuts(self.viewer)

    def with_budget(self, budget: int) -> CutFinder:
        """Return a finder with another budget and its own viewer, since viewers start from their last cut."""
        twin = copy.copy(self)
        if self.settings is not None and self.viewer is not None:
            twin.settings = replace(self.settings, budget=budget)
            twin.viewer = self.scenes.viewer(twin.settings)
        return twin

    def find(self, camera: Camera, resident: NDArray[np.bool_] | None = None) -> TreeCut:
        """Return the viewer's cut with (chunks,) bool resident chunks; all are resident unless given."""
        assert self.viewer is not None and self.settings is not None
        limit = self.settings.limit(camera.fov_y, camera.height)
        return self.viewer.cut(camera, budget=self.settings.budget, smallest=limit, resident=resident)

    def cut(self, camera: Camera) -> Cut:
        """Return the cut of all instances, see `Scenes.cut_of`; a continuous one if the settings say so."""
        settings = self.settings
        if self.viewer is None or settings is None:
            return self.scenes.full()
        if self._continuous is None or settings.continuous is None:
            return self.scenes.cut_of(self.find(camera))
        limit, width = settings.limit(camera.fov_y, camera.height), settings.continuous
        return self.scenes.cut_of(self._continuous.cut(camera, budget=settings.budget, smallest=limit, width=width))

    def candidates(self) -> Cut:
        """Return all splats that the cut of any camera may have: whole trees, all detail levels, all tiles."""
        return self.scenes.full(nodes=self.viewer is not None)


def read_scenes(
    instances: Sequence[Instance],
    *,
    columns: Collection[str] = COLUMNS,
    trees_only: bool = False,
    through: str | None = None,
    precision: str = PRECISIONS[0],
    paged: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> Scenes:
    """Read the scenes of instances, each once.

    Splats that cannot be drawn are left out of scenes without trees; `Scenes.notes` has their number.

    Args:
        columns: of `Splats` to read, with `trees_only`; without it all are read.
        trees_only: refuse scenes without a tree, detail levels or tiles.
        through: one of `formats.ROUND_TRIPS`, a coding that rounds splats before they are drawn; cuts stay the same.
        precision: one of `PRECISIONS`, of the nodes that cuts are found with.
        paged: read only those chunks of large RAD trees that cuts need.

    Raises:
        FormatError: a file cannot be read, has no tree but needs one, or does not fit the coding; names the file.
        TreeError: a tree is broken; names the file.
        InvalidSplatsError: a scene has nothing to draw; names it.
        OutOfMemoryError: a file does not fit into memory; names it.
    """
    loaded: dict[Path | int, LoadedScene] = {}
    notes, of_instance, chunks = list[str](), list[LoadedScene](), 0
    for instance in instances:
        key = instance.file or id(instance.source)
        if key not in loaded:
            found: Pages | Source = instance.source
            if isinstance(found, Path):
                pages = precision if paged and through is None else None
                found = _read(found, columns if trees_only else COLUMNS, pages, threads, progress)
            if trees_only and isinstance(found, Scene) and found.tree is None:
                raise FormatError(
                    f"{instance.file or UNNAMED}: it is not a Level-of-Detail tree, Streamed SOG or 3D Tiles; bake it"
                    " first with sparklod build-lod"
                )
            loaded[key] = _prepared(instance.file, found, chunks, through, precision, threads, notes)
            chunks += loaded[key].chunks
        of_instance.append(loaded[key])
    axes = list[tuple[str, str | None, str]]()
    for instance, entry in zip(instances, of_instance, strict=True):
        up = entry.scene.up and rotated_axis(entry.scene.up, instance.object_to_world[:3, :3])
        axes.append((entry.name, up, entry.scene.up_by if up == entry.scene.up else ""))
    return Scenes(instances, list(loaded.values()), of_instance, notes, axes)


def _read(
    path: Path, columns: Collection[str], paged: str | None, threads: int, progress: Progress
) -> Pages | Scene | DetailScene | TileScene:
    """Read a file: a scene, detail levels or tiles; of a RAD tree that is too large for memory its first chunk.

    Args:
        paged: precision of the nodes of such a RAD tree; None to read it whole nevertheless.
    """
    with naming(path), memory_errors_translated(), opened(path, threads) as (source, form):
        if paged is not None and form.name == RAD and path != DASH:
            from ..codecs.rad.rad_reader import RadReader, fits
            from .paging import Pages

            with contextlib.suppress(FormatError):  # which is raised below
                rad = RadReader.open(source.file, source.open_companion)
                if not fits(rad.header) and rad.header.lod_tree and rad.header.chunk_size == CHUNK_NODES:
                    nodes = functools.partial(nodes_of, precision=paged, threads=1)
                    return Pages(path, rad, nodes, threads)
        if form.parts is not None and path != DASH:
            parts: DetailScene | TileScene = form.codec().decode_parts(
                source.file, threads=threads, progress=progress, open_companion=source.open_companion
            )
            return parts
        reader: Reader = replace(form.codec().open_content(source), threads=threads)
        return reader.scene(columns=columns, progress=progress, validate=False)


def _prepared(
    file: Path | None,
    found: Pages | Scene | DetailScene | TileScene,
    first_chunk: int,
    through: str | None,
    precision: str,
    threads: int,
    notes: list[str],
) -> LoadedScene:
    """Return a scene as viewers hold it, and append notes about it; tiles, and all detail levels, become one scene."""
    name = file or Path(UNNAMED)
    if isinstance(found, Scene):
        scene = found
        try:
            scene.check_tree()
        except TreeError as error:
            raise TreeError(f"{name}: its tree is broken: {error}") from None
    elif isinstance(found, (DetailScene, TileScene)):
        splats = found.splats
        if isinstance(found, DetailScene) and found.environment is not None:
            degree = min(splats.sh_degree, found.environment.sh_degree)
            splats = Splats.concat([part.with_max_sh(degree) for part in (splats, found.environment)])
        if not len(splats):
            raise InvalidSplatsError(f"{name}: it has no splats")
        scene = Scene(splats, **facts_of(found))
    else:
        from .paging import PagedScene

        assert file is not None
        empty = replace(found.rad.about(), tree=LodTree(np.zeros(0, np.uint16), np.zeros(0, np.uint32)))
        return PagedScene(file, size_of_input(file) or 0, empty, empty.splats, first_chunk, pages=found)
    notes += (f"{name}: {note}" for note in found.notes)
    if isinstance(found, Scene) and scene.tree is None:
        with naming(name, InvalidSplatsError):
            splats, dropped = Selection(drop_invalid=True).apply(scene.splats)
        notes += [f"{name}: left out {describe(dropped)}"] if dropped else []
        scene = replace(scene, splats=splats)
    drawn = scene.splats
    if through is not None:
        from ..codecs.losses import after

        drawn = after(through, name, scene, threads)
    if isinstance(found, Scene):
        size = bytes_of(scene.splats) if file is None else size_of_input(file) or 0
        return LoadedScene(file, size, scene, drawn, first_chunk, precision, threads)
    if isinstance(found, TileScene):
        from .cesium import LoadedTiles

        size = found.header.get("bytes", bytes_of(scene.splats))
        return LoadedTiles(file, size, scene, drawn, first_chunk, tiles=found)
    from .playcanvas import LoadedDetail, files_in_memory, read_detail_files

    files = files_in_memory(found) if file is None else read_detail_files(file)
    size = files.manifest + sum(map(sum, files.requests))
    return LoadedDetail(file, size, scene, drawn, first_chunk, detail=found, files=files)
