"""Builds in stages, of small scenes: any division into blocks, any joins, and a tree of the families."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sparklod_cli.lod.stages.records import NO_FAMILY, STAGE_BITS, Families, Pending, Region, StagedBuilder, Survey
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import Splats
from sparklod_cli.support.progress import silent

EVERYWHERE = Region((-math.inf,) * 3, (math.inf,) * 3)


@dataclass(frozen=True)
class Division:
    """A region, and how it is divided: a stage of its own joins what the stages of its parts leave.

    Attributes:
        region: of the scene.
        parts: whose regions fill it; none for a block.
    """

    region: Region
    parts: tuple[Division, ...] = ()


def split(region: Region, axis: int, at: float) -> tuple[Region, Region]:
    """The two parts of a region below and from a coordinate on."""
    low, high = list(region.low), list(region.high)
    low[axis] = high[axis] = at
    return Region(region.low, tuple(high)), Region(tuple(low), region.high)


def halves(region: Region, centers: np.ndarray, times: int) -> list[Region]:
    """A region divided at medians, again and again."""
    if not times:
        return [region]
    inside = centers[within(centers, region)]
    axis = int(np.argmax(np.ptp(inside, axis=0)))
    return [
        part
        for half in split(region, axis, float(np.median(inside[:, axis])))
        for part in halves(half, inside, times - 1)
    ]


def within(centers: np.ndarray, region: Region) -> np.ndarray:
    """Which centres a region has."""
    return ((centers >= np.array(region.low)) & (centers < np.array(region.high))).all(axis=1)


def survey_of(splats: Splats) -> Survey:
    """What is known of all splats."""
    low, high = (tuple(map(float, corner)) for corner in (splats.center.min(axis=0), splats.center.max(axis=0)))
    size = 2 * splats.scale.max(axis=1).astype(np.float64)
    sample = splats.take(slice(None, None, 3))
    return Survey(len(splats), splats.sh_degree, low, high, float(size.min()), float(size.max()), sample)


@dataclass(frozen=True)
class Staged:
    """What the stages made.

    Attributes:
        families: of each stage, by its number.
        handed_on: the number of nodes that each stage but the last left without a parent, and of those that it had.
        root: the node that is left, and the number of its family.
    """

    families: list[Families]
    handed_on: list[tuple[int, int]]
    root: tuple[Splats, int]


def build_in_stages(builder: StagedBuilder, splats: Splats, setting: float, division: Division) -> Staged:
    """All stages, one after the other; that of the whole scene comes last."""
    plan = builder.plan(survey_of(splats), setting)
    families: list[Families] = []
    handed_on: list[tuple[int, int]] = []

    def run(here: Division, region: Region | None) -> Pending:
        if here.parts:
            pending = Pending.concat([run(part, part.region) for part in here.parts])
        else:
            index = np.flatnonzero(within(splats.center, here.region))
            pending = builder.leaves(splats.take(index), index, plan)
        before = len(pending)
        made, left = builder.advance(pending, region, len(families), plan, progress=silent)
        families.append(made)
        handed_on.append((len(left), before))
        return left

    return Staged(families, handed_on, builder.root(run(division, None)))


def assembled(staged: Staged) -> tuple[Splats, LodTree]:
    """The root and the families of all stages, by batch and key."""
    numbers = np.concatenate(
        [(np.int64(stage) << STAGE_BITS) + np.arange(len(part)) for stage, part in enumerate(staged.families)]
    )
    batch, key, count = (
        np.concatenate([getattr(part, name) for part in staged.families]) for name in ("batch", "key", "count")
    )
    order = np.lexsort([*key.T[::-1], batch])
    starts = np.cumsum(count[order], dtype=np.int64) - count[order] + 1
    start_of = dict(zip(numbers[order].tolist(), starts.tolist(), strict=True))
    count_of = dict(zip(numbers.tolist(), count.tolist(), strict=True))
    before = np.cumsum(count, dtype=np.int64) - count
    rows = np.concatenate([np.arange(before[f], before[f] + count[f]) for f in order] + [np.empty(0, np.int64)])
    rows = rows.astype(np.int64)
    root, family_of_root = staged.root
    nodes = Splats.concat([root, Splats.concat([part.nodes for part in staged.families]).take(rows)])
    family = np.concatenate([[family_of_root], np.concatenate([part.family for part in staged.families])[rows]])
    children = [(count_of[f], start_of[f]) if f != NO_FAMILY else (0, 0) for f in family.tolist()]
    child_count, child_start = np.array(children).T
    return nodes, LodTree(child_count.astype(np.uint16), child_start.astype(np.uint32))
