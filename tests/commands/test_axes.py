"""One rule on the axis that points up: formats that specify it are taken at their word, and every command says so."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import click
import numpy as np
import pytest

import sparklod_cli as sparklod
from fixtures import by_hand_glb, by_hand_tiles
from sparklod_cli.cli import COMMANDS, cli, run
from sparklod_cli.codecs import spz
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.model.scene import ASSUMED, SPECIFIED, Scene
from tests.codecs.cases import linear
from tests.conftest import Capture

#: What is told of a file, after its name.
SENTENCE = "y is up, as {} specifies; if the scene is upside down, its converter kept y down: give --up -y"


def scene() -> Scene:
    """A scene that is red where y is large, and blue where it is small."""
    rng = np.random.default_rng(3)
    center = rng.uniform(-0.2, 0.2, (60, 3))
    center[:, 1] = np.where(np.arange(60) < 30, -1, 1) + center[:, 1]
    red = (center[:, 1:2] > 0) * 1.0
    rgb = np.hstack([0.1 + 0.8 * red, np.full((60, 1), 0.1), 0.9 - 0.8 * red])
    return Scene.from_arrays(center, np.full((60, 3), 0.08), np.tile([0, 0, 0, 1.0], (60, 1)), np.full(60, 0.9), rgb)


def of_others(data: bytes) -> bytes:
    """Return an SPZ without the comment by which sparklod knows its own."""
    return gzip.compress(gzip.decompress(data))


def encoded(version: int) -> bytes:
    return b"".join(spz.encode(scene(), WriteOptions(spz_version=version)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of the same coordinates, by sparklod and by others, whose axes their format specifies or nobody knows."""
    folder = tmp_path_factory.mktemp("axes")
    for version in (2, 3):
        (folder / f"others-{version}.spz").write_bytes(of_others(encoded(version)))
        (folder / f"ours-{version}.spz").write_bytes(encoded(version))
    (folder / "others-4.spz").write_bytes(encoded(4))  # without a record of its axes
    (folder / "others.glb").write_bytes(by_hand_glb.glb(**linear(scene())))
    sparklod.write(folder / "ours.glb", scene())
    sparklod.write(folder / "plain.ply", scene())
    sparklod.write(folder / "plain.sog", scene())
    tree = sparklod.build_lod(scene())
    sparklod.write(folder / "tree.spz", tree)
    (folder / "tree-of-others.spz").write_bytes(of_others((folder / "tree.spz").read_bytes()))
    sparklod.write(folder / "tree.rad", tree)
    files = by_hand_tiles.tileset_files(by_hand_tiles.Tile(linear(scene())), by_hand_glb.glb)
    for name, content in files.items():
        (folder / "city" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "city" / name).write_bytes(content)
    return folder


SPECIFYING = {
    "others-2.spz": "SPZ",
    "others-3.spz": "SPZ",
    "others-4.spz": "SPZ",
    "others.glb": "glTF",
    "city/tileset.json": "glTF",
}
UNKNOWN = [
    *("ours-2.spz", "ours-3.spz", "ours.glb", "plain.ply", "plain.sog"),
    *("tree.spz", "tree-of-others.spz", "tree.rad"),
]


def is_upright(path: Path, tmp_path: Path, *options: str) -> bool:
    """Return whether the upper half of a picture of a file is red."""
    output = tmp_path / "picture.npy"
    assert run(["render", str(path), "-o", str(output), "--size", "40x40", "--full", "-f", *options]) == 0
    image = np.load(output)
    upper, lower = image[:20, :, :3].sum(axis=(0, 1)), image[20:, :, :3].sum(axis=(0, 1))
    assert (upper[0] > upper[2]) == (lower[0] < lower[2])
    return bool(upper[0] > upper[2])


def told(capsys: Capture, *arguments: object) -> list[str]:
    """Return the lines of a command that are about axes; those of `inspect` are joined."""
    capsys.readouterr()
    assert run([*map(str, arguments)]) == 0
    out, err = capsys.readouterr()
    text = out if arguments[0] == "inspect" else err
    lines = " ".join(text.split()).split("note ") if arguments[0] == "inspect" else text.splitlines()
    return [line for line in lines if "specifies" in line or "the files differ" in line]


