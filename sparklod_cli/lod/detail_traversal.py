"""Cuts of scenes at several detail levels: what a viewer of Streamed SOG shows, also while chunk files load.

A region is drawn at the level that is chosen for it as soon as the file of that level is there, and until then as it
was. PlayCanvas 2.23 does so in `GSplatOctreeInstance.applyLodChanges`; priorities are those of its `requestFile`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import Splats
from ..model.traversed import DetailScene
from .detail_choice import Chains, Distances, Distant, Levels, RegionBounds, choose
from .settings import LEAST_BASE_DISTANCE, DetailRule
from .traversal import CutView, SplatForest, TreeCut, TreeInstance, views_of

#: Priorities of files, whole numbers: for regions of which nothing is drawn, for those at another level, and for what
#: comes next. The environment is asked for before all others.
ENVIRONMENT, NOTHING_DRAWN, ANOTHER_LEVEL, NEXT = 4, 2, 1, 0


class DetailForest(SplatForest):
    """Scenes at several detail levels in the memory layout of traversals; see `SplatForest`.

    Splats of level 0 and of the environment count as leaves. Chunks are chunk files.

    Args:
        scenes: at least one.
        splats: of each, those of all levels, then of the environment.
        files: of each, where its splats are.
    """

    def __init__(self, scenes: Sequence[DetailScene], splats: Sequence[Splats], files: Sequence[DetailFiles]) -> None:
        self.scenes, self.files = scenes, files
        coarse = [np.zeros(len(each), np.bool_) for each in splats]
        for scene, mask in zip(scenes, coarse, strict=True):
            mask[scene.level(0).stop : len(scene.splats)] = True
        super().__init__(splats, coarse, [len(each.sizes) for each in files])


class DetailTraversal:
    """Finds cuts of scenes at several detail levels; several threads may ask it, unless it remembers.

    Args:
        fixed: splats that are drawn besides, and count against the budget.
        remembers: while files are missing, regions stay as the cut before had them; without, nothing was drawn before.
    """

    def __init__(
        self,
        forest: DetailForest,
        instances: Sequence[TreeInstance],
        rule: DetailRule,
        *,
        fixed: int = 0,
        remembers: bool = False,
    ) -> None:
        self.forest, self.instances, self._rule, self._fixed = forest, list(instances), rule, fixed
        self.remembers = remembers
        self._bounds = [RegionBounds(scene.bounds) for scene in forest.scenes]
        self._chains = [Chains.of(scene.counts, rule) for scene in forest.scenes]
        self._before: list[Levels | None] = [None] * len(self.instances)

    def cut(
        self, view: CutView, *, budget: int, smallest: float = 0.0, resident: NDArray[np.bool_] | None = None
    ) -> TreeCut:
        """Return the cut that a viewer draws: the splats of the levels of all regions, and the environments.

        Args:
            budget: maximum number of splats, all instances together; those of environments do not count.
            smallest: has no meaning here; traversals of trees have it.
            resident: (chunks,) bool, which chunk files of all scenes are there; all are unless given.
        """
        start = time.perf_counter()
        forest, rule = self.forest, self._rule
        distances = [
            self._bounds[each.tree].squared_distances(view, each.object_to_world, rule) for each in self.instances
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
            scene, files, own = forest.scenes[tree], forest.files[tree], slice(*forest.chunk_base[tree : tree + 2])
            before = self._before[at] if self.remembers else None
            drawn, priority = loading(self._chains[tree], files, levels, distance, there[own], before, rule.underfill)
            if self.remembers and resident is not None:
                self._before[at] = drawn
            around = files.environment is not None and bool(there[own][files.environment])
            nodes.append(_splats_of(scene, drawn, environment=around))
            wrong = (drawn != levels) & (levels >= 0)
            missing += int(scene.counts[wrong, levels[wrong]].sum())
            demand[own] = np.maximum(demand[own], np.maximum(priority, np.where(priority > 0, 1e-30, 0)))
        return TreeCut(
            views=views_of(forest, self.instances, view),
            node=np.concatenate(nodes),
            instance=np.repeat(np.arange(len(nodes), dtype=np.uint16), [len(each) for each in nodes]),
            limit=np.full(sum(map(len, nodes)), -1, np.float32),
            reason="missing" if missing else choice.reason,
            missing=missing,
            least=np.inf,
            stop=None,
            demand=demand,
            seconds=time.perf_counter() - start,
        )


def _splats_of(scene: DetailScene, levels: Levels, *, environment: bool) -> NDArray[np.uint32]:
    """Return the splats of regions at some levels, ascending, and those of the environment."""
    regions = np.flatnonzero(levels >= 0)
    starts, counts = scene.starts[regions, levels[regions]], scene.counts[regions, levels[regions]]
    order = np.argsort(starts, kind="stable")
    starts, counts = starts[order], counts[order]
    before = np.cumsum(counts) - counts
    found = np.repeat(starts - before, counts) + np.arange(int(counts.sum()))
    around = 0 if scene.environment is None or not environment else len(scene.environment)
    return np.concatenate([found, len(scene.splats) + np.arange(around)]).astype(np.uint32)


@dataclass(frozen=True, eq=False)
class DetailFiles:
    """Chunk files of a scene at several detail levels.

    Attributes:
        of_run: (R, L) int64 number of the chunk file of each run; -1 where there is no run.
        sizes: (F,) int64 bytes of the chunk files, then of that of the environment where there is one.
        requests: for each, bytes of the answers to a viewer: of its meta.json, then of each of its images; empty where
            there are no files.
        environment: number of the chunk file of the environment; None without.
        manifest: bytes of the manifest, which is read before any other file.
    """

    of_run: NDArray[np.int64]
    sizes: NDArray[np.int64]
    environment: int | None = None
    manifest: int = 0
    requests: tuple[tuple[int, ...], ...] = ()


def loading(
    chains: Chains,
    files: DetailFiles,
    chosen: Levels,
    squared_distance: Distances,
    resident: NDArray[np.bool_],
    before: Levels | None,
    underfill: int,
) -> tuple[Levels, NDArray[np.float64]]:
    """Return what is drawn of the regions of an instance, and what is asked for.

    Args:
        chosen: (R,) the level that is chosen for each region; -1 for one without splats.
        squared_distance: (R,) by which it was chosen.
        resident: (F,) which files are there.
        before: (R,) what was drawn before, -1 where nothing was; None for nothing at all.
        underfill: levels by which a region may be coarser as long as a file is missing; see `DetailRule`.

    Returns:
        (R,) the drawn level of each region, -1 where nothing is; and (F,) priorities of the files that are in use or
        asked for, above 0, and 0 for others.
    """
    levels = files.of_run.shape[1]
    before = np.full(len(chosen), -1) if before is None else before
    desired = _desired(chains, files, chosen, resident, underfill)
    drawn = np.where(_there(files, desired, resident), desired, before)
    rank = 1 / (1 + np.maximum(squared_distance, 1e-12))
    priority = np.zeros(len(files.sizes))

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
    """Return the (R,) chosen level, or while its file is missing one that is at most `underfill` levels coarser.

    That is the finest whose file is there, and where none is, the coarsest that has a file.
    """
    found, coarsest, level = chosen.copy(), chosen.copy(), chosen.copy()
    open_ = (chosen >= 0) & ~_there(files, chosen, resident)
    waiting = open_.copy()
    for _ in range(min(underfill, chains.level.shape[1])):
        level = _coarser(chains, level)
        waiting &= level >= 0
        if not waiting.any():
            break
        coarsest = np.where(waiting & (_file(files, level) >= 0), level, coarsest)
        now = open_ & waiting & _there(files, level, resident)
        found = np.where(now, level, found)
        open_ &= ~now
    return np.where(open_, coarsest, found)


def _there(files: DetailFiles, level: Levels, resident: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a (R,) mask of regions that can be drawn at some levels: nothing is missing."""
    file = _file(files, level)
    there: NDArray[np.bool_] = (file < 0) | resident[file]
    return there


def _file(files: DetailFiles, level: Levels) -> NDArray[np.int64]:
    """Return the (R,) files of regions at some levels; -1 for none."""
    rows = np.arange(len(level))
    file: NDArray[np.int64] = np.where(level >= 0, files.of_run[rows, level], -1)
    return file


def _coarser(chains: Chains, level: Levels) -> Levels:
    """Return the (R,) next coarser levels of chains; -1 where there is none."""
    above = (chains.level > level[:, None]) & (level >= 0)[:, None]
    first = np.argmax(above, axis=1)
    return np.where(above.any(axis=1), chains.level[np.arange(len(level)), first], -1)


def _finer(chains: Chains, level: Levels) -> Levels:
    """Return the (R,) next finer levels of chains; -1 where there is none."""
    below = (chains.level < level[:, None]) & (chains.level >= 0)
    last = below.shape[1] - 1 - np.argmax(below[:, ::-1], axis=1)
    return np.where(below.any(axis=1), chains.level[np.arange(len(level)), last], -1)
