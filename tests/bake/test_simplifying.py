"""Simplified scenes: the cut of a tree that a goal asks for, as plain splats."""

from __future__ import annotations

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.bake.simplifying import CLOSE_BYTES, CLOSE_COUNT, SimplifyGoal, fewest_for_psnr, largest_for_bytes
from sparklod_cli.fitting.pictures import FittedNodes
from sparklod_cli.lod.parts import RefinementOrder
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.system.progress import silent
from tests.scenes import random_splats

SCENE = sparklod.Scene(random_splats(2000, sh_degree=1), up="-y")


@pytest.fixture(scope="module")
def tree() -> sparklod.Tree:
    return sparklod.build_lod(SCENE, method="quality", growth=2.0)


def is_cut(nodes: np.ndarray, tree: LodTree) -> bool:
    """Each leaf has exactly one of the nodes on its way to the root."""
    chosen = np.zeros(len(tree), np.int64)
    chosen[nodes] = 1
    for node in np.flatnonzero(~tree.is_leaf):  # parents come first
        start = int(tree.child_start[node])
        chosen[start : start + int(tree.child_count[node])] += chosen[node]
    return bool((chosen[tree.is_leaf] == 1).all())


def test_each_cut_has_at_most_so_many_splats_and_refines_the_coarser_ones(tree: sparklod.Tree) -> None:
    order = RefinementOrder(tree.splats, tree.tree)
    most = int(tree.tree.child_count.max())
    parent, before = order.parent.tolist(), {0}  # the root
    for count in (1, 2, 17, 400, 1999, 2000):
        nodes = order.cut(count)
        assert count - most < len(nodes) <= count
        assert is_cut(nodes, tree.tree)
        for node in nodes.tolist():
            while node not in before:
                node = parent[node]
                assert node >= 0, "a coarser cut has a node below it"
        before = set(nodes.tolist())
    np.testing.assert_array_equal(nodes, np.flatnonzero(tree.tree.is_leaf))


def test_a_share_and_a_count_select_the_same_splats_of_a_scene_and_its_tree(tree: sparklod.Tree) -> None:
    simplified = [
        sparklod.simplify(SCENE, to=0.1, threads=3),
        sparklod.simplify(SCENE, to=200, threads=1),
        sparklod.simplify(tree, to=200),
    ]
    for each in simplified:
        np.testing.assert_array_equal(each.splats.center, simplified[0].splats.center)
        assert each.tree is None and each.up == "-y"
    assert len(simplified[0].splats) <= 200
    assert simplified[0].splats.opacity.max() <= 1
    assert len(sparklod.simplify(SCENE, to=10**9).splats) == 2000
    with pytest.raises(ValueError, match="selection and max_sh are for scenes without a tree"):
        sparklod.simplify(tree, to=300, max_sh=0)


def test_a_psnr_is_held_by_pictures() -> None:
    small = sparklod.simplify(SCENE, psnr=30.0)
    assert 1 < len(small.splats) < 2000
    smaller = sparklod.simplify(SCENE, psnr=25.0)
    assert len(smaller.splats) < len(small.splats)
    cameras = sparklod.orbit(SCENE, count=2, size=(64, 36))
    assert 1 < len(sparklod.simplify(SCENE, psnr=30.0, cameras=cameras).splats) <= 2000


def test_fitting_comes_closer_and_is_the_same_for_any_number_of_threads() -> None:
    plain = sparklod.simplify(SCENE, to=0.05)
    one, two = (sparklod.simplify(SCENE, to=0.05, refine=30, threads=threads) for threads in (1, 2))
    np.testing.assert_array_equal(one.splats.center, two.splats.center)
    assert one.splats.opacity.max() <= 1
    camera = sparklod.Camera.look_at((0, 0, -8), (0, 0, 0), size=(64, 48))
    full = sparklod.render(SCENE, camera)
    before, after = (sparklod.psnr(sparklod.render(each, camera), full) for each in (plain, one))
    assert after > before


def test_leaves_of_a_set_are_fitted_too_and_sizes_change_more_than_those_of_a_tree(tree: sparklod.Tree) -> None:
    plain, fitted = sparklod.simplify(tree, to=0.3).splats, sparklod.simplify(tree, to=0.3, refine=60).splats
    leaves = tree.splats.center[tree.tree.is_leaf]
    is_leaf = (plain.center[:, None] == leaves).all(axis=2).any(axis=1)
    assert 100 < is_leaf.sum() < len(plain)
    assert (fitted.rgb != plain.rgb).any(axis=1)[is_leaf].any()
    growth = fitted.scale.mean(axis=1) / plain.scale.mean(axis=1)
    assert growth.max() > 1.1 > FittedNodes.bounds.most_growth


def test_fitting_leaves_a_scene_as_it_is_where_nothing_is_merged() -> None:
    whole = sparklod.simplify(SCENE, to=1.0, refine=30).splats
    np.testing.assert_array_equal(np.sort(whole.rgb, axis=0), np.sort(SCENE.splats.rgb, axis=0))


@pytest.mark.parametrize("most", [1000, 34_567, 999_999])
def test_the_file_is_as_large_as_it_may_be(most: int) -> None:
    def size(count: int) -> float:
        return 500 + 12 * count - (count // 7) % 3 + count**0.9

    count = largest_for_bytes(most, 100_000, size, silent)
    assert size(count) <= most < size(count + 1) + CLOSE_BYTES * most


def test_the_fewest_splats_hold_a_psnr() -> None:
    count, psnr = fewest_for_psnr(40, 1_000_000, lambda count: 10 * np.log10(count), silent)
    assert 10_000 <= count <= 10_000 * (1 + 2 * CLOSE_COUNT)
    assert psnr == pytest.approx(10 * np.log10(count))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({}, "give one of to, max_bytes and psnr"),
        ({"psnr": 3.0, "max_bytes": 1}, "give one of"),
        ({"psnr": 100.0}, "psnr is 100.0; give more than 0 and less than 100 dB"),
        ({"psnr": float("nan")}, "psnr is nan"),
        ({"max_bytes": 0}, "max_bytes is 0; give 1 or more"),
    ],
)
def test_impossible_goals_are_refused(arguments: dict[str, float], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        SimplifyGoal(**arguments)  # type: ignore[arg-type]


def test_sizes_at_either_end_of_their_range() -> None:
    assert largest_for_bytes(10, 10, float, silent) == 10
    with pytest.raises(sparklod.FormatError, match="one splat takes 501 bytes in this format, more than 7; allow more"):
        largest_for_bytes(7, 9000, lambda count: 500.0 + count, silent)
