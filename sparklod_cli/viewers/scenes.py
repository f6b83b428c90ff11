"""Scenes of instances, each read once; `Cut`, the splats of them that are drawn, and `CutFinder`, which finds cuts."""

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
from ..model.instances import DetailScene, Instance, Matrix, TileScene
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

#: Kinds of scenes, `LoadedScene.kind`.
KINDS = (None, TREE, STREAMED_SOG, TILES)

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
        if self.weight is None:
            return splats
        from .continuous import faded

        return replace(splats, opacity=faded(splats.opacity, self.weight))

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
        """The axis of the world that points up, one of `scene.AXES`, where it is the same for all files; else None."""
        return common_axis(axis for _, axis, _ in self.axes)

    @functools.cached_property
    def kind(self) -> str | None:
        """`LoadedScene.kind` of the scenes that have one; the last of several, with which `viewer` fails."""
        return max((loaded.kind for loaded in self.loaded), key=KINDS.index)

    @functools.cached_property
    def with_cuts(self) -> Sequence[LoadedScene]:
        """The scenes of which viewers draw cuts, in the order of `forest`: trees, detail levels or tiles.

        `UnfitError` for two kinds of them, which no viewer draws.
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
        """Splats of full detail of all instances of which cuts are drawn: what budgets are shares of."""
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
        """Return the viewer of the instances of which cuts are drawn.

        Args:
            remembers: of `PlayCanvasViewer`: cuts are found one after the other, along a path.

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

    def full(self) -> Cut:
        """Full detail: all leaves, and all splats of scenes without trees."""
        pairs = zip(self.instances, self.of_instance, strict=True)
        return Cut(tuple(Part(loaded, loaded.leaves, None, at.object_to_world) for at, loaded in pairs))

    def cut_of(self, found: TreeCut | BlendedCut) -> Cut:
        """Return what is drawn: of instances with cuts the nodes of this one, of others all splats."""
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
    """Finds what a viewer draws of scenes; several threads may use it. Without settings it draws full detail.

    `remembers` and errors are those of `Scenes.viewer`.
    """

    def __init__(self, scenes: Scenes, settings: LodSettings | None, *, remembers: bool = False) -> None:
        self.scenes, self.settings = scenes, settings
        cuts = settings is not None and scenes.with_cuts
        self.viewer = scenes.viewer(settings, remembers=remembers) if settings is not None and cuts else None
        self._continuous: ContinuousCuts | None = None
        if self.viewer is not None and settings is not None and settings.continuous is not None:
            from .continuous import ContinuousCuts

            self._continuous = ContinuousCuts(self.viewer)

    def with_budget(self, budget: int) -> CutFinder:
        """Return a finder with another budget and its own viewer, as a viewer begins where its last cut ended."""
        twin = copy.copy(self)
        if self.settings is not None and self.viewer is not None:
            twin.settings = replace(self.settings, budget=budget)
            twin.viewer = self.scenes.viewer(twin.settings)
        return twin

    def find(self, camera: Camera, resident: NDArray[np.bool_] | None = None) -> TreeCut:
        """Return the cut of trees, detail levels or tiles with (chunks,) bool resident chunks, all unless given."""
        assert self.viewer is not None and self.settings is not None
        limit = self.settings.limit(camera.fov_y, camera.height)
        return self.viewer.cut(camera, budget=self.settings.budget, smallest=limit, resident=resident)

    def cut(self, camera: Camera) -> Cut:
        """Return the cut of the trees or detail levels, and all splats of scenes that have none."""
        if self.viewer is None or self.settings is None:
            return self.scenes.full()
        if self._continuous is None or self.settings.continuous is None:
            return self.scenes.cut_of(self.find(camera))
        blended = self._continuous.cut(
            camera,
            budget=self.settings.budget,
            smallest=self.settings.limit(camera.fov_y, camera.height),
            width=self.settings.continuous,
        )
        return self.scenes.cut_of(blended)

    def candidates(self) -> Cut:
        """Return all that some camera may see: whole trees and all levels where cuts are drawn, else full detail."""
        if self.viewer is None:
            return self.scenes.full()
        pairs = zip(self.scenes.instances, self.scenes.of_instance, strict=True)
        return Cut(tuple(Part(loaded, np.arange(loaded.count), None, at.object_to_world) for at, loaded in pairs))


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
        columns: of `Splats` to read; only with `trees_only`; of scenes without trees all are read.
        trees_only: refuse scenes without a tree, detail levels or tiles, of which no cuts are drawn.
        through: one of `formats.ROUND_TRIPS`, a coding after which splats are drawn; cuts are those of the scene.
        precision: one of `PRECISIONS`, of the nodes that cuts are found with.
        paged: only cuts are needed, so that only those chunks of large RAD trees are read that cuts need.

    Raises:
        FormatError: a file cannot be read, has no tree but needs one, or does not fit the coding; names the file.
        TreeError: a tree is broken; names the file.
        InvalidSplatsError: a scene has nothing to draw; names it.
        OutOfMemoryError: a file does not fit into memory; names it.
    """
    loaded: dict[Path | int, LoadedScene] = {}
    notes, of_instance, chunks = list[str](), list[LoadedScene](), 0
    for source in (instance.source for instance in instances):
        file = source if isinstance(source, Path) else None
        key = file or id(source)
        if key in loaded:
            of_instance.append(loaded[key])
            continue
        found: Pages | Scene | DetailScene | TileScene
        if isinstance(source, Path):
            to_read = columns if trees_only else COLUMNS
            found = _read(source, to_read, precision if paged and through is None else None, threads, progress)
        else:
            found = source
        if isinstance(found, Scene):
            name, scene = file or UNNAMED, found
            try:
                scene.check_tree()
            except TreeError as error:
                raise TreeError(f"{name}: its tree is broken: {error}") from None
            if scene.tree is None and trees_only:
                raise FormatError(
                    f"{name}: it is not a Level-of-Detail tree, Streamed SOG or 3D Tiles; bake it first with sparklod"
                    " build-lod"
                )
            notes += (f"{name}: {note}" for note in scene.notes)
            if scene.tree is None:
                scene = _drawable(str(name), scene, notes)
            size = bytes_of(scene.splats) if file is None else size_of_input(file) or 0
            drawn = _rounded(scene, through, file, threads)
            entry: LoadedScene = LoadedScene(file, size, scene, drawn, chunks, precision, threads)
        else:
            from .paging import PagedScene, Pages

            if isinstance(found, Pages):
                assert file is not None
                empty = replace(found.rad.about(), tree=LodTree(np.zeros(0, np.uint16), np.zeros(0, np.uint32)))
                entry = PagedScene(file, size_of_input(file) or 0, empty, empty.splats, chunks, pages=found)
            else:
                entry = _loaded_runs(file, found, through, chunks, threads)
                notes += (f"{entry.name}: {note}" for note in found.notes)
        loaded[key] = entry
        of_instance.append(entry)
        chunks += entry.chunks
    axes = list[tuple[str, str | None, str]]()
    for instance, entry in zip(instances, of_instance, strict=True):
        up = entry.scene.up and rotated_axis(entry.scene.up, instance.object_to_world[:3, :3])
        axes.append((entry.name, up, entry.scene.up_by if up == entry.scene.up else ""))
    return Scenes(instances, list(loaded.values()), of_instance, notes, axes)


def _loaded_runs(
    file: Path | None, found: DetailScene | TileScene, through: str | None, chunks: int, threads: int
) -> LoadedScene:
    """Return all tiles, or all levels and the environment, as one scene with its files."""
    splats = found.splats
    if isinstance(found, DetailScene) and found.environment is not None:
        degree = min(splats.sh_degree, found.environment.sh_degree)
        splats = Splats.concat([part.with_max_sh(degree) for part in (splats, found.environment)])
    if not len(splats):
        raise InvalidSplatsError(f"{file or UNNAMED}: it has no splats")
    scene = Scene(splats, **facts_of(found))
    drawn = _rounded(scene, through, file, threads)
    if isinstance(found, TileScene):
        from .cesium import LoadedTiles

        size = found.header.get("bytes", bytes_of(splats))
        return LoadedTiles(file, size, scene, drawn, chunks, tiles=found)
    from .playcanvas import LoadedDetail, files_in_memory, read_detail_files

    files = files_in_memory(found) if file is None else read_detail_files(file)
    return LoadedDetail(file, int(files.sizes.sum()) + files.manifest, scene, drawn, chunks, detail=found, files=files)


def _read(
    path: Path, columns: Collection[str], paged: str | None, threads: int, progress: Progress
) -> Pages | Scene | DetailScene | TileScene:
    """Read a file: a scene, or one at several detail levels, or of tiles.

    Args:
        paged: precision of the pages of a file that is too large to be read at once; None to read it nevertheless.
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


def _drawable(name: str, scene: Scene, notes: list[str]) -> Scene:
    with naming(name, InvalidSplatsError):
        splats, dropped = Selection(drop_invalid=True).apply(scene.splats)
    if dropped:
        notes.append(f"{name}: left out {describe(dropped)}")
    return replace(scene, splats=splats)


def _rounded(scene: Scene, through: str | None, file: Path | None, threads: int) -> Splats:
    """Return the splats of a scene as an encoding of `codecs.losses.after` rounds them; None rounds nothing."""
    if through is None:
        return scene.splats
    from ..codecs.losses import after

    return after(through, file or Path(UNNAMED), scene, threads)
