"""Laws of the tiles of a tree."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sparklod_cli.lod import quality, quick
from sparklod_cli.lod.parts import PIXEL_ERROR, RefinementOrder, extents, make_tiles, tile_cuts, with_plain_opacity
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import TileScene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.threads import on_threads
from tests.lod.test_detail_levels import leaves_under
from tests.lod.trees import hard_cases, sorted_rows
from tests.scenes import random_splats


def numbered(nodes: Splats) -> Splats:
    """Nodes whose first colour is their number, so that tiles tell which they have."""
    rgb = nodes.rgb.copy()
    rgb[:, 0] = np.arange(len(nodes))
    return dataclasses.replace(nodes, rgb=rgb)


def members_of(made: TileScene, tile: int) -> NDArray[np.int64]:
    """The nodes of a tile, of numbered ones."""
    return made.splats.rgb[made.run(tile), 0].astype(np.int64)


def check(nodes: Splats, tree: LodTree, made: TileScene, tile_splats: int) -> None:
    """What holds for the tiles of every tree."""
    assert (made.counts >= 1).all() and (made.counts <= tile_splats).all()
    assert made.splats.opacity.max() <= 1
    leaves = nodes.take(np.flatnonzero(tree.is_leaf))
    assert np.array_equal(sorted_rows(made.scene().splats), sorted_rows(with_plain_opacity(leaves)))
    assert (made.errors[made.is_leaf] == 0).all() and (made.errors[~made.is_leaf] > 0).all()
    boxes = extents(made.splats)
    for tile in range(made.tiles):
        box = boxes[made.run(tile)]
        assert (box[:, 0] >= made.bounds[tile, 0]).all() and (box[:, 1] <= made.bounds[tile, 1]).all()
        if tile:
            above = made.parent[tile]
            assert made.errors[tile] <= made.errors[above] and made.level[tile] > made.level[above]
            assert (made.bounds[tile, 0] >= made.bounds[above, 0]).all()
            assert (made.bounds[tile, 1] <= made.bounds[above, 1]).all()


@pytest.mark.parametrize("growth", [1.2, 2.0])
@pytest.mark.parametrize("tile_splats", [1, 7, 50, 500])
def test_children_stand_for_the_same_leaves_and_every_level_is_a_cut(growth: float, tile_splats: int) -> None:
    nodes, tree = quality.build(random_splats(400, seed=tile_splats), growth)
    under = leaves_under(tree)
    made = make_tiles(numbered(nodes), tree, TileSettings(tile_splats=tile_splats))
    check(numbered(nodes), tree, made, tile_splats)

    def stands_for(tiles: NDArray[np.int64]) -> list[int]:
        """The leaves that tiles stand for; a leaf of two nodes is there twice."""
        return sorted(leaf for tile in tiles for node in members_of(made, int(tile)) for leaf in under[node])

    for tile in np.flatnonzero(~made.is_leaf):
        assert stands_for(np.flatnonzero(made.parent == tile)) == stands_for(np.array([tile]))
    cuts = tile_cuts(RefinementOrder(numbered(nodes), tree), tile_splats)
    assert made.level.max() < len(cuts)
    for level, cut in enumerate(cuts):
        held = np.sort(np.concatenate([members_of(made, int(tile)) for tile in made.at_level(level)]))
        assert held.tolist() == cut.tolist()
        assert stands_for(made.at_level(level)) == sorted(under[0])


@pytest.mark.parametrize("name", hard_cases())
def test_hard_cases_have_tiles(name: str) -> None:
    splats = hard_cases()[name]
    nodes, tree = quick.build(splats)
    check(nodes, tree, make_tiles(nodes, tree, TileSettings(tile_splats=20)), 20)


@settings(max_examples=25)
@given(st.integers(1, 300), st.integers(1, 400), st.integers(0, 99))
def test_scenes_of_any_size_have_tiles_of_any_size(count: int, tile_splats: int, seed: int) -> None:
    nodes, tree = quick.build(random_splats(count, seed=seed))
    made = make_tiles(nodes, tree, TileSettings(tile_splats=tile_splats))
    check(nodes, tree, made, tile_splats)
    assert (made.tiles == 1) == (count <= tile_splats)


def test_tiles_do_not_depend_on_the_number_of_threads() -> None:
    nodes, tree = quality.build(random_splats(3_000), 2.0)
    first, second = (None, None)
    for threads in (1, 4):
        with on_threads(threads):
            first, second = make_tiles(nodes, tree, TileSettings(tile_splats=200)), first
    assert first is not None and second is not None
    for name in ("parent", "level", "counts", "errors", "bounds"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(first.splats, column), getattr(second.splats, column))


def test_the_error_is_that_of_the_splats_that_are_refined() -> None:
    nodes, tree = quality.build(random_splats(2_000), 2.0)
    made = make_tiles(numbered(nodes), tree, TileSettings(tile_splats=150))
    deepest = [tile for tile in np.flatnonzero(~made.is_leaf) if made.is_leaf[made.parent == tile].all()]
    assert deepest
    for tile in deepest:
        merged = ~tree.is_leaf[members_of(made, int(tile))]
        sizes = spark_size(made.splats.take(made.run(int(tile))))[merged].astype(np.float64)
        assert made.errors[tile] == pytest.approx(PIXEL_ERROR * np.median(sizes))


def test_tiles_are_as_full_as_their_number_allows() -> None:
    nodes, tree = quality.build(random_splats(5_000), 2.0)
    made = make_tiles(nodes, tree, TileSettings(tile_splats=300))
    for tile in np.flatnonzero(~made.is_leaf):
        counts = made.counts[made.parent == tile]
        assert len(counts) == -(-counts.sum() // 300) and np.ptp(counts) <= len(counts)
