"""Laws of the quality builder in quality."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.lod import quality
from sparklod_cli.lod.kernels.prune import MOST_CHILDREN
from sparklod_cli.lod.stages import Pending, Region
from sparklod_cli.lod.stages import check as check_input
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.progress import silent
from tests.lod.assembled import Splits, build_in_stages, check_families, run_stages
from tests.lod.trees import check_colours, check_tree, coincident, hard_cases
from tests.scenes import random_splats

GROWTHS = [1.05, 1.4, 2.0]

#: Two blocks, 27, and 16 with two levels of joins.
SPLITS: list[Splits] = [[(2, 1, 1)], [(3, 3, 3)], [(2, 2, 1), (2, 2, 1)]]


def check(splats: Splats, growth: float, splits: Splits) -> tuple[Splats, LodTree]:
    """What holds for every scene."""
    nodes, tree, built = run_stages(quality, splats, growth, splits)
    check_tree(splats, nodes, tree)
    for stage, families in enumerate(built.families):
        check_families(families, stage)
    assert len(nodes) <= max(growth * len(splats), len(splats) + 1)
    return nodes, tree


def same(a: tuple[Splats, LodTree], b: tuple[Splats, LodTree]) -> bool:
    columns = [getattr(a[0], name).tobytes() == getattr(b[0], name).tobytes() for name in COLUMNS]
    return all(columns) and np.array_equal(a[1].child_start, b[1].child_start)


@pytest.mark.parametrize("growth", GROWTHS)
def test_one_stage_makes_the_tree_in_memory(growth: float) -> None:
    splats = random_splats(2_000, sh_degree=1, seed=1)
    assert same(build_in_stages(quality, splats, growth, []), quality.build(splats, growth))


@given(
    st.integers(1, 300),
    st.floats(1.05, 2.0),
    st.integers(0, 2**32 - 1),
    st.sampled_from([1e-6, 1.0, 1e9]),
    st.sampled_from(SPLITS),
)
@settings(max_examples=40)
def test_scenes_of_any_size_make_valid_trees(
    count: int, growth: float, seed: int, extent: float, splits: Splits
) -> None:
    check(random_splats(count, sh_degree=seed % 2, seed=seed, extent=extent), growth, splits)


@pytest.mark.parametrize("splits", SPLITS)
@pytest.mark.parametrize("name", hard_cases())
def test_hard_scenes_make_valid_trees(name: str, splits: Splits) -> None:
    check(hard_cases()[name], 1.4, splits)


@pytest.mark.parametrize("splits", SPLITS)
def test_coincident_splats_are_in_one_block_and_give_no_node_many_children(splits: Splits) -> None:
    _, tree = check(coincident(20_000), 1.4, splits)
    assert tree.child_count.max() < 1000


@pytest.mark.parametrize("growth", GROWTHS)
@pytest.mark.parametrize("splits", SPLITS)
def test_blocks_use_what_the_growth_allows(growth: float, splits: Splits) -> None:
    splats = small_splats(10_000)
    nodes, tree = check(splats, growth, splits)
    assert len(nodes) >= len(splats) + 0.98 * min((growth - 1) * len(splats), len(splats) - 1)
    if growth == 1.4:
        assert tree.child_count.max() <= MOST_CHILDREN


def test_blocks_hand_on_few_of_their_nodes() -> None:
    splats = small_splats(40_000)
    _, _, built = run_stages(quality, splats, 1.4, [(2, 2, 1)])
    assert sum(built.pending[:4]) < 0.15 * len(splats)


def test_the_order_of_tasks_does_not_change_a_bit() -> None:
    """Stages share nothing but what they hand on, and numbers of stages are only in the numbers of families."""
    splats = random_splats(3_000, seed=4)
    plan = quality.plan(check_input(splats), splats, 1.4)
    index = np.flatnonzero(splats.center[:, 0] < 0)
    region = Region((-np.inf,) * 3, (0.0, np.inf, np.inf))
    first, again = (
        quality.advance(quality.leaves(splats.take(index), index, plan), region, stage, plan, progress=silent)
        for stage in (0, 7)
    )
    for name, column in first[1].columns.items():
        other = again[1].columns[name]
        if name == "family":
            other = np.where(other < 0, other, other - (7 << 32))
        assert column.tobytes() == other.tobytes(), name
    assert first[0].key.tobytes() == again[0].key.tobytes()
    assert first[0].nodes.center.tobytes() == again[0].nodes.center.tobytes()


@pytest.mark.parametrize("splits", SPLITS)
def test_colours_are_means_of_the_leaves_by_what_they_cover(splits: Splits) -> None:
    nodes, tree = build_in_stages(quality, random_splats(2_000, sh_degree=1, seed=8), 1.4, splits)
    check_colours(nodes, tree)


def test_empty_blocks_hand_on_nothing() -> None:
    splats = random_splats(50, sh_degree=1, seed=2)
    plan = quality.plan(check_input(splats), splats, 1.4)
    nothing = quality.leaves(splats.take(slice(0, 0)), np.arange(0), plan)
    families, left = quality.advance(nothing, Region((0.0,) * 3, (1.0,) * 3), 0, plan, progress=silent)
    assert len(families) == len(families.nodes) == len(left) == 0
    some = quality.leaves(splats.take(slice(1)), np.arange(1), plan)
    _, one = quality.advance(some, Region((-np.inf,) * 3, (np.inf,) * 3), 1, plan, progress=silent)
    joined = Pending.concat([left, one])
    assert len(joined) == 1 and joined.columns["sh"].shape == (1, 3, 3)


def small_splats(count: int) -> Splats:
    """Splats on a wavy surface, much smaller than a block of them."""
    splats = random_splats(count, seed=11)
    rng = np.random.default_rng(12)
    center = rng.uniform(0, 1, (count, 3)).astype(np.float32)
    center[:, 2] = 0.1 * np.sin(6 * center[:, 0])
    scale = np.exp(rng.normal(-0.5, 0.4, (count, 3))) / np.sqrt(count)
    return dataclasses.replace(splats, center=center, scale=scale.astype(np.float32))
