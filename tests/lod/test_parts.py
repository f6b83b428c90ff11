"""Detail levels of a tree, their regions, and tiles: cuts that stand for the same leaves."""

from __future__ import annotations

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sparklod_cli.lod import quality, quick
from sparklod_cli.lod.kernels.tree_links import find_parents
from sparklod_cli.lod.parts import (
    COARSE_ENOUGH,
    EXTENT,
    PIXEL_ERROR,
    SIBLINGS,
    STEP,
    RefinementOrder,
    beyond,
    detail_cuts,
    divide,
    extents,
    losses,
    make_levels,
    make_tiles,
    owners_of,
    picture_errors,
    shares_of,
    tile_cuts,
    united,
    with_plain_opacity,
)
from sparklod_cli.lod.tree_settings import DetailSettings, TileSettings
from sparklod_cli.model.gaussian import covariance, rotation_matrices, spark_size
from sparklod_cli.model.instances import DetailScene, TileScene
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import InvalidSplatsError
from sparklod_cli.system.threads import on_threads
from tests.lod.trees import children, hard_cases, leaves_under, sorted_rows
from tests.scenes import random_splats

SHARES = (0.5, 0.25, 0.12, 0.06)


def numbered(nodes: Splats) -> Splats:
    """Nodes whose first colour is their number."""
    rgb = nodes.rgb.copy()
    rgb[:, 0] = np.arange(len(nodes))
    return dataclasses.replace(nodes, rgb=rgb)


def numbers_of(splats: Splats, part: slice) -> list[int]:
    """The numbers of some splats, of numbered ones."""
    return splats.rgb[part, 0].astype(int).tolist()


# Detail levels


def check_levels(splats: Splats, made: DetailScene) -> None:
    """The laws of the detail levels of every scene, and of the binary tree over its regions."""
    assert np.array_equal(sorted_rows(made.splats.take(made.level(0))), sorted_rows(splats))
    assert made.splats.opacity.max() <= 1
    assert made.errors is None and (made.counts > 0).all()
    assert not made.splats.invalid()
    totals = made.counts.sum(axis=0)
    for before, total, share in zip(totals, totals[1:], SHARES, strict=False):
        assert 1 <= total <= max(round(share * len(splats)), 1)
        assert total <= before
    flat = made.children.ravel().tolist()
    assert sorted(number for number in flat if number >= 0) == list(range(1, made.regions - 1))
    assert sorted(-1 - number for number in flat if number < 0) == list(range(made.regions)) * (made.regions > 1)
    assert all(number > at for at, pair in enumerate(made.children.tolist()) for number in pair if number >= 0)
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
    for share, cut in zip((1, *SHARES), cuts, strict=True):
        assert sorted(leaf for node in cut for leaf in under[node]) == sorted(under[0])
        assert share * 400 - tree.child_count.max() < len(cut) <= share * 400
    for fine, coarse in itertools.pairwise(cuts):
        assert all(any(under[node] <= under[above] for above in coarse) for node in fine)
    for node, place in enumerate(owners_of(parent, cuts[-1])):
        above = [at for at, coarse in enumerate(cuts[-1]) if under[node] <= under[coarse]]
        assert place == (above[0] if above else -1)


