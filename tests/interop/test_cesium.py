"""CesiumJS shows 3D Tiles of ours: upright, with reflections, without holes, and coarse tiles first."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.codecs.formats import TILESET
from sparklod_cli.io.reading import read_parts, read_scene
from sparklod_cli.lod.parts import PIXEL_ERROR
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.model.splats import Splats
from sparklod_cli.viewers.cesium import choose
from sparklod_cli.viewers.viewer_settings import pixel_limit
from tests.conftest import FIXTURES, ROOT
from tests.interop import engines
from tests.interop.engines import SIZE, Browser, Shown, like_cesium, likeness
from tests.interop.node import ENGINES
from tests.interop.pictures import cameras_around
from tests.part_files import tiled

pytestmark = pytest.mark.slow

#: Least PSNR in dB, of red, green and blue, of all pixels and of those that show something; from afar, that are small
#: splats. CesiumJS rounds to 8 bits after every splat, and keeps covariances and reflections as halves.
LEAST, LEAST_SEEN = 38, 26

#: The least share of a picture that shows something.
SEEN = 0.003

#: Most PSNR in dB of pictures that are turned or mirrored, or of something else.
WRONG = 20

#: Takes the page's own look out of it, whose tiles would be asked for, too.
NO_LOOK = {"  await widget.zoomTo(tileset);\n": ""}

#: Distances from the middle of the demo scene, and the levels of the tiles that a camera of `view` sees from there.
NEAR = 1.0
LEVELS = {0.1: {2}, NEAR: {2}, 3.0: {1, 2}, 5.0: {1}, 8.0: {0}}

#: The demo scene takes 15 tiles of this size and three levels.
TILES = TileSettings(tile_splats=3_000)


@pytest.fixture(scope="module")
def splats() -> Splats:
    """The demo scene."""
    return read_scene(FIXTURES / "demo.ply").splats


@pytest.fixture(scope="module")
def tileset(splats: Splats, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo scene in tiles of three levels."""
    return tiled(splats, tmp_path_factory.mktemp("tiles"), TILES)


def view(splats: Splats, away: float = NEAR) -> Camera:
    """A camera that sees the scene from the side, at a multiple of the distance from which all of it is seen."""
    camera = cameras_around(splats.center, *SIZE)[1]
    pose = camera.camera_to_world.copy()
    middle = np.median(splats.center, axis=0)
    pose[:3, 3] = middle + away * (pose[:3, 3] - middle)
    return dataclasses.replace(camera, camera_to_world=pose)


def drawn(file: Path, shown: Shown) -> Splats:
    """The splats of the tiles in a picture."""
    return Splats.concat([read_scene(file.parent / name).splats for name in shown.tiles])


def check(shown: Shown, ours: NDArray[np.float32]) -> None:
    """Assert that a picture is ours, and that the test would notice if it were turned, mirrored or empty."""
    rgba = shown.rgba
    seen = ours[..., 3] > 0.1
    assert seen.mean() > SEEN
    assert likeness(rgba, ours) >= LEAST, f"{likeness(rgba, ours):.2f} dB"
    assert likeness(rgba[seen], ours[seen]) >= LEAST_SEEN, f"{likeness(rgba[seen], ours[seen]):.2f} dB"
    empty = np.zeros_like(rgba)
    wrongs = rgba[::-1], rgba[:, ::-1], rgba[::-1, ::-1], empty
    assert max(likeness(wrong[seen], ours[seen]) for wrong in wrongs) < WRONG


def chosen(file: Path, camera: Camera) -> list[str]:
    """The names of the tiles that our traversal draws, in order."""
    names, frontier = list[str](), [json.loads(file.read_text(encoding="utf-8"))["root"]]
    while frontier:  # in the order of `read_parts`
        names += (tile["content"]["uri"] for tile in frontier)
        frontier = [child for tile in frontier for child in tile.get("children", ())]
    scene, limit = read_parts(file), PIXEL_ERROR * pixel_limit(camera.fov_y, camera.height)
    found = choose(scene, camera, np.eye(4), limit, np.ones(scene.tiles, np.bool_))
    return sorted(names[tile] for tile in np.flatnonzero(found.drawn))


