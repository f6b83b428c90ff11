"""Laws of the Quick-LoD builder."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.lod.kernels.cell_pairs import ROUNDS
from tests.conftest import real_scene
from tests.lod.trees import check_tree, children, coincident, parents
from tests.scenes import random_splats


def test_a_family_has_no_more_children_than_rounds_can_merge() -> None:
    splats = random_splats(5_000, seed=8)
    _, tree = quick.build(splats)
    assert tree.child_count[~tree.is_leaf].min() >= 2
    assert tree.child_count.max() <= 2**ROUNDS


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


@pytest.mark.parametrize("count", [100, 70_000])
def test_coincident_splats_are_split_among_intermediate_nodes(count: int) -> None:
    splats = coincident(count)
    nodes, tree = quick.build(splats)
    check_tree(splats, nodes, tree)
    assert tree.child_count.max() <= 2**ROUNDS


def test_growth_of_a_real_scene_is_no_more_than_that_of_sparks_builder() -> None:
    splats = read_scene(real_scene("biker.ply")).splats
    nodes, tree = quick.build(splats.take(splats.opacity > 0))
    tree.validate()
    assert len(nodes) <= 179_851  # Spark's tiny builder, base 1.5
