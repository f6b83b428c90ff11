"""`sparklod build-lod --merge` and `--scene`: several files as one scene."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.settings import BakeSettings, Resources
from sparklod_cli.cli import run
from sparklod_cli.codecs import ply
from sparklod_cli.io.reading import Merged, read_scene
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from tests.commands.build_lod.runs import build
from tests.conftest import FIXTURES, Capture
from tests.scenes import random_splats

#: Where an instances file puts the second tile and the third, which is the first one again.
PLACES = (
    {"translation": [30, 0, -5], "rotation": [0.1, 0.7, 0, 0.7], "scale": 1.5},
    {"matrix": [0, -2, 0, 9, 2, 0, 0, 8, 0, 0, 2, 7, 0, 0, 0, 1]},
)


def put(path: Path, splats: Splats) -> Path:
    path.write_bytes(b"".join(ply.encode(Scene(splats))))
    return path


@pytest.fixture
def tiles(tmp_path: Path) -> list[Path]:
    return [put(tmp_path / f"tile-{k}.ply", random_splats(300, sh_degree=k)) for k in (1, 0)]


def baked(*arguments: object, capsys: Capture) -> dict[str, object]:
    assert build(*arguments, "--json", "-f") == 0
    out, _ = capsys.readouterr()
    found: dict[str, object] = json.loads(out)
    return found


def together(tiles: list[Path], transforms: tuple[Transform, ...]) -> Splats:
    """The splats of tiles as one file has them, each where it stands."""
    parts = []
    for path, transform in zip(tiles, transforms, strict=True):
        splats = read_scene(path).splats
        sh = np.zeros((len(splats), 3, 3), np.float32)
        sh[:, : splats.sh.shape[1]] = splats.sh
        parts.append(transform.apply(dataclasses.replace(splats, sh=sh)))
    return Splats.concat(parts)


def assert_leaves(path: Path, expected: Splats) -> None:
    """Checks that a tree is of these splats, up to the rounding of RAD's finest encodings."""
    scene = read_scene(path)
    assert isinstance(scene.tree, LodTree)
    found = scene.splats.take(scene.tree.is_leaf)
    places = [np.lexsort(np.round(splats.center, 3).T) for splats in (found, expected)]
    for column in COLUMNS:
        one, other = (getattr(splats, column)[place] for splats, place in zip((found, expected), places, strict=True))
        if column == "quat_xyzw":
            one = one * np.sign(np.einsum("ij,ij->i", one, other))[:, None]
        np.testing.assert_allclose(one, other, atol=2e-4, rtol=2e-4, err_msg=column)


EXACT = [f"--rad-{name}=f32" for name in ("alpha", "rgb", "orientation", "sh")]
EXACT += ["--rad-center=f32", "--rad-scales=f32"]


@pytest.mark.parametrize("method", ["quick", "quality"])
def test_merged_files_give_the_tree_of_one_that_holds_them_all(
    method: str, tiles: list[Path], tmp_path: Path, capsys: Capture
) -> None:
    whole = put(tmp_path / "whole.ply", together(tiles, (Transform(), Transform())))
    one = baked(whole, "-o", tmp_path / "one.rad", "--method", method, capsys=capsys)
    many = baked(*tiles, "--merge", "-o", tmp_path / "many.rad", "--method", method, capsys=capsys)
    assert (tmp_path / "many.rad").read_bytes() == (tmp_path / "one.rad").read_bytes()
    assert many["inputs"] == [str(tile) for tile in tiles]
    assert "input" not in many
    assert (many["read"], many["splats"], many["sh_degree"], many["nodes"]) == (600, 600, 1, one["nodes"])


def instances_file(tmp_path: Path, tiles: list[Path], **more: object) -> Path:
    entries = [{"file": tiles[0].name, **more}, {"file": tiles[1].name, **PLACES[0]}]
    entries.append({"file": tiles[0].name, **PLACES[1]})
    path = tmp_path / "city.json"
    path.write_text(json.dumps({"instances": entries}))
    return path


@pytest.mark.parametrize("flags", [[], ["--merge"]])
def test_an_instances_file_places_what_is_merged(
    flags: list[str], tiles: list[Path], tmp_path: Path, capsys: Capture
) -> None:
    city = instances_file(tmp_path, tiles)
    record = baked("--scene", city, *flags, "-o", tmp_path / "city.rad", *EXACT, capsys=capsys)
    x, _, _, w = np.array(PLACES[0]["rotation"]) / np.linalg.norm(PLACES[0]["rotation"])
    assert (x, w) != (0, 1)
    second = dataclasses.replace(
        Transform.from_quat(PLACES[0]["rotation"]), scale=1.5, translation=np.array([30.0, 0, -5])
    )
    third = dataclasses.replace(Transform.from_euler(0, 0, 90), scale=2.0, translation=np.array([9.0, 8, 7]))
    paths = [tiles[0], tiles[1], tiles[0]]
    assert record["inputs"] == [str(path) for path in paths]
    assert_leaves(tmp_path / "city.rad", together(paths, (Transform(), second, third)))