def test_regions_stand_for_the_same_leaves_at_every_level() -> None:
    nodes, tree = quality.build(random_splats(3_000, seed=5), 1.4)
    under = leaves_under(tree)
    made = make_levels(numbered(nodes), tree, DetailSettings(SHARES, chunk_splats=700, min_splats=100))
    assert made.regions > 8 and made.counts.sum(axis=1).max() <= 700
    seen: set[int] = set()
    for region in range(made.regions):
        at_levels = [
            frozenset().union(*(under[node] for node in numbers_of(made.splats, made.run(region, level))))
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
    check_levels(splats, make_levels(nodes, tree, DetailSettings(SHARES, chunk, extent, least)))


@pytest.mark.parametrize("name", hard_cases())
def test_hard_scenes_have_detail_levels_and_tiles(name: str) -> None:
    splats = hard_cases()[name]
    nodes, tree = quality.build(splats, 2.0)
    parent, _ = find_parents(tree.child_count, tree.child_start)
    loss = losses(nodes, tree, parent)
    assert not np.isnan(loss).any()
    assert (loss[1:] <= loss[parent[1:]]).all()
    with np.errstate(over="ignore"):
        check_levels(splats, make_levels(nodes, tree, DetailSettings(SHARES, 200, 1.0, 50)))
    nodes, tree = quick.build(splats)
    check_tiles(nodes, tree, make_tiles(nodes, tree, TileSettings(tile_splats=20)), 20)


@pytest.mark.parametrize("leaves", [1, 100, 4 * COARSE_ENOUGH, 4 * COARSE_ENOUGH + 4, 30_000_000])
def test_default_shares_end_with_what_loads_at_once(leaves: int) -> None:
    shares = shares_of(None, leaves)
    assert shares == [STEP ** (1 + at) for at in range(len(shares))]
    assert shares[-1] * leaves <= COARSE_ENOUGH
    assert len(shares) == 1 or shares[-2] * leaves > COARSE_ENOUGH


def test_parts_do_not_depend_on_the_number_of_threads() -> None:
    nodes, tree = quality.build(random_splats(3_000, sh_degree=1, seed=8), 2.0)
    made = []
    for threads in (1, 4):
        with on_threads(threads):
            tiles = make_tiles(nodes, tree, TileSettings(tile_splats=200))
            levels = make_levels(nodes, tree, DetailSettings(SHARES, 300))
        arrays = [*vars(tiles.splats).values(), *vars(levels.splats).values(), levels.counts, levels.children]
        made.append([*arrays, tiles.parent, tiles.level, tiles.counts, tiles.errors, tiles.bounds])
    assert all(map(np.array_equal, *made))


# Losses

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
    rng, near = np.random.default_rng(count), random_splats(count, seed=count)
    near.center[:], near.scale[:] = rng.normal(0, 0.02, (count, 3)), rng.uniform(0.01, 0.03, (count, 3))
    nodes, tree = quick.build(near, 2.0)
    plain = with_plain_opacity(nodes)
    parent, _ = find_parents(tree.child_count, tree.child_start)
    found = picture_errors(plain, parent)
    for node in range(len(tree)):
        expected = 0.0
        if tree.child_count[node]:
            own, below = plain.take(slice(node, node + 1)), plain.take(children(tree, node))
            unit = 2 * float(max(own.scale.max(), 0.03))
            for axes in ((0, 1), (0, 2), (1, 2)):
                one, other = (picture(splats, axes, own.center[0], unit) for splats in (own, below))
                step = unit * (STEPS[1] - STEPS[0])
                expected += float(((one - other) ** 2).sum()) * step * step / (3 * np.pi)
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
    error = np.sqrt(picture_errors(with_plain_opacity(nodes), parent))
    leaves, expected = np.ones(len(tree)), np.zeros(len(tree))
    for node in np.flatnonzero(tree.child_count)[::-1]:
        below = children(tree, node)
        leaves[node] = leaves[below].sum()
        own = error[node] * float(spark_size(nodes)[node]) * leaves[node] ** power
        expected[node] = max(own, expected[below].max())
    np.testing.assert_allclose(losses(nodes, tree, parent), expected, rtol=1e-4)
    assert leaves[0] == 300


def test_children_far_apart_in_the_list_count_as_apart() -> None:
    count = SIBLINGS + 2
    same = random_splats(1, seed=2).take(np.zeros(count, np.int64))
    wide = dataclasses.replace(same, scale=same.scale * 0)
    nodes = Splats.concat([wide.take(slice(0, 1)), same])
    parent = np.array([-1] + [0] * count, np.int32)
    one = picture_errors(nodes.take(slice(0, 2)), parent[:2])[0]
    pairs = count * count - 2  # all but those of the first and the last child
    np.testing.assert_allclose(picture_errors(nodes, parent)[0], pairs * one, rtol=1e-5)


@pytest.mark.parametrize("opacity", [1.0, 1.01, 1.7, 3.0, 20.0, 1000.0])
def test_a_plain_splat_covers_as_much(opacity: float) -> None:
    splats = random_splats(2, seed=1)
    merged = dataclasses.replace(splats, opacity=np.array([opacity, 0.5], np.float32))
    plain = with_plain_opacity(merged)
    assert (plain is merged) == (opacity == 1)
    assert plain.opacity.tolist() == [1.0, 0.5]
    z = np.linspace(0, 40, 200_001)
    covered = np.trapezoid(z * (1 - (1 - np.exp(-(z**2) / 2)) ** opacity), z)
    times = plain.scale[0] / merged.scale[0]
    np.testing.assert_allclose(times, times[0], rtol=1e-6)
    np.testing.assert_allclose(np.trapezoid(z * np.exp(-(z**2) / (2 * float(times[0]) ** 2)), z), covered, rtol=1e-5)
    assert plain.scale[1].tolist() == merged.scale[1].tolist()
    for name in ("center", "quat_xyzw", "rgb", "sh"):
        assert getattr(plain, name) is getattr(merged, name)


# Regions


class Places(NamedTuple):
    """The first arguments of `divide`."""

    center: np.ndarray
    box: np.ndarray
    splats: np.ndarray


def places(count: int, splats: int = 10) -> Places:
    center = np.random.default_rng(0).uniform(size=(count, 3)).astype(np.float32) * np.float32([4, 2, 1])
    box = np.stack([center, center], axis=1).astype(np.float64)
    return Places(center, box, np.full(count, splats, np.int64))


def test_regions_have_no_more_splats_than_a_chunk() -> None:
    some = places(1000)
    number, below = divide(*some, DetailSettings(chunk_splats=777, extent=100.0))
    sums = np.bincount(number, some.splats)
    assert sums.max() <= 777 and sums.min() >= 777 / 2 - 10 and len(below) == len(sums) - 1


def test_regions_are_no_wider_than_the_extent_unless_they_have_few_splats() -> None:
    some = places(1000)
    for least in (1, 2000):
        number, below = divide(*some, DetailSettings(extent=0.5, min_splats=least))
        for region in range(len(below) + 1):
            inside = number == region
            side = np.ptp(some.center[inside], axis=0).max()
            assert side <= 0.5 or some.splats[inside].sum() <= least
        assert (len(below) >= 8 * 4 * 2 - 1) == (least == 1)


def test_nodes_are_divided_by_what_lies_below_them_but_a_node_never_is() -> None:
    some, fine = places(2), DetailSettings(min_splats=1)
    wide = some._replace(box=some.box + np.array([[-50.0], [50.0]]))
    assert [len(divide(*each, fine)[1]) for each in (some, wide)] == [0, 1]
    heavy = places(100)
    heavy.splats[np.argmin(heavy.center[:, 0])] = 5_000
    assert np.bincount(divide(*heavy, DetailSettings(chunk_splats=5_500))[0]).tolist() == [1, 99]
    assert sorted(divide(*places(4, splats=100), DetailSettings(chunk_splats=10))[0]) == [0, 1, 2, 3]
    in_one_point = Places(np.zeros((64, 3), np.float32), np.zeros((64, 2, 3)), np.full(64, 10))
    assert np.bincount(divide(*in_one_point, DetailSettings(chunk_splats=100))[0]).max() == 8


def test_boxes_enclose_the_ellipsoid_and_the_rotated_box_of_one_deviation() -> None:
    splats = random_splats(500, seed=3)
    half = (extents(splats)[:, 1] - extents(splats)[:, 0]) / 2
    np.testing.assert_allclose(extents(splats).mean(axis=1), splats.center, rtol=1e-6, atol=1e-9)
    variance = covariance(splats.scale, splats.quat_xyzw)[:, [0, 3, 5]]
    np.testing.assert_allclose(half, EXTENT * np.sqrt(variance), rtol=1e-5)
    turned = np.abs(rotation_matrices(splats.quat_xyzw)).transpose(2, 0, 1) @ splats.scale[:, :, None]
    assert (half >= turned[:, :, 0] * (1 - 1e-6)).all()
    for count in (1, 5):
        number = np.arange(500) % count
        for at, box in enumerate(united(extents(splats), number, count)):
            assert box[0].tolist() == extents(splats)[number == at, 0].min(axis=0).tolist()
            assert box[1].tolist() == extents(splats)[number == at, 1].max(axis=0).tolist()


# Environments


def at(*centers: tuple[float, float, float]) -> Splats:
    splats = Splats.zeros(len(centers), 0)
    splats.center[:] = centers
    return splats


@pytest.fixture
def scene() -> Splats:
    """A ball of radius 1 around (10, 20, 30), and a sky to one side of it."""
    rng = np.random.default_rng(0)
    inside = rng.normal(size=(900, 3))
    inside *= rng.uniform(0, 1, (900, 1)) / np.linalg.norm(inside, axis=1, keepdims=True)
    sky = rng.normal(size=(100, 3)) + np.array([1000, 0, 0])
    return at(*((np.concatenate([inside, sky]) + np.array([10, 20, 30])).tolist()))


def test_a_sky_is_beyond_and_does_not_move_the_middle(scene: Splats) -> None:
    assert beyond(scene, 5).tolist() == [False] * 900 + [True] * 100
    masks = [beyond(scene, radius) for radius in (0.5, 0.8, 5, 999, 2000)]
    assert all((a | ~b).all() for a, b in itertools.pairwise(masks)) and not masks[-1].any()


@pytest.mark.parametrize(
    ("centers", "radius", "expected"),
    [
        ([(-2, 0, 0), (0, 0, 0), (2, 0, 0)], 2, [False, False, False]),
        ([(-2, 0, 0), (0, 0, 0), (2, 0, 0)], 1.99, [True, False, True]),
        ([(0, 0, 0), (0, 0, 0), (3e38, -3e38, 3e38)], 1e30, [False, False, True]),  # without an overflow
    ],
)
def test_splats_farther_than_the_radius_are_beyond(centers: list, radius: float, expected: list[bool]) -> None:
    assert beyond(at(*centers), radius).tolist() == expected


def test_no_splat_near_the_middle_is_an_error() -> None:
    with pytest.raises(InvalidSplatsError, match=r"no splat is within 2 of the middle of the scene \(0, 0, 0\); give"):
        beyond(at((-5, 0, 0), (5, 0, 0)), 2)


# Tiles


def check_tiles(nodes: Splats, tree: LodTree, made: TileScene, tile_splats: int) -> None:
    """The laws of the tiles of every tree."""
    assert (made.counts >= 1).all() and (made.counts <= tile_splats).all()
    assert made.splats.opacity.max() <= 1
    leaves = nodes.take(np.flatnonzero(tree.is_leaf))
    assert np.array_equal(sorted_rows(made.scene().splats), sorted_rows(with_plain_opacity(leaves)))
    assert (made.errors[made.is_leaf] == 0).all() and (made.errors[~made.is_leaf] > 0).all()
    above, below = made.parent[1:], slice(1, None)
    assert (made.errors[below] <= made.errors[above]).all() and (made.level[below] > made.level[above]).all()
    assert (made.bounds[below, 0] >= made.bounds[above, 0]).all()
    assert (made.bounds[below, 1] <= made.bounds[above, 1]).all()
    boxes, bounds = extents(made.splats), np.repeat(made.bounds, made.counts, axis=0)
    assert (boxes[:, 0] >= bounds[:, 0]).all() and (boxes[:, 1] <= bounds[:, 1]).all()


@pytest.mark.parametrize("growth", [1.2, 2.0])
@pytest.mark.parametrize("tile_splats", [1, 7, 50, 500])
def test_child_tiles_stand_for_the_same_leaves_and_every_level_is_a_cut(growth: float, tile_splats: int) -> None:
    nodes, tree = quality.build(random_splats(400, seed=tile_splats), growth)
    nodes, under = numbered(nodes), leaves_under(tree)
    made = make_tiles(nodes, tree, TileSettings(tile_splats=tile_splats))
    check_tiles(nodes, tree, made, tile_splats)

    def members(tiles: NDArray[np.int64]) -> list[int]:
        return sorted(node for tile in tiles.tolist() for node in numbers_of(made.splats, made.run(tile)))

    def stands_for(tiles: NDArray[np.int64]) -> list[int]:
        """The leaves of tiles; a leaf of two nodes is there twice."""
        return sorted(leaf for node in members(tiles) for leaf in under[node])

    for tile in np.flatnonzero(~made.is_leaf):
        assert stands_for(np.flatnonzero(made.parent == tile)) == stands_for(np.array([tile]))
    cuts = tile_cuts(RefinementOrder(nodes, tree), tile_splats)
    assert made.level.max() < len(cuts)
    for level, cut in enumerate(cuts):
        assert members(made.at_level(level)) == cut.tolist()
        assert stands_for(made.at_level(level)) == sorted(under[0])


@settings(max_examples=25)
@given(st.integers(1, 300), st.integers(1, 400), st.integers(0, 99))
def test_scenes_of_any_size_have_tiles_of_any_size(count: int, tile_splats: int, seed: int) -> None:
    nodes, tree = quick.build(random_splats(count, seed=seed))
    made = make_tiles(nodes, tree, TileSettings(tile_splats=tile_splats))
    check_tiles(nodes, tree, made, tile_splats)
    assert (made.tiles == 1) == (count <= tile_splats)


def test_the_error_of_a_tile_is_that_of_its_splats_that_are_refined() -> None:
    nodes, tree = quality.build(random_splats(2_000), 2.0)
    made = make_tiles(numbered(nodes), tree, TileSettings(tile_splats=150))
    deepest = [tile for tile in np.flatnonzero(~made.is_leaf) if made.is_leaf[made.parent == tile].all()]
    assert deepest
    for tile in deepest:
        run = made.run(int(tile))
        merged = ~tree.is_leaf[numbers_of(made.splats, run)]
        sizes = spark_size(made.splats.take(run))[merged].astype(np.float64)
        assert made.errors[tile] == pytest.approx(PIXEL_ERROR * np.median(sizes))


def test_tiles_are_as_full_as_their_number_allows() -> None:
    nodes, tree = quality.build(random_splats(5_000), 2.0)
    made = make_tiles(nodes, tree, TileSettings(tile_splats=300))
    for tile in np.flatnonzero(~made.is_leaf):
        counts = made.counts[made.parent == tile]
        assert len(counts) == -(-counts.sum() // 300) and np.ptp(counts) <= len(counts)
