"""Divisions of a scene into blocks anywhere, and joins of any of them."""

from __future__ import annotations

import dataclasses
import random
from dataclasses import dataclass

import numpy as np

from sparklod_cli.lod.stages import Pending, Region, StagedBuilder, check
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import Splats
from tests.lod.assembled import EVERYWHERE, Stages, assemble


@dataclass(frozen=True)
class Division:
    """A region, and the parts that fill it; a block if there are none.

    Attributes:
        region: of the scene.
        parts: each is a stage; the stage of this division joins what they leave.
    """

    region: Region = EVERYWHERE
    parts: tuple[Division, ...] = ()

    def cut(self, axis: int, at: float) -> Division:
        """This region, in two parts below and from a coordinate on, or as it is if that lies outside."""
        low, high = list(self.region.low), list(self.region.high)
        if not low[axis] < at < high[axis]:
            return self
        low[axis] = high[axis] = at
        below, above = Region(self.region.low, tuple(high)), Region(tuple(low), self.region.high)
        return dataclasses.replace(self, parts=(Division(below), Division(above)))


def random_division(rng: random.Random, centers: np.ndarray, base: float, depth: int = 3) -> Division:
    """Faces through splats, on borders of cells, or elsewhere; joins of 2 to 8; so many levels of joins at most."""
    return _divided(rng, Division(), centers, base, depth)


def _divided(rng: random.Random, whole: Division, centers: np.ndarray, base: float, depth: int) -> Division:
    if depth == 0 or rng.random() < 0.2:
        return whole
    parts = [whole]
    for _ in range(rng.randint(1, 3)):
        axis = rng.randrange(3)
        through = float(centers[rng.randrange(len(centers)), axis])
        border = rng.randint(-3, 4) * base ** rng.randint(-12, 6)
        at = rng.choice([through, through, border, float(centers[:, axis].mean())])
        parts = [half for part in parts for half in part.cut(axis, at).parts or (part,)]
    if len(parts) == 1:
        return whole
    below = tuple(_divided(rng, part, centers, base, depth - 1) for part in parts)
    return dataclasses.replace(whole, parts=below)


def build_divided(
    builder: StagedBuilder, splats: Splats, setting: float, division: Division
) -> tuple[Splats, LodTree, Stages]:
    """As `assembled.run_stages`, with these blocks and joins."""
    stages = Stages(builder, builder.plan(check(splats), splats, setting))

    def run(here: Division, region: Region | None) -> Pending:
        if here.parts:
            return stages.advance(Pending.concat([run(part, part.region) for part in here.parts]), region)
        low, high = np.array(here.region.low), np.array(here.region.high)
        index = np.flatnonzero(((splats.center >= low) & (splats.center < high)).all(axis=1))
        return stages.advance(stages.builder.leaves(splats.take(index), index, stages.plan), region)

    left = run(division, None)
    assert len(left) == 1
    return *assemble(stages.families, left.splats, int(left.columns["family"][0])), stages
