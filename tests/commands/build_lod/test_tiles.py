"""3D Tiles out of `sparklod build-lod`: names, counts, places, trees, what is replaced, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.io.reading import read_parts, read_scene
from tests.commands.build_lod.runs import SMALL, build, convert
from tests.commands.build_lod.test_streamed_sog import TREE, files, written
from tests.conftest import Capture


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("town") / "town.ply", 2_000)


def head_of(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "tileset.json").read_text())
    return found


def test_what_is_reported_is_what_the_files_hold(town: Path, tmp_path: Path, capsys: Capture) -> None:
    city = tmp_path / "new" / "city"
    assert build(town, "-o", city / "tileset.json", "--tile-splats", 100, "--json") == 0
    record = json.loads(capsys.readouterr().out)
    made = read_parts(city)
    tiles = record["tiles"]
    assert (record["output_format"], record["method"], record["splats"]) == ("3d-tiles", "quality", 2_000)
    assert record["bytes"] == sum(map(len, files(city).values()))
    assert tiles["tiles"] == made.tiles == len(list(city.glob("tiles/*.glb")))
    assert tiles["levels"] == len(tiles["splats"]) == made.level.max() + 1
    assert tiles["splats"][-1] == 2_000 and tiles["splats"][0] == made.counts[0] <= 100
    assert tiles["error"] == made.errors[0] and not tiles["georeferenced"]
    np.testing.assert_array_equal(made.transform, np.eye(4))


def test_the_format_names_the_folder(tmp_path: Path, capsys: Capture) -> None:
    scene = written(tmp_path / "town.ply", 50)
    assert build(scene, "--format", "3d-tiles", "-o", tmp_path / "tileset.json") == 0
    assert build(scene, "--format", "3d-tiles") == 0
    assert head_of(tmp_path / "town-lod") == head_of(tmp_path)
    assert "1 tile of 1 level" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "origin"),
    [
        (["--lat", 0, "--lon", 0], [6_378_137, 0, 0]),
        (["--lat", 0, "--lon", 90, "--height", 100, "--heading", 45], [0, 6_378_237, 0]),
        (["--transform", "1 0 0 0 0 1 0 0 0 0 1 0 7 8 9 1"], [7, 8, 9]),
    ],
)
def test_a_tileset_stands_where_it_is_put(options: list[Any], origin: list[float], tmp_path: Path) -> None:
    assert build(SMALL, "-o", tmp_path / "tileset.json", *options) == 0
    np.testing.assert_allclose(read_parts(tmp_path).transform[:3, 3], origin, atol=1e-6)


def test_up_is_turned_once(tmp_path: Path) -> None:
    """By --up, or by the note of a tree whose splats stay as they are: the boxes are the same, and y up in content."""
    assert build(SMALL, "--up", "z", "-o", tmp_path / "turned" / "tileset.json", "--method", "quick") == 0
    assert build(SMALL, "--up", "z", "-o", tmp_path / "tree.rad", "--rad-center", "f32") == 0
    assert build(tmp_path / "tree.rad", "-o", tmp_path / "kept" / "tileset.json") == 0
    turned, kept = (read_parts(tmp_path / name) for name in ("turned", "kept"))
    assert turned.up == kept.up == "y"
    low, high = (read_scene(SMALL).splats.center[:, 2].min(), read_scene(SMALL).splats.center[:, 2].max())
    for name in ("turned", "kept"):
        box = head_of(tmp_path / name)["root"]["boundingVolume"]["box"]
        assert box[2] - box[11] <= low and high <= box[2] + box[11]


def test_a_tree_becomes_tiles(tmp_path: Path) -> None:
    assert build(TREE, "-o", tmp_path / "tileset.json", "--tile-splats", 1) == 0
    tree = read_scene(TREE).tree
    assert tree is not None and len(read_scene(tmp_path)) == np.count_nonzero(tree.is_leaf)


def test_tiles_become_other_files(town: Path, tmp_path: Path) -> None:
    assert build(town, "-o", tmp_path / "tiles" / "tileset.json", "--tile-splats", 500) == 0
    leaves = len(read_scene(tmp_path / "tiles"))
    assert build(tmp_path / "tiles", "-o", tmp_path / "again.spz") == 0
    assert convert(tmp_path / "again.spz", tmp_path / "leaves.ply") == 0
    assert len(read_scene(tmp_path / "leaves.ply")) == leaves
    assert build(tmp_path / "tiles" / "tileset.json", "-o", tmp_path / "web" / "lod-meta.json") == 0


def test_a_former_output_is_replaced_and_nothing_else(town: Path, tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "tileset.json"
    assert build(town, "-o", target, "--tile-splats", 100) == 0
    many = set(files(tmp_path))
    (tmp_path / "tiles" / "notes.txt").write_text("precious")
    (tmp_path / "tiles" / "77-7.glb").write_text("precious, for no tileset names it")
    assert build(town, "-o", target) == 1
    assert "exists, add --overwrite to replace it" in capsys.readouterr().err
    assert build(town, "-o", target, "--overwrite") == 0
    held = set(files(tmp_path))
    assert held == {"tileset.json", "tiles/0-0.glb", "tiles/notes.txt", "tiles/77-7.glb"} and len(many) > 10


def test_what_is_in_the_way_is_left(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "tiles").mkdir()
    (tmp_path / "tiles" / "0-0.glb").write_text("precious")
    assert build(SMALL, "-o", tmp_path / "tileset.json", "--overwrite") == 1
    assert "tileset.json there does not name it" in capsys.readouterr().err
    assert (tmp_path / "tiles" / "0-0.glb").read_text() == "precious"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--lat", 47], "--lat and --lon go together; give both"),
        (["--heading", 47], "give --lat and --lon, too"),
        (["--lat", 91, "--lon", 0], "91"),
        (["--lat", 1, "--lon", 0, "--transform", "1 0 0 0 0 1 0 0 0 0 1 0 7 8 9 1"], "cannot be used with"),
        (["--transform", "1,2,3"], "is not 16 finite numbers"),
        (["--transform", "1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1"], "flattens or mirrors"),
        (["--transform", "1 0 0 7 0 1 0 8 0 0 1 9 0 0 0 1"], "give it column by column"),
        (["--tile-splats", 0], "1 or more"),
        (["--levels", "50%"], "--levels is an option of Streamed SOG, not of 3D Tiles"),
        (["--spz-version", 2], "--spz-version is an option of SPZ, not of 3D Tiles"),
    ],
)
def test_wrong_usage(options: list[Any], message: str, tmp_path: Path, capsys: Capture) -> None:
    assert build(SMALL, "-o", tmp_path / "tileset.json", *options) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_options_of_tiles_need_tiles(tmp_path: Path, capsys: Capture) -> None:
    assert build(SMALL, "-o", tmp_path / "scene.spz", "--tile-splats", 10) == 2
    assert "--tile-splats is an option of 3D Tiles, not of SPZ; name the output tileset.json" in capsys.readouterr().err
    assert build(SMALL, "-o", tmp_path / "city.json", "--format", "3d-tiles") == 2
    assert "name the output" in capsys.readouterr().err


def test_the_profile_of_khronos_is_written_where_it_is_chosen(tmp_path: Path) -> None:
    assert build(SMALL, "-o", tmp_path / "tileset.json", "--glb-profile", "khronos") == 0
    assert read_scene(tmp_path).format == "3D Tiles 1.1 of GLB"
