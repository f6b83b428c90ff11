"""Builds a tree in stages, all of them in memory, and puts the families of its stages together."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sparklod_cli.lod.stages import NO_FAMILY, STAGE_BITS, Pending, Region, StagedBuilder, StageFamilies, check
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.progress import silent

#: Parts of a region along x, y and z, from the whole scene down to the regions of blocks.
Splits = Sequence[tuple[int, int, int]]

EVERYWHERE = Region((-np.inf,) * 3, (np.inf,) * 3)


@dataclass
class Stages:
    """The stages of one build as they run; children before what joins them.

    Attributes:
        builder: of the tree.
        plan: of the builder.
        families: of each stage, by its number.
        pending: number of nodes that each stage handed on.
    """

    builder: StagedBuilder
    plan: Any
    families: list[StageFamilies] = field(default_factory=list)
    pending: list[int] = field(default_factory=list)

    def advance(self, pending: Pending, region: Region | None) -> Pending:
        """Runs a stage."""
        families, rest = self.builder.advance(pending, region, len(self.families), self.plan, progress=silent)
        self.families.append(families)
        self.pending.append(len(rest))
        return rest

    def run(self, splats: Splats, index: np.ndarray, region: Region, splits: Splits, *, is_root: bool) -> Pending:
        """Runs the stages of a region, and returns what is left of it."""
        here = None if is_root else region
        if not splits:
            return self.advance(self.builder.leaves(splats.take(index), index, self.plan), here)
        parts = [
            self.run(splats, part, inside, splits[1:], is_root=False)
            for part, inside in split(splats, index, region, splits[0])
        ]
        return self.advance(Pending.concat(parts), here)


def split(
    splats: Splats, index: np.ndarray, region: Region, parts: tuple[int, int, int]
) -> list[tuple[np.ndarray, Region]]:
    """Parts of a region with about as many splats each, along x, then y, then z; some may be empty."""
    pieces = [(index, region)]
    for axis, count in enumerate(parts):
        pieces = [piece for whole in pieces for piece in _split_along(splats, *whole, axis, count)]
    return pieces


def _split_along(
    splats: Splats, index: np.ndarray, region: Region, axis: int, count: int
) -> list[tuple[np.ndarray, Region]]:
    place = splats.center[index, axis]
    inner = [float(np.sort(place)[len(place) * k // count]) if len(place) else 0.0 for k in range(1, count)]
    faces = [region.low[axis], *np.clip(inner, region.low[axis], region.high[axis]).tolist(), region.high[axis]]
    pieces = []
    for low, high in itertools.pairwise(faces):
        corners = [list(region.low), list(region.high)]
        corners[0][axis], corners[1][axis] = low, high
        inside = index[(place >= low) & (place < high)]
        pieces.append((inside, Region(*(tuple(corner) for corner in corners))))
    return pieces


def build_in_stages(
    builder: StagedBuilder, splats: Splats, setting: float, splits: Splits, *, step: int = 1
) -> tuple[Splats, LodTree]:
    """Builds a tree, with a block for each of the smallest regions.

    Args:
        builder: module of a builder.
        splats: valid and visible ones.
        setting: of the builder.
        splits: of the scene; none for a single stage.
        step: the plan's sample is every so many splats.
    """
    nodes, tree, _ = run_stages(builder, splats, setting, splits, step=step)
    return nodes, tree


def run_stages(
    builder: StagedBuilder, splats: Splats, setting: float, splits: Splits, *, step: int = 1
) -> tuple[Splats, LodTree, Stages]:
    """As `build_in_stages`, and the stages themselves."""
    stages = Stages(builder, builder.plan(check(splats), splats.take(slice(None, None, step)), setting))
    left = stages.run(splats, np.arange(len(splats)), EVERYWHERE, splits, is_root=True)
    assert len(left) == 1
    return *assemble(stages.families, left.splats, int(left.columns["family"][0])), stages


def assemble(families: Sequence[StageFamilies], root: Splats, family: int) -> tuple[Splats, LodTree]:
    """The root, then all families by batch and then by key; where both are equal, by stage and then by place.

    Args:
        families: of each stage, by its number.
        root: the root, one splat.
        family: the number of its family.
    """
    stage = np.repeat(np.arange(len(families)), [len(one) for one in families])
    batch = np.concatenate([one.batch for one in families])
    words = max(one.key.shape[1] for one in families)
    key = np.concatenate([np.pad(one.key, ((0, 0), (words - one.key.shape[1], 0))) for one in families])
    order = np.lexsort((*key.T[::-1], batch))
    count = np.concatenate([one.count for one in families]).astype(np.int64)
    start = np.empty(len(count), np.int64)  # place of a family's first child in the tree
    start[order] = 1 + np.cumsum(count[order]) - count[order]
    first = np.cumsum(count) - count  # and among the nodes of all stages
    gather = np.repeat(first[order], count[order]) + np.arange(count.sum()) - np.repeat(start[order] - 1, count[order])
    nodes = Splats.concat([root, Splats.concat([one.nodes for one in families]).take(gather)])
    of_node = np.concatenate([[family], np.concatenate([one.family for one in families])[gather]])
    begin = np.searchsorted(stage, np.arange(len(families)))
    tree = LodTree(np.zeros(len(nodes), np.uint16), np.zeros(len(nodes), np.uint32))
    inner = np.flatnonzero(of_node != NO_FAMILY)
    at = begin[of_node[inner] >> STAGE_BITS] + (of_node[inner] & ((1 << STAGE_BITS) - 1))
    tree.child_count[inner], tree.child_start[inner] = count[at], start[at]
    return nodes, tree


def check_families(families: StageFamilies, stage: int) -> None:
    """What holds for the families of every stage."""
    assert (np.diff(families.batch) >= 0).all()
    assert (families.count >= 1).all()
    assert families.count.sum(dtype=np.int64) == len(families.nodes) == len(families.family)
    own = families.family[families.family >> STAGE_BITS == stage] & ((1 << STAGE_BITS) - 1)
    assert (own < len(families)).all()
    same = np.diff(families.batch) == 0
    keys = [tuple(row) for row in families.key.tolist()]
    assert all(a <= b for (a, b), tied in zip(itertools.pairwise(keys), same, strict=True) if tied)
    assert families.nodes.is_valid().all()