def test_pictures_of_a_merged_scene_are_those_of_its_instances(tmp_path: Path) -> None:
    splats = [random_splats(200, sh_degree=degree) for degree in (3, 1)]
    tiles = [
        put(tmp_path / f"{k}.ply", dataclasses.replace(each, scale=8 * each.scale)) for k, each in enumerate(splats)
    ]
    city = instances_file(tmp_path, tiles)
    assert build("--scene", city, "-o", tmp_path / "city.rad", *EXACT) == 0
    view = ["--look-at", "40,20,60:10,3,0", "--size", "200x150", "--full"]
    for name, what in (("one", ["--scene", str(city)]), ("other", [str(tmp_path / "city.rad")])):
        assert run(["render", *what, *view, "-o", str(tmp_path / f"{name}.png")]) == 0
    one, other = (np.asarray(Image.open(tmp_path / f"{name}.png"), np.int64) for name in ("one", "other"))
    assert one.std() > 5
    assert np.abs(one - other).max() <= 2


def test_selection_goes_by_where_the_tiles_stand(tiles: list[Path], tmp_path: Path, capsys: Capture) -> None:
    city = instances_file(tmp_path, tiles)
    centers = together([tiles[1]], (Transform(),)).center
    moved = Transform(Transform.from_quat(PLACES[0]["rotation"]).rotation, 1.5, np.array([30.0, 0, -5]))
    radius = 1.01 * 1.5 * float(np.linalg.norm(centers, axis=1).max())
    third = Transform.from_parts(rotate=(0, 0, 90), scale=2, translate=(9, 8, 7))
    others = together([tiles[0]] * 2, (Transform(), third))
    near = int((np.linalg.norm(others.center - moved.translation, axis=1) <= radius).sum())
    options = ["--within", f"30,0,-5,{radius}", "--translate", "0,99,0"]  # the second comes after the first
    record = baked("--scene", city, "-o", tmp_path / "x.spz", *options, capsys=capsys)
    assert (record["read"], record["splats"]) == (900, 300 + near)


def test_what_an_instance_says_to_viewers_is_said_to_be_left_out(
    tiles: list[Path], tmp_path: Path, capsys: Capture
) -> None:
    assert build("--scene", instances_file(tmp_path, tiles, lod_scale=2), "-o", tmp_path / "x.spz") == 0
    assert "lod_scale and foveation of instances are for viewers, and no part of a tree" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["a.ply", "b.ply", "--merge"], "--merge makes one file of all inputs; name it with --output"),
        (["--scene", "a.json"], "--scene makes one file of all inputs; name it with --output"),
        (["a.ply", "--merge", "--output-dir", "x"], "--output-dir cannot be used with --merge"),
        (["a.ply", "--merge", "-o", "x.spz", "--rgba", "c.npy"], "--rgba cannot be used with --merge"),
        (["a.ply", "--scene", "b.json", "-o", "x.spz"], "INPUT cannot be used with --scene, which names the files"),
        (["--merge", "-o", "x.spz"], "Missing argument 'INPUT...'"),
        (
            ["a.ply", "b.ply", "-o", "x.spz"],
            "--output takes one input, not 2; add --merge to bake them as one scene, or name a folder",
        ),
    ],
)
def test_contradictions_are_refused(arguments: list[str], text: str, capsys: Capture) -> None:
    assert build(*arguments) == 2
    assert text in capsys.readouterr().err


def test_a_tree_among_merged_files_is_refused_by_name(tmp_path: Path, capsys: Capture) -> None:
    tree = FIXTURES / "golden/tree-v3.spz"
    assert build(FIXTURES / "sh1.ply", tree, "--merge", "-o", tmp_path / "x.spz") == 1
    text = "tree-v3.spz: it is a Level-of-Detail file already; give the splats that it was built from"
    assert text in capsys.readouterr().err
    assert not (tmp_path / "x.spz").exists()


def test_the_output_is_none_of_the_files_that_an_instances_file_names(
    tiles: list[Path], tmp_path: Path, capsys: Capture
) -> None:
    assert build("--scene", instances_file(tmp_path, tiles), "-o", tiles[1], "-f", "--format", "spz") == 2
    assert build("--scene", instances_file(tmp_path, tiles), "-o", tmp_path / "city.json", "-f") == 2
    capsys.readouterr()


def test_what_goes_out_of_core_gives_the_same_tree(tiles: list[Path], tmp_path: Path) -> None:
    merged = Merged.of([tiles[0], FIXTURES / "golden/sh3-v3.spz", tiles[1]])
    for name, resources in (("in.spz", None), ("out.spz", Resources(block_splats=128))):
        bake(merged, tmp_path / name, BakeSettings(), resources=resources)
    assert (tmp_path / "out.spz").read_bytes() == (tmp_path / "in.spz").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.spz", "out.spz", "tile-0.ply", "tile-1.ply"]
