"""Cuts of 3D Tiles: laws of what is drawn and loaded, held against a plain walk down the tiles."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import parts, quality
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.model.scene import Scene, TileScene
from sparklod_cli.viewers.cesium import CesiumViewer, LoadedTiles, choose
from sparklod_cli.viewers.cut import Forest, TreeInstance
from sparklod_cli.viewers.viewer_settings import pixel_limit
from tests.conftest import FIXTURES
from tests.lod.sights import CutView

EYE = np.eye(4)
Mask = NDArray[np.bool_]


@pytest.fixture(scope="module")
def scene() -> TileScene:
    """The demo scene in tiles of three levels."""
    return parts.make_tiles(
        *quality.build(read_scene(FIXTURES / "demo.ply").splats, 1.4), TileSettings(tile_splats=3000)
    )


def camera(seed: int, away: float) -> Camera:
    eye = np.random.default_rng(seed).normal(size=3)
    eye *= away / np.linalg.norm(eye)
    return Camera.look_at(eye.tolist(), [0, 0, 0], up=[0.1, -1, 0.2], fov_y=50, size=(320, 180))


def walk(scene: TileScene, view: CutView, pixel: float, there: Mask) -> tuple[set[int], set[int]]:
    """Tiles that are drawn and wanted, one tile after the other, as CesiumJS goes down them."""
    children: dict[int, list[int]] = {}
    for tile, above in enumerate(scene.parent.tolist()):
        children.setdefault(above, []).append(tile)
    eye = view.camera_to_world[:3, 3]
    to_camera = np.linalg.inv(view.camera_to_world)
    drawn, wanted = set(), set()

    def visible(tile: int) -> bool:
        low, high = scene.bounds[tile]
        corners = [np.where([k & 1, k & 2, k & 4], high, low) for k in range(8)]
        points = [to_camera[:3, :3] @ corner + to_camera[:3, 3] for corner in corners]
        wide, tall = math.tan(view.fov_x / 2), math.tan(view.fov_y / 2)
        sides = (
            [z > 0 for _, _, z in points],
            *([sign * x > -z * wide for x, _, z in points] for sign in (1, -1)),
            *([sign * y > -z * tall for _, y, z in points] for sign in (1, -1)),
        )
        return not any(map(all, sides))

    def visit(tile: int) -> None:
        if not visible(tile):
            return
        low, high = scene.bounds[tile]
        distance = math.dist(eye, np.minimum(np.maximum(eye, low), high))
        # Pixels that the error has on the screen; without a pixel, everything is refined.
        pixels = math.inf if distance == 0 or pixel == 0 else scene.errors[tile] / distance / pixel
        below = children.get(tile, [])
        if below and pixels > 16:
            wanted.update(below)
            if all(there[child] for child in below):
                for child in below:
                    visit(child)
                return
        drawn.add(tile)

    if visible(0):
        wanted.add(0)
        visit(0)
    return drawn, wanted


@given(st.integers(0, 1000), st.floats(0.1, 60), st.floats(0, 8), st.floats(0, 1), st.booleans())
def test_it_is_what_a_walk_down_the_tiles_finds(
    scene: TileScene, seed: int, away: float, scale: float, missing: float, turned: bool
) -> None:
    at = camera(seed, away)
    if turned:  # looks away from the middle
        pose = at.camera_to_world.copy()
        pose[:3, [0, 2]] *= -1
        at = dataclasses.replace(at, camera_to_world=pose)
    there = np.random.default_rng(seed).random(scene.tiles) >= missing
    view, pixel = at, pixel_limit(at.fov_y, at.height, scale)
    found = choose(scene, view, EYE, 16 * pixel, there)
    drawn, wanted = walk(scene, view, pixel, there)
    assert set(np.flatnonzero(found.drawn).tolist()) == drawn
    assert set(np.flatnonzero(found.wanted).tolist()) == wanted


def forest_of(scene: TileScene) -> Forest:
    return Forest([LoadedTiles(None, 0, Scene(scene.splats), scene.splats, 0, tiles=scene)])


def test_cuts_go_from_the_root_tile_to_full_detail(scene: TileScene) -> None:
    traversal = CesiumViewer(forest_of(scene), [TreeInstance()])
    counts, reasons = [], []
    for away in (200.0, 60.0, 20.0, 8.0):
        at = camera(3, away)
        cut = traversal.cut(at, budget=1, smallest=pixel_limit(at.fov_y, at.height))
        counts.append(len(cut))
        reasons.append(cut.reason)
        assert not cut.missing
    assert counts == sorted(counts) and counts[0] == scene.counts[0] and counts[-1] > 2 * counts[0], counts
    assert reasons[0] == "distance"
    every = traversal.cut(camera(3, 8.0), budget=1)
    assert len(every) == scene.counts[scene.is_leaf].sum() and every.reason == "exhausted"


def test_nothing_is_drawn_of_a_tile_that_is_missing(scene: TileScene) -> None:
    traversal = CesiumViewer(forest_of(scene), [TreeInstance()])
    view, there = camera(3, 4.0), np.zeros(scene.tiles, np.bool_)
    nothing = traversal.cut(view, budget=1, resident=there)
    assert not len(nothing) and nothing.reason == "missing" and nothing.wanted()[0] == 0
    there[0] = True
    root = traversal.cut(view, budget=1, resident=there)
    assert len(root) == scene.counts[0] == root.missing and root.reason == "missing"
    children = np.flatnonzero(scene.parent == 0)
    assert sorted(root.wanted()) == [0, *children]
    there[children[:-1]] = True  # all but one of them
    assert len(traversal.cut(view, budget=1, resident=there)) == scene.counts[0]


def test_a_scene_that_is_twice_as_large_and_as_far_away_has_the_same_cut(scene: TileScene) -> None:
    at = camera(5, 6.0)
    pose = at.camera_to_world.copy()
    pose[:3, 3] *= 2
    far = dataclasses.replace(at, camera_to_world=pose)
    forest, limit = forest_of(scene), pixel_limit(at.fov_y, at.height)
    one = CesiumViewer(forest, [TreeInstance()]).cut(at, budget=1, smallest=limit)
    large = TreeInstance(object_to_world=np.diag([2.0, 2.0, 2.0, 1.0]))
    two = CesiumViewer(forest, [large]).cut(far, budget=1, smallest=limit)
    assert np.array_equal(one.node, two.node)