def parents(tile: dict[str, Any], above: str | None = None) -> Iterator[tuple[str, str | None]]:
    """The names of tiles, each with that of the tile above it."""
    name = tile["content"]["uri"]
    yield name, above
    for child in tile.get("children", ()):
        yield from parents(child, name)


def levels(names: Iterable[str]) -> set[int]:
    """The levels of tiles."""
    return {int(Path(name).name.split("-")[0]) for name in names}


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_it_shows_one_tile_upright_with_its_reflections(
    degree: int, browser: Browser, splats: Splats, tmp_path: Path
) -> None:
    some = splats.take(slice(None, None, 4))
    one = np.random.default_rng(7).normal(0, 0.25, ((degree + 1) ** 2 - 1, 3)).astype(np.float32)
    sh = np.repeat(one[None], len(some), axis=0)  # those of many different splats would cancel
    some = dataclasses.replace(some, scale=1.6 * some.scale, sh=sh)
    file, camera = tiled(some, tmp_path), view(some)
    shown = browser.cesium(file, camera)
    held = drawn(file, shown)
    assert len(held) == len(some) and held.sh_degree == degree
    check(shown, like_cesium(held, camera))
    for fewer in range(degree):
        without = dataclasses.replace(held, sh=np.ascontiguousarray(held.sh[:, : (fewer + 1) ** 2 - 1]))
        assert likeness(shown.rgba, like_cesium(without, camera)) < LEAST - 8
    assert [each.name for each in shown.requests] == [TILESET, "tiles/0-0.glb"]


@pytest.mark.parametrize("away", LEVELS)
def test_it_asks_for_coarse_tiles_first_and_for_no_finer_ones_than_it_needs(
    away: float, browser: Browser, splats: Splats, tileset: Path
) -> None:
    camera = view(splats, away)
    shown = browser.cesium(tileset, camera, NO_LOOK)
    check(shown, like_cesium(drawn(tileset, shown), camera))
    assert levels(shown.tiles) == LEVELS[away]
    assert shown.tiles == chosen(tileset, camera), "traverse and render choose other tiles"
    above = dict(parents(json.loads(tileset.read_text(encoding="utf-8"))["root"]))
    first, *names = (each.name for each in shown.requests)
    assert first == TILESET and len(set(names)) == len(names)
    assert max(levels(names)) == max(LEVELS[away])
    for number, name in enumerate(names):
        assert above[name] is None or above[name] in names[:number], f"{name} comes before its parent: {names}"
    for name in shown.tiles:
        coarser = above[name]
        while coarser is not None:
            assert coarser not in shown.tiles, f"{name} is drawn with {coarser}, which stands for it"
            coarser = above[coarser]
    count = len(drawn(tileset, shown))
    if away == NEAR:
        assert count == len(splats)
    else:
        assert count < len(splats), "it draws what is behind the camera, or far away, in full detail"


def test_it_shows_a_scene_that_stands_on_the_earth(browser: Browser, splats: Splats, tmp_path: Path) -> None:
    place = dataclasses.replace(TILES, lat=47.37, lon=8.54, height=410.0, heading=30.0)
    file, camera = tiled(splats, tmp_path, place), view(splats)
    shown = browser.cesium(file, camera)
    check(shown, like_cesium(drawn(file, shown), camera))


def test_the_page_names_the_version_that_is_tested() -> None:
    text = (ROOT / "docs" / "cesium.md").read_text(encoding="utf-8")
    assert set(re.findall(r"cesium@(\d+\.\d+\.\d+)", text)) == {ENGINES["cesium"]}
    assert engines.cesium()
