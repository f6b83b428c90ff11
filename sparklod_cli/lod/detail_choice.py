"""The detail level of each region that a viewer of Streamed SOG shows, under a budget of splats.

This is the rule of PlayCanvas 2.23 (`GSplatLodTable` and `GSplatBudgetBalancer`), bin by bin. Every region has a chain
of levels, from the finest to the coarsest one that is allowed. A step of a chain has a position: the logarithm of the
region's distance over the one at which the step is due. One threshold for all regions decides which steps are taken:
those at or above it. It is as high as the budget allows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .settings import DetailRule

if TYPE_CHECKING:
    from .traversal import CutView

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


@dataclass(frozen=True, eq=False)
class Chains:
    """The levels of regions from the finest to the coarsest that may be shown, with what each shows.

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
    """An instance of regions, as far as their levels depend on a camera.

    Attributes:
        squared_distance: (R,) of `RegionBounds.squared_distances`.
        base_distance: `DetailRule.base_distance`, of this instance.
    """

    chains: Chains
    squared_distance: Distances
    base_distance: float = DetailRule.base_distance


@dataclass(frozen=True, eq=False)
class DetailChoice:
    """The levels that a viewer shows.

    Attributes:
        levels: for each instance (R,) the level of each region; -1 for a region without splats. A level at which a
            region has no splats shows nothing of it.
        splats: how many they are, all together; more than the budget only where the coarsest levels are.
        reason: why no level is finer: "budget", "distance" (none is due to be) or "exhausted" (all are the finest).
    """

    levels: tuple[Levels, ...]
    splats: int
    reason: str


def choose(instances: Sequence[Distant], budget: int, rule: DetailRule) -> DetailChoice:
    """Return the levels that a viewer shows of some instances, all within one budget.

    Args:
        instances: at least one.
        budget: maximum number of splats, all instances together.
    """
    limit = rule.mode == "limit"
    coarsest = sum(int(each.chains.count[:, -1].sum()) for each in instances)
    finest = sum(int(each.chains.count[:, 0].sum()) for each in instances)
    if coarsest >= budget:
        return _chosen(instances, [np.full(len(each.chains.level), -1) for each in instances], "budget")
    if not limit and finest <= budget:
        return _chosen(instances, [np.zeros(len(each.chains.level), np.int64) for each in instances], "exhausted")
    keys = [_keys(_positions(each, rule)) for each in instances]
    if limit:
        due = [(key >= DUE * PARTS).sum(axis=1) for key in keys]
        chosen = _chosen(instances, due, "distance")
        if chosen.splats <= budget:
            return chosen if any(places.any() for places in due) else replace(chosen, reason="exhausted")
    threshold = _threshold(instances, keys, budget - coarsest, DUE if limit else BINS)
    return _chosen(instances, [(key >= threshold).sum(axis=1) for key in keys], "budget")


def _positions(instance: Distant, rule: DetailRule) -> Distances:
    """Return the (R, S - 1) positions of the steps of each region, in bins, descending."""
    chains, step = instance.chains, math.log(rule.multiplier) * PER_LOG
    zero = (-math.log(instance.base_distance) - LOWEST) * PER_LOG - (chains.finest - 1) * step
    distance = np.log(np.maximum(instance.squared_distance, NEAREST_SQUARED)) * (PER_LOG * 0.5) + zero
    positions: Distances = distance[:, None] - np.arange(1, chains.level.shape[1]) * step
    return positions


def _keys(positions: Distances) -> Levels:
    """Return positions as whole numbers of parts, in their order."""
    bins = np.clip(positions, 0, BINS - 1).astype(np.int64)
    parts = np.clip((positions - bins) * PARTS, 0, PARTS - 1).astype(np.int64)
    return bins * PARTS + parts


def _threshold(instances: Sequence[Distant], keys: Sequence[Levels], room: int, bins: int) -> int:
    """Return the least key of a step that is taken: the highest at which the budget suffices, to a part.

    Args:
        keys: for each instance (R, S - 1).
        room: splats by which all regions together may exceed their coarsest levels.
        bins: how many bins the threshold may be above.
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
    """Return the first bin whose splats, with those of all before it, exceed the room; and the room before it."""
    added = np.cumsum(np.bincount(number, saved, minlength=count)[:count])
    over = np.flatnonzero(added > room)
    first = int(over[0]) if len(over) else count
    return first, room - (int(added[first - 1]) if first else 0)


def _chosen(instances: Sequence[Distant], places: Sequence[Levels], reason: str) -> DetailChoice:
    levels, splats = [], 0
    for instance, place in zip(instances, places, strict=True):
        rows = np.arange(len(place))
        levels.append(instance.chains.level[rows, place])
        splats += int(instance.chains.count[rows, place].sum())
    return DetailChoice(tuple(levels), splats, reason)


class RegionBounds:
    """Bounds of regions as PlayCanvas holds them: in float32, each with what it has more than the median.

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

    def squared_distances(self, view: CutView, object_to_world: Matrix, rule: DetailRule) -> Distances:
        """Return (R,) squared distances by which levels are chosen, world units at a field of view of 45 degrees.

        The distance is that from the camera to the nearest point of the bound, shrunk by `rule.shrink` of its excess;
        what lies behind the camera counts as farther. As `GSplatOctreeInstance.evaluateNodeDistances` of PlayCanvas.

        Args:
            object_to_world: (4, 4) where the scene stands: a rotation, a uniform scale and a translation.
        """
        # PlayCanvas holds matrices in float32.
        placed, camera = (
            matrix.astype(np.float32).astype(np.float64) for matrix in (object_to_world, view.camera_to_world)
        )
        world_to_object = np.linalg.inv(placed).astype(np.float32).astype(np.float64)
        eye = world_to_object[:3, :3] @ camera[:3, 3] + world_to_object[:3, 3]
        forward = world_to_object[:3, :3] @ -_unit(camera[:3, 2])
        forward = _unit(forward)
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


def _unit(vector: Matrix) -> Matrix:
    unit: Matrix = vector / np.linalg.norm(vector)
    return unit