@pytest.mark.parametrize(("name", "form"), SPECIFYING.items())
def test_every_command_says_the_same_of_an_axis_that_the_format_specifies(
    name: str, form: str, folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    path, sentence = folder / name, SENTENCE.format(form)
    commands: list[tuple[object, ...]] = [
        ("render", path, "--size", "8x8", "-f", "-o", tmp_path / "x.png"),
        ("view", path, "--export", tmp_path / "site", "-f"),
        ("build-lod", path, "-f", "-o", tmp_path / "x.rad"),
        ("build-lod", path, "-f", "-o", tmp_path / "y.rad", "--memory", "1G"),
        ("simplify", path, "--to", "50%", "-f", "-o", tmp_path / "x.ply"),
    ]
    if name.endswith("tileset.json"):
        commands[1:2] = [("traverse", path, "--orbit", "2", "-f", "-o", tmp_path / "x.csv")]
    elif name == "others-4.spz":
        del commands[1]  # no viewer of a page reads it
    for command in commands:
        (line,) = told(capsys, *command)
        assert line.endswith(sentence), command
        assert told(capsys, *command, "--up", "-y") == [], command
    (line,) = told(capsys, "inspect", path)
    assert line.startswith(sentence)
    assert is_upright(path, tmp_path) and not is_upright(path, tmp_path, "--up", "-y")


@pytest.mark.parametrize("name", UNKNOWN)
def test_an_axis_that_nobody_knows_is_assumed_and_not_noted(
    name: str, folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    path = folder / name
    assert sparklod.read(path).up is None
    assert (
        told(capsys, "render", path, "--size", "8x8", "-o", tmp_path / "x.png") == told(capsys, "inspect", path) == []
    )
    assert not is_upright(path, tmp_path)
    assert is_upright(path, tmp_path, "--up", "y")
    assert ASSUMED == "-y" and set(SPECIFIED.values()) == {"y"}


@pytest.mark.parametrize("name", ["others-3.spz", "others.glb"])
@pytest.mark.parametrize(
    "output", ["x.spz", "x.rad", "x/lod-meta.json", "x/tileset.json", "x.ply", "x.sog", "x.glb", "small.spz"]
)
def test_an_axis_that_a_format_specifies_is_noted_in_the_output(
    name: str, output: str, folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    target = tmp_path / output
    trees = target.suffix in (".rad", ".json") or output == "x.spz"
    command = ["build-lod"] if trees else ["simplify", "--to", "50%"]
    assert run([*command, str(folder / name), "-o", str(target)]) == 0
    capsys.readouterr()
    assert run(["inspect", str(target), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["up"], report["up_by"]) == ("y", "")
    assert told(capsys, "render", target, "--size", "8x8", "-o", tmp_path / "x.png") == []
    assert is_upright(target, tmp_path)


@pytest.mark.parametrize("way", ["convert", "simplify"])
def test_a_plain_spz_of_sparklod_has_the_axes_of_what_it_was_made_from(way: str, folder: Path, tmp_path: Path) -> None:
    target, tree = tmp_path / "x.spz", folder / "tree.rad"
    options = [str(target), "--leaves"] if way == "convert" else ["--to", "90%", "-o", str(target)]
    assert run([way, str(tree), *options]) == 0
    assert sparklod.read(target).up is None
    assert not is_upright(target, tmp_path)


def test_files_that_differ_are_told(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    pair = folder / "others-3.spz", folder / "plain.ply"
    lines = told(capsys, "render", *pair, "--size", "8x8", "-o", tmp_path / "x.png")
    differing = "the files differ in the axis that is up (y, unknown), so "
    assert lines == [f"others-3.spz: {SENTENCE.format('SPZ')}", f"{differing}{ASSUMED} is taken; --up chooses"]
    lines = told(capsys, "build-lod", *pair, "--merge", "-o", tmp_path / "x.rad")
    assert lines == [f"  {differing}none is noted unless --up names it"]
    assert sparklod.read(tmp_path / "x.rad").up is None
    (line,) = told(capsys, "build-lod", pair[0], folder / "others-2.spz", "--merge", "-o", tmp_path / "y.rad")
    assert line == f"  {SENTENCE.format('SPZ')}"
    assert sparklod.read(tmp_path / "y.rad").up == "y"


def test_an_instance_that_is_turned_has_another_axis(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    instances = {"instances": [{"file": str(folder / "others-3.spz"), "rotation": [1, 0, 0, 0]}]}
    (tmp_path / "town.json").write_text(json.dumps(instances))
    assert told(capsys, "render", "--scene", tmp_path / "town.json", "--size", "8x8", "-o", tmp_path / "x.png") == []
    assert told(capsys, "build-lod", "--scene", tmp_path / "town.json", "-o", tmp_path / "x.rad") == []
    assert sparklod.read(tmp_path / "x.rad").up == "-y"


@pytest.mark.parametrize("name", COMMANDS)
def test_up_is_in_the_short_help_of_every_command_that_has_it(name: str, capsys: Capture) -> None:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    assert run([name, "--help"]) == 0
    has_it = any(parameter.name == "up" for parameter in command.params)
    assert has_it == (name in ("build-lod", "convert", "simplify", "render", "traverse", "view"))
    assert (" --up " in capsys.readouterr().out) == has_it
