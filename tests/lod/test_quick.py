"""Laws of the Quick-LoD builder."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.io import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.lod.voxel_tree import SHRINK
from sparklod_cli.model.lod_tree import MAX_CHILDREN, LodTree
from sparklod_cli.model.splats import Splats
from sparklod_cli.support.errors import InvalidSplatsError
from tests.conftest import real_scene
from tests.lod.trees import check_threads, check_tree, children, coincident, hard_cases, parents
from tests.references import gaussians, quick_trees
from tests.scenes import random_splats


def as_merged(nodes: Splats, tree: LodTree) -> Splats:
    """Nodes with the scales that they were merged with, larger than those that are drawn."""
    scale = nodes.scale.copy()
    scale[~tree.is_leaf] /= SHRINK
    return dataclasses.replace(nodes, scale=scale)


def check_merge(nodes: Splats, tree: LodTree, node: int) -> None:
    """One merged node of `as_merged` has the moments of its children."""
    expected = gaussians.merge(nodes.take(children(tree, node)))
    extent = math.sqrt(np.abs(expected.covariance).max())
    size = np.abs(expected.center).max()
    assert np.allclose(nodes.center[node], expected.center, atol=1e-5 * extent + 1e-6 * size)
    got = gaussians.covariance(nodes.scale[node], nodes.quat_xyzw[node])
    assert np.allclose(got, expected.covariance, atol=1e-5 * extent**2)
    opacity = gaussians.opacity_of(expected.weight, nodes.scale[node])
    assert nodes.opacity[node] == pytest.approx(opacity, rel=1e-4)
    assert np.allclose(nodes.rgb[node], expected.rgb, atol=1e-5)
    assert np.allclose(nodes.sh[node], expected.sh, atol=1e-5)


@pytest.mark.parametrize("base", [1.1, 1.5, 2.0])
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_every_merged_node_has_the_moments_of_its_children(base: float, sh_degree: int) -> None:
    splats = random_splats(400, sh_degree=sh_degree, seed=sh_degree)
    nodes, tree = quick.build(splats, base)
    check_tree(splats, nodes, tree)
    merged = as_merged(nodes, tree)
    for node in np.flatnonzero(~tree.is_leaf):
        check_merge(merged, tree, node)


def shape_of(tree: LodTree, leaf_of: dict[int, int], node: int = 0) -> quick_trees.Tree:
    if node in leaf_of:
        return (leaf_of[node],)
    part = children(tree, node)
    below = [shape_of(tree, leaf_of, child) for child in range(part.start, part.stop)]
    return tuple(sorted(below, key=str))


@given(st.integers(1, 120), st.floats(1.1, 2.0), st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 1.0, 1e4]))
@settings(max_examples=60)
def test_the_tree_is_the_one_that_the_method_describes(count: int, base: float, seed: int, extent: float) -> None:
    splats = random_splats(count, seed=seed, extent=extent)
    nodes, tree = quick.build(splats, base)
    check_tree(splats, nodes, tree)

    # A cell's edge falls between two floats, so the reference takes merged centres as the builder rounded them: by the
    # set of leaves below a node.
    index_of = {row.tobytes(): i for i, row in enumerate(splats.center)}
    leaf_of = {int(i): index_of[nodes.center[i].tobytes()] for i in np.flatnonzero(tree.is_leaf)}
    below = {}
    for node in reversed(range(len(tree))):
        part = children(tree, node)
        parts = [below[child] for child in range(part.start, part.stop)]
        below[node] = frozenset({leaf_of[node]}) if node in leaf_of else frozenset().union(*parts)
    center_of = {leaves: nodes.center[node] for node, leaves in reversed(below.items())}

    def leaves_of(shape: quick_trees.Tree) -> frozenset[int]:
        return frozenset(shape) if isinstance(shape[0], int) else frozenset().union(*map(leaves_of, shape))

    levels = [quick_trees.natural_level(scale, base) for scale in splats.scale]
    expected = quick_trees.quick_tree(
        {(i,): splats.center[i] for i in range(count)},
        levels,
        base,
        lambda members: center_of[frozenset().union(*map(leaves_of, members))],
    )
    assert shape_of(tree, leaf_of) == expected


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


@pytest.mark.parametrize("count", [MAX_CHILDREN, MAX_CHILDREN + 1, 3 * MAX_CHILDREN + 5])
def test_coincident_splats_are_split_among_intermediate_nodes(count: int) -> None:
    splats = coincident(count)
    nodes, tree = quick.build(splats)
    check_tree(splats, nodes, tree)
    pieces = -(-count // MAX_CHILDREN)
    counts = np.sort(tree.child_count)[::-1].astype(int)
    if pieces > 1:  # as many intermediate nodes as are needed, of equal shares
        assert counts[0] - counts[pieces - 1] <= 21
        assert counts[:pieces].sum() >= count
    for node in np.flatnonzero(tree.child_count > 1000):
        check_merge(as_merged(nodes, tree), tree, node)


@pytest.mark.parametrize("name", hard_cases())
@pytest.mark.parametrize("base", [1.1, 2.0])
def test_quick_makes_valid_trees_of_hard_scenes(name: str, base: float) -> None:
    splats = hard_cases()[name]
    nodes, tree = quick.build(splats, base)
    check_tree(splats, nodes, tree)
    low, high = splats.center.min(axis=0), splats.center.max(axis=0)
    assert ((nodes.center >= low) & (nodes.center <= high)).all()


def test_growth_of_a_real_scene_is_that_of_sparks_builder() -> None:
    splats = read_scene(real_scene("biker.ply")).splats
    nodes, tree = quick.build(splats.take(splats.opacity > 0))
    tree.validate()
    assert len(nodes) / 179_851 == pytest.approx(1, abs=1e-4)  # Spark's tiny builder, base 1.5
