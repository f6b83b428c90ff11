"""3D Tiles: reading, writing, axes, nested tilesets, and tilesets that are refused."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fixtures import by_hand_glb, by_hand_tiles
from sparklod_cli.codecs import tiles_3d
from sparklod_cli.codecs.formats import PROFILES, WriteOptions
from sparklod_cli.codecs.tileset import LARGEST
from sparklod_cli.io.reading import open_reader, read_parts, read_scene
from sparklod_cli.lod import quality
from sparklod_cli.lod.parts import make_tiles
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.model.instances import TileScene
from sparklod_cli.model.scene import AXES, Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.errors import FormatError
from tests.codecs.cases import decode, linear
from tests.conftest import FIXTURES
from tests.part_files import open_companion
from tests.scenes import random_splats

GOLDEN = FIXTURES / "golden" / "sh1-tiles"
Files = dict[str, bytes]


@functools.cache
def tiles(up: str | None = None) -> TileScene:
    """Three levels of tiles."""
    settings = TileSettings(tile_splats=100, lat=47, lon=8)
    return dataclasses.replace(make_tiles(*quality.build(random_splats(1_500, sh_degree=1), 2.0), settings), up=up)


def files_of(scene: TileScene, profile: str | None = None, **more: Any) -> Files:
    files = tiles_3d.encode_files(scene, WriteOptions(glb_profile=profile), **more)
    return {name: b"".join(pieces) for name, pieces in files}


def scene_of(files: Files) -> Scene:
    return decode(tiles_3d, files["tileset.json"], open_companion=open_companion(files))


def tiles_of(files: Files) -> TileScene:
    return tiles_3d.decode_parts(io.BytesIO(files["tileset.json"]), open_companion=open_companion(files))


def two_tiles() -> Files:
    """A root and a tile, of the writers in `fixtures`."""
    splats = linear(Scene(random_splats(20, sh_degree=0)))
    root = by_hand_tiles.Tile(splats, [by_hand_tiles.Tile(splats)])
    return by_hand_tiles.tileset_files(root, by_hand_glb.glb)


def changed(change: Callable[[Any], object]) -> Files:
    files = two_tiles()
    root = json.loads(files["tileset.json"])
    change(root)
    return files | {"tileset.json": json.dumps(root).encode()}


def child(**fields: Any) -> Files:
    return changed(lambda tileset: tileset["root"]["children"][0].update(fields))


def assert_close(one: Splats, other: Splats, rtol: float, atol: float) -> None:
    for column in COLUMNS:
        a, b = getattr(one, column), getattr(other, column)
        if column == "quat_xyzw":
            a, b = np.abs((a * b).sum(axis=1)), np.ones(len(b))
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol, err_msg=column)


@pytest.mark.parametrize("up", [None, *AXES])
def test_plain_tiles_round_trip(up: str | None) -> None:
    scene, files = tiles(up), files_of(tiles(up), "khronos")
    back = tiles_of(files)
    assert_close(back.splats, scene.splats, 1e-5, 1e-6)
    for name in ("parent", "counts", "errors"):
        np.testing.assert_array_equal(getattr(back, name), getattr(scene, name))
    np.testing.assert_allclose(back.bounds, scene.bounds, atol=1e-12)
    np.testing.assert_array_equal(back.transform, scene.transform)
    assert (back.up, back.level.max()) == (up, 2)
    full = scene_of(files)
    assert_close(full.splats, scene.scene().splats, 1e-5, 1e-6)
    assert (full.up, full.format) == (up, "3D Tiles 1.1 of GLB")
    assert full.notes == (tiles_3d.NOT_PLACED,)


def test_tiles_with_spz_round_trip_within_its_rounding_and_threads_change_no_byte() -> None:
    expected, files = tiles().scene().splats, files_of(tiles())
    back = scene_of(files)
    assert back.format == "3D Tiles 1.1 of GLB SPZ 3"
    np.testing.assert_allclose(back.splats.center, expected.center, atol=1e-3)
    np.testing.assert_allclose(np.log(back.splats.scale), np.log(expected.scale), atol=1 / 32 + 1e-5)
    np.testing.assert_allclose(back.splats.opacity, expected.opacity, atol=0.05)
    assert files_of(tiles(), threads=4) == files


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("up", [None, *AXES])
def test_tiles_are_upright_and_inside_their_boxes_in_a_viewer(up: str | None, profile: str) -> None:
    """A viewer applies the matrix of the node, and turns y up to z up."""
    files = files_of(tiles(up), profile)

    def check(tile: dict[str, Any]) -> None:
        data = files[tile["content"]["uri"]]
        gltf = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
        node = gltf["nodes"][0]
        if "matrix" in node:
            matrix = np.array(node["matrix"]).reshape(4, 4).T[:3, :3]
        else:
            matrix = Transform.from_quat(node.get("rotation", [0, 0, 0, 1])).rotation
        if up is not None:
            np.testing.assert_allclose(matrix @ AXES[up], [0, 1, 0], atol=1e-12)
        primitive = gltf["meshes"][0]["primitives"][0]
        bounds = gltf["accessors"][primitive["attributes"]["POSITION"]]
        ends = np.array([bounds["min"], bounds["max"]]) @ matrix.T
        ends = np.stack([ends[:, 0], -ends[:, 2], ends[:, 1]], axis=1)
        box = np.array(tile["boundingVolume"]["box"])
        half = np.abs(box[3:].reshape(3, 3)).sum(axis=0)
        assert (ends.min(axis=0) >= box[:3] - half - 1e-6).all() and (ends.max(axis=0) <= box[:3] + half + 1e-6).all()
        for below in tile.get("children", []):
            check(below)

    check(json.loads(files["tileset.json"])["root"])


def test_the_tileset_names_the_extensions_by_which_viewers_recognise_splats() -> None:
    head = json.loads(files_of(tiles())["tileset.json"])
    names = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    assert head["extensions"]["3DTILES_content_gltf"] == {"extensionsUsed": names, "extensionsRequired": names}
    assert head["extensionsUsed"] == ["3DTILES_content_gltf"]
    assert (head["asset"]["version"], head["root"]["refine"]) == ("1.1", "REPLACE")
    assert head["geometricError"] >= head["root"]["geometricError"] > 0
    assert len(head["root"]["transform"]) == 16


def test_large_subtrees_are_nested_tilesets() -> None:
    made = make_tiles(*quality.build(random_splats(3_000, sh_degree=0), 2.0), TileSettings(tile_splats=20))
    whole, nested = files_of(made, "khronos"), files_of(made, "khronos", most_tiles=60)
    inner = [name for name in nested if name.startswith("tiles/") and name.endswith(".json")]
    assert len(inner) > 2 and set(nested) - set(inner) == set(whole)
    assert len(nested["tileset.json"]) < len(whole["tileset.json"]) / 2
    one, other = tiles_of(whole), tiles_of(nested)
    for name in ("parent", "level", "counts", "errors", "bounds"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert_close(one.splats, other.splats, 0, 1e-6)
    assert len(scene_of(nested)) == 3_000


@pytest.mark.parametrize("corner", [3.3e38, 3.41e38, np.inf])
def test_bounds_beyond_float32_are_refused(corner: float) -> None:
    bounds = tiles().bounds.copy()
    bounds[0, 1] = corner
    scene = dataclasses.replace(tiles(), bounds=bounds)
    if corner > LARGEST:
        with pytest.raises(FormatError, match="beyond what float32 holds"):
            files_of(scene)
    else:
        assert tiles_of(files_of(scene)).bounds.max() == pytest.approx(corner)


def test_the_golden_file_is_read() -> None:
    expected = read_scene(FIXTURES / "sh1.ply").splats
    order = np.argsort(expected.center[:, 0], kind="stable")
    for path in (GOLDEN, GOLDEN / "tileset.json"):
        assert_close(read_scene(path).splats, expected.take(order), 2e-6, 1e-6)
    made = read_parts(GOLDEN)
    assert made.parent.tolist() == [-1, 0, 0, 2] and made.counts.tolist() == [10, 25, 12, 35]
    assert made.errors.tolist() == [1, 0, 0.5, 0]
    with open_reader(GOLDEN / "tileset.json", threads=2) as stream:
        blocks = [block for start in range(0, 60, 7) for block in stream.blocks(start, min(start + 7, 60))]
    assert_close(Splats.concat(blocks), expected.take(order), 2e-6, 1e-6)
    assert read_parts(FIXTURES / "sh1.ply") is None


def test_transforms_are_applied_except_that_of_the_root() -> None:
    # A quarter turn about z, twice the size, and up by 5, in the axes of the tileset.
    matrix = [0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 0, 0, 5, 1]
    files = child(transform=matrix)
    plain, moved = scene_of(two_tiles()).splats.center, scene_of(files).splats.center
    assert scene_of(two_tiles()).up == scene_of(files).up == tiles_of(files).up == "y"
    x, y, z = plain.T  # of glTF: y is up, so that its z is -y of the tileset
    np.testing.assert_allclose(moved, np.stack([2 * z, 2 * y + 5, -2 * x], axis=1), atol=1e-5)
    of_root = changed(lambda tileset: tileset["root"].update(transform=matrix))
    np.testing.assert_array_equal(scene_of(of_root).splats.center, plain)
    np.testing.assert_array_equal(tiles_of(of_root).transform[:3, 3], [0, 0, 5])


FAR = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 1e300, 0, 0, 1]
LARGE = [1e12, 0, 0, 0, 0, 1e12, 0, 0, 0, 0, 1e12, 0, 0, 0, 0, 1]


@pytest.mark.parametrize(
    ("files", "match"),
    [
        (child(implicitTiling={}), r"root\.children\[0\] has implicitTiling, which is not read"),
        (child(extensions={"3DTILES_implicit_tiling": {}}), "has implicit tiling, which is not read"),
        (child(contents=[]), "has contents, which is not read"),
        (child(refine="ADD"), "has refine 'ADD'; only REPLACE is read"),
        (child(content={"uri": "a.b3dm"}), r"has the content 'a\.b3dm'; only \.glb, \.gltf and tilesets are read"),
        (child(content={"uri": "https://x.example/a.glb"}), "is not a file below its folder"),
        (child(content={"uri": "../a.glb"}), "is not a file below its folder"),
        (child(content={"uri": "a.glb?v=1"}), "is not a file below its folder"),
        (child(content={"uri": "none.glb"}), "there is no 'none.glb'"),
        (child(content={}), r"root\.children\[0\]\.content\.uri of tileset\.json: expected a text, but it is missing"),
        (child(children={}), "expected a list, not {}"),
        (child(content={"uri": "tiles/0-0.glb"}, children=[{"content": {"uri": "tiles/0-0.glb"}}] * 2), "two tiles"),
        (child(transform=LARGE, children=[{"transform": LARGE}]), "multiply to numbers"),
        (child(transform=[0] * 15 + [1]), "is singular"),
        (changed(lambda each: each["root"].update(transform=FAR)), "root: transforms multiply to numbers beyond"),
        (child(transform=[1] * 16), "transform of .* is .*, not 16 finite numbers"),
        (child(transform=[1, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), "stretches, shears or mirrors"),
        (child(content={"uri": "tileset.json"}), "names the tileset 'tileset.json' twice"),
        (child(content={"uri": "other.json"}), "there is no 'other.json'"),
        (
            changed(lambda each: each["asset"].update(version="2.0")),
            r"version '2\.0' is unknown, only 1\.0 and 1\.1 are",
        ),
        (changed(lambda each: each.update(extensionsRequired=["X_y"])), "requires the extension 'X_y'"),
        (changed(lambda each: each.pop("root")), "root of tileset.json: expected an object, but it is missing"),
        (changed(lambda each: (each["root"].pop("content"), each["root"].pop("children"))), "no tile of it has splats"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_unsupported_and_broken_tilesets_are_refused(files: Files, match: str) -> None:
    with pytest.raises(FormatError, match=match):
        scene_of(files)


def test_nested_tilesets_in_a_circle_are_refused() -> None:
    root = json.loads(two_tiles()["tileset.json"])
    root["root"] = {"content": {"uri": "inner.json"}}
    inner = root | {"root": {"children": [{"content": {"uri": "inner.json"}}]}}
    with pytest.raises(FormatError, match=r"names the tileset 'inner\.json' twice"):
        scene_of({"tileset.json": json.dumps(root).encode(), "inner.json": json.dumps(inner).encode()})


@pytest.mark.parametrize(
    ("volume", "match"),
    [
        ({"region": [0] * 6}, "is a region, of which no box is made"),
        ({"box": [0] * 11}, "a box that has not 12 numbers"),
        ({"box": [None] * 12}, "something else than finite numbers"),
        ({"sphere": [0, 0, 0, -1]}, "a radius below 0"),
        ({}, "none of box, sphere and region"),
    ],
)
def test_a_wrong_bounding_volume_is_refused_by_readers_of_tiles(volume: Any, match: str) -> None:
    files = child(boundingVolume=volume)
    assert len(scene_of(files)) == 20
    with pytest.raises(FormatError, match=match):
        tiles_of(files)


def test_a_sphere_becomes_the_box_around_it() -> None:
    files = child(boundingVolume={"sphere": [1, 2, 3, 10]})
    np.testing.assert_allclose(tiles_of(files).bounds[1], [[-9, -7, -12], [11, 13, 8]])  # (x, y, z) is (x, z, -y)
