"""Cuts of scenes at several detail levels: the splats of the levels that a viewer shows of their regions."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import spark_size
from ..model.scene import DetailScene
from ..model.splats import Splats
from .detail_choice import Chains, Distant, Levels, choose
from .detail_distance import RegionBounds
from .detail_loading import DetailFiles, Loading, loading
from .detail_rule import LEAST_BASE_DISTANCE, DetailRule
from .kernels import pixel_scale
from .traversal import Forest, TreeCut, TreeInstance, View, views_of


class DetailForest(Forest):
    """Scenes at several detail levels in the memory layout of traversals, so that statistics of cuts are of them, too.

    Every splat is a node. Those of level 0 and of the environment have no children, so that they count as leaves.
    Chunks are chunk files.

    Args:
        scenes: at least one.
        splats: of each, those of all levels, then of the environment.
        files: of each, where its splats are.
    """

    def __init__(self, scenes: Sequence[DetailScene], splats: Sequence[Splats], files: Sequence[DetailFiles]) -> None:
        self.scenes, self.files, self._splats = scenes, files, splats
        self.node_base = np.cumsum([0, *map(len, splats)]).astype(np.int64)
        self.chunk_base = np.cumsum([0, *(len(each.sizes) for each in files)]).astype(np.int64)

    @functools.cached_property
    def nodes(self) -> NDArray[np.void]:  # type: ignore[override]  # made when the first statistics are asked for
        """(N,) `pixel_scale.NODE` of all scenes."""
        nodes = np.zeros(int(self.node_base[-1]), pixel_scale.NODE)
        for scene, splats, start in zip(self.scenes, self._splats, self.node_base.tolist(), strict=False):
            part = nodes[start : start + len(splats)]
            part["x"], part["y"], part["z"] = splats.center.T
            part["size"] = spark_size(splats)
            part["child_count"][scene.level(0).stop : len(scene.splats)] = 1
        return nodes


class DetailTraversal:
    """Finds cuts of scenes at several detail levels; several threads may ask it, unless it remembers.

    Args:
        forest: the scenes.
        instances: of them.
        rule: how levels are chosen.
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
        self,
        view: View,
        *,
        budget: int,
        smallest: float = 0.0,
        resident: NDArray[np.bool_] | None = None,
        threads: int = 1,
    ) -> TreeCut:
        """The cut that a viewer draws: the splats of the levels of all regions, and the environments.

        Args:
            view: the camera.
            budget: maximum number of splats, all instances together; those of environments do not count.
            smallest, threads: have no meaning here; traversals of trees have them.
            resident: (chunks,) bool, which chunk files of all scenes are there; all are unless given.
        """
        start = time.perf_counter()
        rule = self._rule
        distances = [
            self._bounds[each.tree].squared_distances(view, each.object_to_world, rule) for each in self.instances
        ]
        distant = [
            Distant(self._chains[each.tree], distance, max(LEAST_BASE_DISTANCE, rule.base_distance * each.lod_scale))
            for each, distance in zip(self.instances, distances, strict=True)
        ]
        choice = choose(distant, max(1, budget - self._fixed), rule)
        everything = np.ones(self.forest.chunks, np.bool_)
        there = everything if resident is None else resident
        states = [
            self._loading(at, chosen, distance, there)
            for at, (chosen, distance) in enumerate(zip(choice.levels, distances, strict=True))
        ]
        if self.remembers and resident is not None:
            self._before = [state.drawn for state in states]
        return self._found(view, choice.levels, states, there, choice.reason, start)

    def _loading(
        self, at: int, chosen: Levels, squared_distance: NDArray[np.float64], resident: NDArray[np.bool_]
    ) -> Loading:
        tree = self.instances[at].tree
        files = self.forest.files[tree]
        first = int(self.forest.chunk_base[tree])
        return loading(
            self._chains[tree],
            files,
            chosen,
            squared_distance,
            resident[first : first + len(files.sizes)],
            self._before[at] if self.remembers else None,
            self._rule.underfill,
        )

    def _found(
        self,
        view: View,
        chosen: Sequence[Levels],
        states: Sequence[Loading],
        resident: NDArray[np.bool_],
        reason: str,
        start: float,
    ) -> TreeCut:
        forest, nodes, missing = self.forest, [], 0
        wanted = np.zeros(forest.chunks, np.float32)
        for instance, levels, state in zip(self.instances, chosen, states, strict=True):
            scene, files = forest.scenes[instance.tree], forest.files[instance.tree]
            own = slice(*forest.chunk_base[instance.tree : instance.tree + 2].tolist())
            around = files.environment is not None and bool(resident[own][files.environment])
            nodes.append(_splats_of(scene, state.drawn, environment=around))
            wrong = (state.drawn != levels) & (levels >= 0)
            missing += int(scene.counts[wrong, levels[wrong]].sum())
            wanted[own] = np.maximum(wanted[own], np.maximum(state.priority, np.where(state.priority > 0, 1e-30, 0)))
        return TreeCut(
            views=views_of(forest, self.instances, view),
            node=np.concatenate(nodes),
            instance=np.repeat(np.arange(len(nodes), dtype=np.uint16), [len(each) for each in nodes]),
            limit=np.full(sum(map(len, nodes)), -1, np.float32),
            reason="missing" if missing else reason,
            missing=missing,
            least=np.inf,
            stop=None,
            wanted=wanted,
            seconds=time.perf_counter() - start,
        )


def _splats_of(scene: DetailScene, levels: Levels, *, environment: bool) -> NDArray[np.uint32]:
    """The splats of regions at some levels, ascending, and those of the environment."""
    regions = np.flatnonzero(levels >= 0)
    starts, counts = scene.starts[regions, levels[regions]], scene.counts[regions, levels[regions]]
    order = np.argsort(starts, kind="stable")
    starts, counts = starts[order], counts[order]
    before = np.cumsum(counts) - counts
    found = np.repeat(starts - before, counts) + np.arange(int(counts.sum()))
    around = 0 if scene.environment is None or not environment else len(scene.environment)
    return np.concatenate([found, len(scene.splats) + np.arange(around)]).astype(np.uint32)
