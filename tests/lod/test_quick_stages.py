"""Laws of the quick builder in stages: the tree is that of the builder in memory, whatever the blocks."""

from __future__ import annotations

import dataclasses
import pickle
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.lod import quick
from sparklod_cli.lod.stages import Region
from sparklod_cli.lod.stages import check as check_input
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.splats import COLUMNS, Splats
from tests.lod.assembled import check_families, run_stages
from tests.lod.divisions import Division, build_divided, random_division
from tests.lod.trees import coincident, hard_cases
from tests.scenes import random_splats


def check(splats: Splats, base: float, division: Division) -> None:
    """The tree in stages is the tree in memory, bit for bit."""
    nodes, tree, stages = build_divided(quick, splats, base, division)
    expected, expected_tree = quick.build(splats, base)
    same = [
        tree.child_count.tobytes() == expected_tree.child_count.tobytes(),
        tree.child_start.tobytes() == expected_tree.child_start.tobytes(),
        *(getattr(nodes, name).tobytes() == getattr(expected, name).tobytes() for name in COLUMNS),
    ]
    assert all(same), same
    for stage, families in enumerate(stages.families):
        check_families(families, stage)


def scene(rng: random.Random) -> Splats:
    """Clusters, copies in one point, huge and tiny splats, far from the origin or across it, on a raster or not."""
    count = rng.randint(1, rng.choice([4, 40, 300]))
    splats = random_splats(count, sh_degree=rng.choice([0, 0, 1]), seed=rng.getrandbits(32))
    some = np.array(rng.choices(range(count), k=count // 2 + 1))
    center = splats.center * np.float32(rng.choice([1e-3, 1.0, 1e3]))
    scale = splats.scale * np.float32(rng.choice([0.1, 1.0, 30.0]))
    if rng.random() < 0.4:
        center += np.float32([rng.choice([-1e5, -3.0, 7.0, 1e7]) for _ in range(3)])
    if rng.random() < 0.4:
        center = np.rint(center * 4) / 4
    if rng.random() < 0.4:
        center[some] = center[0]
    if rng.random() < 0.4:
        scale[some[:3]] *= np.float32(rng.choice([1e-6, 100.0, 1e6]))
    return dataclasses.replace(splats, center=center.astype(np.float32), scale=scale.astype(np.float32))


@given(st.integers(0, 2**32 - 1), st.sampled_from([1.1, 1.3, 1.5, 2.0]))
@settings(max_examples=60, deadline=None)
@pytest.mark.slow
def test_the_tree_in_stages_is_the_tree_in_memory(seed: int, base: float) -> None:
    rng = random.Random(seed)
    splats = scene(rng)
    check(splats, base, random_division(rng, splats.center, base))


@pytest.mark.parametrize("name", hard_cases())
@pytest.mark.parametrize("base", [1.1, 2.0])
@pytest.mark.slow
def test_so_are_the_trees_of_hard_scenes(name: str, base: float) -> None:
    splats = hard_cases()[name]
    check(splats, base, random_division(random.Random(name), splats.center, base))


def test_so_is_the_tree_of_coincident_splats_on_a_face() -> None:
    splats = coincident(70_000)
    at = float(splats.center[0, 0])
    check(splats, 1.5, Division().cut(0, at))


@pytest.mark.parametrize("sh_degree", [0, 2])
def test_blocks_hand_on_fewer_nodes_than_they_hold_and_joins_fewer_yet(sh_degree: int) -> None:
    """Small blocks of 5,000 splats, whose merges mostly wait for what is beyond their borders."""
    fat = random_splats(40_000, sh_degree=sh_degree)
    splats = dataclasses.replace(fat, scale=fat.scale * np.float32(0.05))
    nodes, tree, stages = run_stages(quick, splats, 1.5, [(2, 2, 1), (1, 1, 2)])
    expected, expected_tree = quick.build(splats)
    assert all(getattr(nodes, name).tobytes() == getattr(expected, name).tobytes() for name in COLUMNS)
    assert tree.child_start.tobytes() == expected_tree.child_start.tobytes()
    assert len(stages.families) == 8 + 4 + 1
    blocks = sum(count for stage, count in enumerate(stages.pending) if stage % 3 < 2 and stage < 12)
    joins = sum(stages.pending[2:12:3])
    assert joins < 0.8 * blocks < 0.8 * 0.9 * len(splats)


def test_families_say_where_their_parents_are() -> None:
    splats = random_splats(2_000)
    nodes, tree, stages = run_stages(quick, splats, 1.5, [])
    (families,) = stages.families
    parents = np.flatnonzero(tree.child_count)
    parents = parents[np.argsort(tree.child_start[parents])]
    assert np.array_equal(families.center, nodes.center[parents])
    assert np.array_equal(families.size, spark_size(nodes)[parents])


def test_the_plan_can_be_pickled() -> None:
    plan = quick.plan(check_input(random_splats(10)), random_splats(10), 1.5)
    assert repr(pickle.loads(pickle.dumps(plan))) == repr(plan)


def test_a_region_without_splats_hands_on_nothing() -> None:
    splats = random_splats(10)
    plan = quick.plan(check_input(splats), splats, 1.5)
    nothing = quick.leaves(splats.take(slice(0, 0)), np.empty(0, np.int64), plan)
    families, left = quick.advance(nothing, Region((0, 0, 0), (1, 1, 1)), 7, plan)
    assert len(families) == len(left) == 0
    assert set(left.columns) == set(nothing.columns)
    assert families.nodes.sh_degree == 0
