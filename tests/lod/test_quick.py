"""Laws of the Quick-LoD builder."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from sparklod_cli.io import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.lod.kernels.cell_pairs import ROUNDS
from sparklod_cli.support.errors import InvalidSplatsError
from tests.conftest import real_scene
from tests.lod.trees import check_colours, check_threads, check_tree, children, coincident, hard_cases, parents
from tests.scenes import random_splats


@pytest.mark.parametrize("base", [1.1, 1.5, 2.0])
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_colours_are_means_of_the_leaves(base: float, sh_degree: int) -> None:
    splats = random_splats(400, sh_degree=sh_degree, seed=sh_degree)
    nodes, tree = quick.build(splats, base)
    check_tree(splats, nodes, tree)
    check_colours(nodes, tree)


def test_a_family_has_no_more_children_than_rounds_can_merge() -> None:
    splats = random_splats(5_000, seed=8)
    _, tree = quick.build(splats)
    assert tree.child_count[~tree.is_leaf].min() >= 2
    assert tree.child_count.max() <= 2**ROUNDS


def test_threads_do_not_change_a_bit_of_a_quick_tree() -> None:
    check_threads(lambda: quick.build(random_splats(60_000, sh_degree=1, seed=3)))


def test_a_prefix_of_a_quick_tree_is_a_coarser_scene() -> None:
    splats = random_splats(5_000, seed=4)
    nodes, tree = quick.build(splats)
    # Cells of a level are base times those of the level below, so what lies before has parents at least as coarse; the
    # spread of a node's children shows it: its median falls from part to part of the file.
    inner = np.flatnonzero(~tree.is_leaf)
    spread = np.array([np.ptp(nodes.center[children(tree, node)], axis=0).max() for node in inner])
    medians = [np.median(part) for part in np.array_split(spread[np.argsort(tree.child_start[inner])], 8)]
    assert all(later < earlier for earlier, later in itertools.pairwise(medians))
    # The parents of the nodes of a prefix are in it.
    assert (parents(tree)[1:] < np.arange(1, len(tree))).all()


def test_quick_makes_one_splat_a_tree_of_one_node() -> None:
    splats = random_splats(1, sh_degree=2)
    nodes, tree = quick.build(splats)
    assert len(tree) == 1
    check_tree(splats, nodes, tree)


def test_quick_makes_no_tree_of_no_splats() -> None:
    with pytest.raises(InvalidSplatsError, match="no splat"):
        quick.build(random_splats(0))


@pytest.mark.parametrize("base", [1.0, 2.01, math.nan])
def test_a_base_out_of_range_is_an_error(base: float) -> None:
    with pytest.raises(ValueError, match="base"):
        quick.build(random_splats(2), base)


@pytest.mark.parametrize("count", [100, 70_000])
def test_coincident_splats_are_split_among_intermediate_nodes(count: int) -> None:
    splats = coincident(count)
    nodes, tree = quick.build(splats)
    check_tree(splats, nodes, tree)
    assert tree.child_count.max() <= 2**ROUNDS


@pytest.mark.parametrize("name", hard_cases())
@pytest.mark.parametrize("base", [1.1, 2.0])
def test_quick_makes_valid_trees_of_hard_scenes(name: str, base: float) -> None:
    splats = hard_cases()[name]
    nodes, tree = quick.build(splats, base)
    check_tree(splats, nodes, tree)
    low, high = splats.center.min(axis=0), splats.center.max(axis=0)
    assert ((nodes.center >= low) & (nodes.center <= high)).all()


def test_growth_of_a_real_scene_is_no_more_than_that_of_sparks_builder() -> None:
    splats = read_scene(real_scene("biker.ply")).splats
    nodes, tree = quick.build(splats.take(splats.opacity > 0))
    tree.validate()
    assert len(nodes) <= 179_851  # Spark's tiny builder, base 1.5
