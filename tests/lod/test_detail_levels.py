"""Laws of the detail levels of a tree."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.lod import quality, quick
from sparklod_cli.lod.kernels.tree_links import find_parents
from sparklod_cli.lod.parts import (
    COARSE_ENOUGH,
    SIBLINGS,
    STEP,
    detail_cuts,
    losses,
    make_levels,
    owners_of,
    picture_errors,
    shares_of,
    with_plain_opacity,
)
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.model.gaussian import covariance, spark_size
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import DetailScene
from sparklod_cli.model.splats import COLUMNS, Splats
from tests.lod.trees import children, hard_cases, sorted_rows
from tests.scenes import random_splats

SHARES = (0.5, 0.25, 0.12, 0.06)


def leaves_under(tree: LodTree) -> list[frozenset[int]]:
    """The leaves under each node."""
    under: list[frozenset[int]] = [frozenset()] * len(tree)
    for node in range(len(tree) - 1, -1, -1):
        own = range(len(tree))[children(tree, node)]
        under[node] = frozenset().union(*(under[child] for child in own)) if own else frozenset([node])
    return under


def check_inner_nodes(scene: DetailScene) -> None:
    """The tree over the regions is a binary one: root first, parents before their children, each region once."""
    flat = scene.children.ravel().tolist()
    inner = [number for number in flat if number >= 0]
    assert sorted(inner) == list(range(1, scene.regions - 1))
    assert sorted(-1 - number for number in flat if number < 0) == list(range(scene.regions)) * (scene.regions > 1)
    assert all(number > at for at, pair in enumerate(scene.children.tolist()) for number in pair if number >= 0)


def check(splats: Splats, made: DetailScene, shares: tuple[float, ...]) -> None:
    """What holds for the detail levels of every scene."""
    assert np.array_equal(sorted_rows(made.splats.take(made.level(0))), sorted_rows(splats))
    assert made.splats.opacity.max() <= 1
    assert made.errors is None and (made.counts > 0).all()
    assert not made.splats.invalid()
    totals = made.counts.sum(axis=0)
    for before, total, share in zip(totals, totals[1:], shares, strict=False):
        assert 1 <= total <= max(round(share * len(splats)), 1)
        assert total <= before
    check_inner_nodes(made)
    for region, level in itertools.product(range(made.regions), range(made.levels)):
        run = made.splats.take(made.run(region, level))
        assert (run.center >= made.bounds[region, 0]).all() and (run.center <= made.bounds[region, 1]).all()


@pytest.mark.parametrize("growth", [1.2, 2.0])
@pytest.mark.parametrize("seed", range(3))
def test_levels_are_nested_cuts_that_stand_for_every_leaf_once(seed: int, growth: float) -> None:
    nodes, tree = quality.build(random_splats(400, seed=seed), growth)
    under = leaves_under(tree)
    cuts, parent = detail_cuts(nodes, tree, SHARES)
    assert cuts[0].tolist() == np.flatnonzero(tree.is_leaf).tolist()
    for some in cuts:
        assert sum(len(under[node]) for node in some) == 400
        assert frozenset().union(*(under[node] for node in some)) == under[0]
    for fine, coarse in itertools.pairwise(cuts):
        assert all(any(under[node] <= under[above] for above in coarse) for node in fine)
    owners = owners_of(parent, cuts[-1])
    for node, place in enumerate(owners):
        above = [at for at, coarse in enumerate(cuts[-1]) if under[node] <= under[coarse]]
        inside = above and len(under[node]) <= len(under[cuts[-1][above[0]]])
        assert place == (above[0] if inside else -1)


@pytest.mark.parametrize("growth", [1.4, 2.0])
def test_a_level_has_its_share_but_for_the_children_of_a_node(growth: float) -> None:
    nodes, tree = quality.build(random_splats(2_000, seed=4), growth)
    for share, some in zip(SHARES, detail_cuts(nodes, tree, SHARES)[0][1:], strict=True):
        assert share * 2_000 - tree.child_count.max() < len(some) <= share * 2_000


def test_regions_stand_for_the_same_leaves_at_every_level() -> None:
    nodes, tree = quality.build(random_splats(3_000, seed=5), 1.4)
    under = leaves_under(tree)
    of_row = {row.tobytes(): node for node, row in enumerate(nodes.center)}
    assert len(of_row) == len(nodes)
    made = make_levels(nodes, tree, DetailSettings(SHARES, chunk_splats=700, min_splats=100))
    assert made.regions > 8 and made.counts.sum(axis=1).max() <= 700
    seen: set[int] = set()
    for region in range(made.regions):
        at_levels = [
            frozenset().union(*(under[of_row[row.tobytes()]] for row in made.splats.center[made.run(region, level)]))
            for level in range(made.levels)
        ]
        assert len(set(at_levels)) == 1
        assert not seen & at_levels[0]
        seen |= at_levels[0]
    assert len(seen) == 3_000


@given(st.integers(1, 300), st.integers(0, 2**32 - 1), st.integers(1, 400), st.floats(0.1, 3), st.integers(1, 100))
@settings(max_examples=60)
def test_any_scene_has_detail_levels(count: int, seed: int, chunk: int, extent: float, least: int) -> None:
    splats = random_splats(count, seed=seed)
    nodes, tree = quick.build(splats) if seed % 2 else quality.build(splats)
    check(splats, make_levels(nodes, tree, DetailSettings(SHARES, chunk, extent, least)), SHARES)


@pytest.mark.parametrize("name", hard_cases())
def test_detail_levels_of_hard_scenes(name: str) -> None:
    splats = hard_cases()[name]
    nodes, tree = quality.build(splats)
    with np.errstate(over="ignore"):
        check(splats, make_levels(nodes, tree, DetailSettings(SHARES, 200, 1.0, 50)), SHARES)


@pytest.mark.parametrize("leaves", [1, 100, 4 * COARSE_ENOUGH, 4 * COARSE_ENOUGH + 4, 30_000_000])
def test_shares_that_suit_a_scene_end_with_what_loads_at_once(leaves: int) -> None:
    shares = shares_of(None, leaves)
    assert shares == [STEP ** (1 + at) for at in range(len(shares))]
    assert shares[-1] * leaves <= COARSE_ENOUGH
    assert len(shares) == 1 or shares[-2] * leaves > COARSE_ENOUGH


STEPS = np.linspace(-6, 6, 241)


def picture(splats: Splats, axes: tuple[int, int], middle: np.ndarray, unit: float) -> np.ndarray:
    """The sum of splats on a plane, (y, x, red green blue and opacity), from the densities of 2D Gaussians."""
    x, y = (middle[axis] + unit * STEPS for axis in axes)
    full = np.zeros((3, 3, len(splats)))
    full[np.triu_indices(3)] = covariance(splats.scale, splats.quat_xyzw).T
    total = np.zeros((len(STEPS), len(STEPS), 4))
    for at in range(len(splats)):
        shape = (full[:, :, at] + np.triu(full[:, :, at], 1).T)[np.ix_(axes, axes)]
        away = np.stack(np.meshgrid(x - splats.center[at, axes[0]], y - splats.center[at, axes[1]]), axis=-1)
        high = np.exp(-0.5 * np.einsum("yxi,ij,yxj->yx", away, np.linalg.inv(shape), away)) * splats.opacity[at]
        total += high[:, :, None] * np.append(splats.rgb[at], 1)
    return total


@pytest.mark.parametrize("count", [2, 3, 7])
def test_picture_errors_are_those_of_pictures(count: int) -> None:
    near = random_splats(count, seed=count)
    rng = np.random.default_rng(count)
    near = dataclasses.replace(
        near,
        center=rng.normal(0, 0.02, (count, 3)).astype(np.float32),
        scale=rng.uniform(0.01, 0.03, (count, 3)).astype(np.float32),
    )
    nodes, tree = quick.build(near, 2.0)
    plain = with_plain_opacity(nodes)
    parent, _ = find_parents(tree.child_count, tree.child_start)
    found = picture_errors(plain, parent)
    for node in range(len(tree)):
        expected = 0.0
        if tree.child_count[node]:
            own = plain.take(slice(node, node + 1))
            unit = 2 * float(max(own.scale.max(), 0.03))
            for axes in ((0, 1), (0, 2), (1, 2)):
                pictures = [
                    picture(some, axes, own.center[0], unit) for some in (own, plain.take(children(tree, node)))
                ]
                step = unit * (STEPS[1] - STEPS[0])
                expected += float(((pictures[0] - pictures[1]) ** 2).sum()) * step * step / (3 * np.pi)
        np.testing.assert_allclose(found[node], expected, rtol=2e-3)


@pytest.mark.parametrize("growth", [1.1, 2.0])
@pytest.mark.parametrize(("sigma", "power"), [(None, 1.0), (0.0, 0.0), (0.15, 0.5)])
def test_losses_grow_towards_the_root_with_error_size_and_leaves(
    growth: float, sigma: float | None, power: float
) -> None:
    """Leaves count by as much as their sizes differ, which those of random splats do."""
    splats = random_splats(300, seed=1)
    if sigma is not None:
        logs = np.random.default_rng(1).normal(size=(300, 1))
        splats.scale[:] = 0.05 * np.exp(sigma * (logs - logs.mean()) / logs.std())
    nodes, tree = quality.build(splats, growth)
    parent, _ = find_parents(tree.child_count, tree.child_start)
    found = losses(nodes, tree, parent)
    error = np.sqrt(picture_errors(with_plain_opacity(nodes), parent))
    leaves, expected = np.zeros(len(tree)), np.zeros(len(tree))
    for node in range(len(tree) - 1, -1, -1):
        if not tree.child_count[node]:
            leaves[node] = 1
            continue
        below = children(tree, node)
        leaves[node] = leaves[below].sum()
        own = error[node] * float(spark_size(nodes)[node]) * leaves[node] ** power
        expected[node] = max(own, expected[below].max())
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert leaves[0] == 300


def test_children_far_apart_in_the_list_count_as_apart() -> None:
    count = SIBLINGS + 2
    same = random_splats(1, seed=2).take(np.zeros(count, np.int64))
    wide = dataclasses.replace(same, scale=same.scale * 0)
    nodes = Splats.concat([wide.take(slice(0, 1)), same])
    tree = LodTree(np.array([count] + [0] * count, np.uint16), np.array([1] + [0] * count, np.uint32))
    parent, _ = find_parents(tree.child_count, tree.child_start)
    one = picture_errors(Splats.concat([nodes.take(slice(0, 2))]), parent[:2])[0]
    pairs = count * count - 2  # all but those of the first and the last child
    np.testing.assert_allclose(picture_errors(nodes, parent)[0], pairs * one, rtol=1e-5)


@pytest.mark.parametrize("name", hard_cases())
def test_losses_are_numbers(name: str) -> None:
    nodes, tree = quality.build(hard_cases()[name], 2.0)
    parent, _ = find_parents(tree.child_count, tree.child_start)
    found = losses(nodes, tree, parent)
    assert not np.isnan(found).any()
    assert (found[1:] <= found[parent[1:]]).all()


@pytest.mark.parametrize("opacity", [1.0, 1.01, 1.7, 3.0, 20.0, 1000.0])
def test_a_plain_splat_covers_as_much(opacity: float) -> None:
    splats = random_splats(2, seed=1)
    merged = dataclasses.replace(splats, opacity=np.array([opacity, 0.5], np.float32))
    plain = with_plain_opacity(merged)
    assert plain.opacity.tolist() == [1.0, 0.5]
    z = np.linspace(0, 40, 200_001)
    covered = np.trapezoid(z * (1 - (1 - np.exp(-(z**2) / 2)) ** opacity), z)
    times = plain.scale[0] / merged.scale[0]
    np.testing.assert_allclose(times, times[0], rtol=1e-6)
    np.testing.assert_allclose(np.trapezoid(z * np.exp(-(z**2) / (2 * float(times[0]) ** 2)), z), covered, rtol=1e-5)
    assert plain.scale[1].tolist() == merged.scale[1].tolist()
    for name in ("center", "quat_xyzw", "rgb", "sh"):
        assert getattr(plain, name) is getattr(merged, name)


def test_nothing_depends_on_the_run() -> None:
    nodes, tree = quality.build(random_splats(1_000, sh_degree=1, seed=8))
    first, second = (make_levels(nodes, tree, DetailSettings(SHARES, 300)) for _ in range(2))
    for name in COLUMNS:
        assert getattr(first.splats, name).tobytes() == getattr(second.splats, name).tobytes()
    assert first.counts.tolist() == second.counts.tolist() and first.children.tolist() == second.children.tolist()


def test_splats_that_are_at_most_opaque_stay() -> None:
    splats = random_splats(50, seed=2)
    assert with_plain_opacity(splats) is splats
