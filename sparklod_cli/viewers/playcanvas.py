"""PlayCanvas: the detail levels of Streamed SOG that it draws for a camera, also while chunk files load.

A region is drawn at its chosen level as soon as the file of that level is loaded, and until then at its previous level.
PlayCanvas 2.23 does so in `GSplatOctreeInstance.applyLodChanges`; priorities are those of its `requestFile`.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..codecs.reader import OpenCompanion, size_of
from ..codecs.streamed_manifest import MAX_MANIFEST, files_of_chunk, parse
from ..codecs.streamed_sog import layout_of
from ..io.files import opened
from ..model.instances import DetailScene
from ..system.errors import FormatError
from .loaded_scene import STREAMED_SOG, Forest, Index, LoadedScene, TreeCut, TreeInstance, bytes_of, cut_of_runs
from .viewer_settings import CONNECTIONS, LEAST_BASE_DISTANCE, PLAYCANVAS_FETCHERS, DetailRule

Levels = NDArray[np.int64]

#: Positions are counted in bins of a logarithm from -48 to 48, and in parts of the bin that the budget cuts.
BINS, PARTS = 1024, 1024
LOWEST, HIGHEST = -48.0, 48.0
PER_LOG = BINS / (HIGHEST - LOWEST)

#: The bin of steps that are due at their distance.
DUE = BINS // 2

#: The least squared distance.
NEAREST_SQUARED = 1e-12

Matrix = NDArray[np.float64]
Distances = NDArray[np.float64]

#: Distances are those of a camera whose narrower field of view is 45 degrees; others see as large from farther away.
REFERENCE_TANGENT = math.tan(math.radians(22.5))

#: Squared world units below which nothing is behind the camera.
NO_BEHIND = 1e-4

#: Priorities of files, whole numbers: for regions of which nothing is drawn, for those at another level, and for what
#: comes next. The environment is requested before all others.
ENVIRONMENT, NOTHING_DRAWN, ANOTHER_LEVEL, NEXT = 4, 2, 1, 0


@dataclass(frozen=True, eq=False)
class Chains:
    """The levels that regions show at each place, from the finest to the coarsest level that the rule allows.

    A region that has no splats at a level shows the next finer level that has some, and without one the next coarser.
    Beyond the coarsest level that has splats it shows nothing.

    Attributes:
        level: (R, S) int64 the level that is shown at each of S places; -1 for a region without splats.
        count: (R, S) int64 its splats.
        finest: the level of the first place.
    """

    level: Levels
    count: Levels
    finest: int = 0

    @classmethod
    def of(cls, counts: Levels, rule: DetailRule) -> Chains:
        """Return the chains of regions with (R, L) splats at each level."""
        most = counts.shape[1] - 1
        finest = min(rule.finest, most)
        allowed = counts[:, finest : min(rule.coarsest, most) + 1] > 0
        regions, places = allowed.shape
        number = np.broadcast_to(np.arange(places), allowed.shape)
        finer = np.maximum.accumulate(np.where(allowed, number, -1), axis=1)
        coarser = np.minimum.accumulate(np.where(allowed, number, places)[:, ::-1], axis=1)[:, ::-1]
        last = np.where(allowed.any(axis=1), places - 1 - np.argmax(allowed[:, ::-1], axis=1), -1)[:, None]
        shown = np.where(finer >= 0, finer, coarser)
        shown = np.where(number > last, last + 1, shown)
        level = np.where(last < 0, -1, shown + finest)
        empty = (last < 0) | (number > last)
        rows = np.arange(regions)[:, None]
        return cls(level, np.where(empty, 0, counts[rows, np.where(empty, 0, level)]), finest)


@dataclass(frozen=True, eq=False)
class Distant:
    """An instance as a camera sees it: (R,) `RegionBounds.squared_distances`, and its base distance in world units."""

    chains: Chains
    squared_distance: Distances
    base_distance: float = DetailRule.base_distance


@dataclass(frozen=True, eq=False)
class DetailChoice:
    """The levels that a viewer shows.

    Attributes:
        levels: for each instance (R,) the level of each region; -1 for a region without splats. A level at which a
            region has no splats shows nothing of it.
        splats: number of splats at these levels; more than the budget only if the coarsest levels have more.
        reason: why no level is finer: "budget", "distance" (finer ones begin nearer) or "exhausted" (all are finest).
    """

    levels: tuple[Levels, ...]
    splats: int
    reason: str


def choose(instances: Sequence[Distant], budget: int, rule: DetailRule) -> DetailChoice:
    """Return the levels that a viewer shows of one or more instances, all within one budget of splats."""
    limit, keys = rule.mode == "limit", [_keys(each, rule) for each in instances]
    finest, coarsest = (sum(int(each.chains.count[:, place].sum()) for each in instances) for place in (0, -1))
    if coarsest >= budget:
        return _chosen(instances, keys, 0, "budget")
    if not limit and finest <= budget:
        return _chosen(instances, keys, BINS * PARTS, "exhausted")
    if limit:
        due = any((key >= DUE * PARTS).any() for key in keys)
        chosen = _chosen(instances, keys, DUE * PARTS, "distance" if due else "exhausted")
        if chosen.splats <= budget:
            return chosen
    return _chosen(instances, keys, _threshold(instances, keys, budget - coarsest, DUE if limit else BINS), "budget")


def _keys(instance: Distant, rule: DetailRule) -> Levels:
    """Return (R, S - 1) int64, when regions step to the next coarser levels, descending: logarithms in parts of bins.

    A step is due at its distance where the key is `DUE * PARTS`.
    """
    chains, step = instance.chains, math.log(rule.multiplier) * PER_LOG
    zero = (-math.log(instance.base_distance) - LOWEST) * PER_LOG - (chains.finest - 1) * step
    distance = np.log(np.maximum(instance.squared_distance, NEAREST_SQUARED)) * (PER_LOG * 0.5) + zero
    positions: Distances = distance[:, None] - np.arange(1, chains.level.shape[1]) * step
    bins = np.clip(positions, 0, BINS - 1).astype(np.int64)
    parts = np.clip((positions - bins) * PARTS, 0, PARTS - 1).astype(np.int64)
    return bins * PARTS + parts


def _threshold(instances: Sequence[Distant], keys: Sequence[Levels], room: int, bins: int) -> int:
    """Return the least key of the steps to coarser levels that are taken, so that the budget suffices.

    All regions together may exceed their coarsest levels by `room` splats; `bins` is the highest bin.
    """
    key = np.concatenate([each.ravel() for each in keys])
    saved = np.concatenate([-np.diff(each.chains.count, axis=1).ravel() for each in instances])
    cut, room = _first_over(key // PARTS, saved, room, bins)
    if cut == bins:
        return cut * PARTS
    inside = key // PARTS == cut
    part, _ = _first_over(key[inside] % PARTS, saved[inside], room, PARTS)
    return cut * PARTS + part


def _first_over(number: Levels, saved: Levels, room: int, count: int) -> tuple[int, int]:
    """Return the first bin at which the sum of saved splats exceeds the room; and the room left before it."""
    added = np.cumsum(np.bincount(number, saved, minlength=count)[:count])
    over = np.flatnonzero(added > room)
    first = int(over[0]) if len(over) else count
    return first, room - (int(added[first - 1]) if first else 0)


def _chosen(instances: Sequence[Distant], keys: Sequence[Levels], threshold: int, reason: str) -> DetailChoice:
    """Return the levels after all steps whose keys, see `_keys`, are at least a threshold."""
    levels, splats = [], 0
    for instance, key in zip(instances, keys, strict=True):
        at = np.arange(len(key)), (key >= threshold).sum(axis=1)
        levels.append(instance.chains.level[at])
        splats += int(instance.chains.count[at].sum())
    return DetailChoice(tuple(levels), splats, reason)


class RegionBounds:
    """Bounds of regions as PlayCanvas holds them: in float32, each with its excess over the median size.

    Args:
        bounds: (R, 2, 3) lowest and highest corner of each, in the space of the scene.

    Attributes:
        low, high: (R, 3) float64.
        excess: (R, 3) float64, half of each side, less half of the median side along the axis; not less than 0.
    """

    def __init__(self, bounds: Matrix) -> None:
        center, half = bounds.sum(axis=1) * 0.5, (bounds[:, 1] - bounds[:, 0]) * 0.5
        self.low = (center - half).astype(np.float32).astype(np.float64)
        self.high = (center + half).astype(np.float32).astype(np.float64)
        half32 = ((self.high - self.low) * 0.5).astype(np.float32)
        median = np.sort(half32, axis=0)[len(half32) // 2].astype(np.float64)
        self.excess = np.maximum(half32 - median, 0).astype(np.float32).astype(np.float64)

    def squared_distances(self, view: Camera, object_to_world: Matrix, rule: DetailRule) -> Distances:
        """Return (R,) squared distances by which levels are chosen, world units at a field of view of 45 degrees.

        The distance is that from the camera to the nearest point of the bound, shrunk by `rule.shrink` of its excess;
        bounds behind the camera count as farther. As `GSplatOctreeInstance.evaluateNodeDistances` of PlayCanvas.

        Args:
            object_to_world: (4, 4) where the scene stands: a rotation, a uniform scale and a translation.
        """
        # PlayCanvas holds matrices in float32.
        placed, camera = (
            matrix.astype(np.float32).astype(np.float64) for matrix in (object_to_world, view.camera_to_world)
        )
        world_to_object = np.linalg.inv(placed).astype(np.float32).astype(np.float64)
        eye = world_to_object[:3, :3] @ camera[:3, 3] + world_to_object[:3, 3]
        forward = world_to_object[:3, :3] @ -(camera[:3, 2] / np.linalg.norm(camera[:3, 2]))
        forward /= np.linalg.norm(forward)
        low, high = self.low + self.excess * rule.shrink, self.high - self.excess * rule.shrink
        offset = np.where(eye < low, low, np.where(eye > high, high, eye)) - eye
        squared: Distances = (offset**2).sum(axis=1)
        factor = np.ones(len(squared))
        ahead = offset @ forward
        behind = (squared > NO_BEHIND) & (ahead < 0)
        factor[behind] += -ahead[behind] / np.sqrt(squared[behind]) * (rule.behind_penalty - 1)
        tangent = min(math.tan(view.fov_x / 2), math.tan(view.fov_y / 2))
        scale = tangent / REFERENCE_TANGENT * float(np.linalg.norm(placed[:3, 0]))
        return squared * factor * factor * (scale * scale)


@dataclass(frozen=True, eq=False)
class DetailFiles:
    """Chunk files of a scene at several detail levels.

    Attributes:
        of_run: (R, L) int64 number of the chunk file of each region at each level; -1 for none.
        requests: for each chunk file, and last that of the environment, bytes of its meta.json and of each image.
        environment: number of the chunk file of the environment; None without.
        manifest: bytes of the manifest, which is read before any other file; 0 for a scene in memory.
    """

    of_run: NDArray[np.int64]
    requests: Sequence[tuple[int, ...]]
    environment: int | None = None
    manifest: int = 0


@dataclass(eq=False)
class LoadedDetail(LoadedScene):
    """A scene at several detail levels; `scene` and `splats` have those of all levels, then the environment."""

    fetchers = PLAYCANVAS_FETCHERS
    connections = CONNECTIONS

    detail: DetailScene = field(kw_only=True)
    files: DetailFiles = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.kind, self.chunks = STREAMED_SOG, len(self.files.requests)

    @property
    def headers(self) -> tuple[int, ...]:
        """Bytes of the manifest; none for a scene in memory."""
        return (self.files.manifest,) if self.files.manifest else ()

    @property
    def requests(self) -> Sequence[tuple[int, ...]]:
        return self.files.requests

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


def read_detail_files(path: Path) -> DetailFiles:
    """Return the files of a lod-meta.json, or of its folder; regions are in the order of the manifest."""
    with opened(path) as (source, _):
        assert source.open_companion is not None
        data = source.file.read(MAX_MANIFEST + 1)
        manifest = parse(data)
        requests = [_bytes_of_files(source.open_companion, name) for name in manifest.names()]
    layout = layout_of(manifest)
    of_run = np.full(layout.counts.shape, -1, np.int64)
    of_run[layout.region, layout.level] = layout.file
    environment = None if manifest.environment is None else len(manifest.filenames)
    return DetailFiles(of_run, requests, environment, len(data))


def _bytes_of_files(open_companion: OpenCompanion, name: str) -> tuple[int, ...]:
    """Return the bytes of each file of a chunk; () if one cannot be read, which fails when its splats are read."""
    sizes = list[int]()
    try:
        for each in files_of_chunk(open_companion, name):
            with open_companion(each) as file:
                sizes.append(size_of(file))
    except FormatError:
        return ()
    return tuple(sizes)


def files_in_memory(detail: DetailScene) -> DetailFiles:
    """Return files for a scene in memory: one for each level, of the bytes of its columns, and the environment."""
    of_run = np.where(detail.counts > 0, np.arange(detail.levels), -1)
    counts, size = detail.counts.sum(axis=0).tolist(), bytes_of(detail.splats)
    requests = [(size * count // max(1, len(detail.splats)),) for count in counts]
    if detail.environment is None:
        return DetailFiles(of_run, requests)
    return DetailFiles(of_run, [*requests, (bytes_of(detail.environment),)], detail.levels)


class PlayCanvasViewer:
    """Finds cuts of scenes at several detail levels; several threads may use it, unless it remembers.

    Args:
        fixed: splats of other scenes, which count against the budget.
        remembers: cuts are those of successive frames: while files are missing, regions stay as in the last cut;
            otherwise each cut is that of a first frame.
    """

    def __init__(
        self,
        forest: Forest,
        instances: Sequence[TreeInstance],
        rule: DetailRule,
        *,
        fixed: int = 0,
        remembers: bool = False,
    ) -> None:
        self.forest, self.instances, self._rule, self._fixed = forest, list(instances), rule, fixed
        self.remembers = remembers
        self._bounds = [RegionBounds(scene.detail.bounds) for scene in forest.scenes]
        self._chains = [Chains.of(scene.detail.counts, rule) for scene in forest.scenes]
        self._before: list[Levels | None] = [None] * len(self.instances)

    def cut(
        self, camera: Camera, *, budget: int, smallest: float = 0.0, resident: NDArray[np.bool_] | None = None
    ) -> TreeCut:
        """Return the cut that PlayCanvas draws: all regions at their levels, and the environments.

        Environments do not count against the budget, and `smallest` has no effect; see `Viewer.cut`.
        """
        start = time.perf_counter()
        forest, rule = self.forest, self._rule
        distances = [
            self._bounds[each.tree].squared_distances(camera, each.object_to_world, rule) for each in self.instances
        ]
        distant = [
            Distant(self._chains[each.tree], distance, max(LEAST_BASE_DISTANCE, rule.base_distance * each.lod_scale))
            for each, distance in zip(self.instances, distances, strict=True)
        ]
        choice = choose(distant, max(1, budget - self._fixed), rule)
        there = np.ones(forest.chunks, np.bool_) if resident is None else resident
        demand, nodes, missing = np.zeros(forest.chunks, np.float32), [], 0
        for at, (instance, levels, distance) in enumerate(zip(self.instances, choice.levels, distances, strict=True)):
            tree = instance.tree
            scene, files = forest.scenes[tree].detail, forest.scenes[tree].files
            own = slice(*forest.chunk_base[tree : tree + 2])
            before = self._before[at] if self.remembers else None
            drawn, priority = loading(self._chains[tree], files, levels, distance, there[own], before, rule.underfill)
            if self.remembers and resident is not None:
                self._before[at] = drawn
            around = files.environment is not None and bool(there[own][files.environment])
            nodes.append(_splats_of(scene, drawn, environment=around))
            wrong = (drawn != levels) & (levels >= 0)
            missing += int(scene.counts[wrong, levels[wrong]].sum())
            demand[own] = np.maximum(demand[own], np.maximum(priority, np.where(priority > 0, 1e-30, 0)))
        reason = "missing" if missing else choice.reason
        return cut_of_runs(forest, self.instances, camera, nodes, reason, missing, demand, start)


def _splats_of(scene: DetailScene, levels: Levels, *, environment: bool) -> NDArray[np.uint32]:
    """Return indices of the splats of regions at (R,) levels, ascending, and of those of the environment."""
    regions = np.flatnonzero(levels >= 0)
    starts, counts = scene.starts[regions, levels[regions]], scene.counts[regions, levels[regions]]
    order = np.argsort(starts, kind="stable")
    starts, counts = starts[order], counts[order]
    before = np.cumsum(counts) - counts
    found = np.repeat(starts - before, counts) + np.arange(int(counts.sum()))
    around = 0 if scene.environment is None or not environment else len(scene.environment)
    return np.concatenate([found, len(scene.splats) + np.arange(around)]).astype(np.uint32)


def loading(
    chains: Chains,
    files: DetailFiles,
    chosen: Levels,
    squared_distance: Distances,
    resident: NDArray[np.bool_],
    before: Levels | None,
    underfill: int,
) -> tuple[Levels, NDArray[np.float64]]:
    """Return the levels of an instance's regions that are drawn, and the files that are requested.

    Args:
        chosen: (R,) levels, -1 for a region without splats.
        before: (R,) levels of the previous frame, -1 for regions that it did not draw; None for a first frame.
        underfill: see `DetailRule`.

    Returns:
        (R,) the drawn level of each region, -1 for none; and (F,) priorities, above 0 for files that are in use or
        requested, 0 for others.
    """
    levels = files.of_run.shape[1]
    before = np.full(len(chosen), -1) if before is None else before
    desired = _desired(chains, files, chosen, resident, underfill)
    drawn = np.where(_there(files, desired, resident), desired, before)
    rank = 1 / (1 + np.maximum(squared_distance, NEAREST_SQUARED))
    priority = np.zeros(len(files.requests))

    def ask(level: Levels, tier: NDArray[np.int64] | int) -> None:
        file = _file(files, level)
        some = file >= 0
        value = tier + (level + rank) / levels
        np.maximum.at(priority, file[some], np.broadcast_to(value, file.shape)[some])

    waits = drawn != desired
    ask(desired, np.where(waits & (_file(files, drawn) >= 0), ANOTHER_LEVEL, NOTHING_DRAWN))
    ask(drawn, NOTHING_DRAWN)
    ask(np.where(desired == chosen, chosen, _finer(chains, desired)), NEXT)
    if files.environment is not None:
        priority[files.environment] = ENVIRONMENT
    return drawn, priority


def _desired(chains: Chains, files: DetailFiles, chosen: Levels, resident: NDArray[np.bool_], underfill: int) -> Levels:
    """Return the (R,) chosen levels; while its file is missing, one at most `underfill` levels coarser instead.

    That is the finest whose file is resident, or else the coarsest that has a file.
    """
    found, coarsest, level, rows = chosen.copy(), chosen.copy(), chosen.copy(), np.arange(len(chosen))
    open_ = (chosen >= 0) & ~_there(files, chosen, resident)
    waiting = open_.copy()
    for _ in range(min(underfill, chains.level.shape[1])):
        above = (chains.level > level[:, None]) & (level >= 0)[:, None]  # the next coarser levels, or none
        level = np.where(above.any(axis=1), chains.level[rows, np.argmax(above, axis=1)], -1)
        waiting &= level >= 0
        if not waiting.any():
            break
        coarsest = np.where(waiting & (_file(files, level) >= 0), level, coarsest)
        now = open_ & waiting & _there(files, level, resident)
        found = np.where(now, level, found)
        open_ &= ~now
    return np.where(open_, coarsest, found)


def _there(files: DetailFiles, level: Levels, resident: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (R,) bool, whether the file of each region at a level is resident, or there is none."""
    file = _file(files, level)
    return (file < 0) | resident[file]


def _file(files: DetailFiles, level: Levels) -> NDArray[np.int64]:
    """Return the (R,) numbers of the files of regions at (R,) levels; -1 for none."""
    return np.where(level >= 0, files.of_run[np.arange(len(level)), level], -1)


def _finer(chains: Chains, level: Levels) -> Levels:
    """Return for each of R chains the next finer level than a given one, (R,) `level`; -1 if there is none."""
    below = (chains.level < level[:, None]) & (chains.level >= 0)
    last = below.shape[1] - 1 - np.argmax(below[:, ::-1], axis=1)
    return np.where(below.any(axis=1), chains.level[np.arange(len(level)), last], -1)
