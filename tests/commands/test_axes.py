"""Which axis is up: specified by a format, named by --up, noted in outputs, and the same for all commands."""

from __future__ import annotations

import gzip
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from fixtures import by_hand_glb, by_hand_tiles
from sparklod_cli.api.sites import prepare
from sparklod_cli.codecs import spz
from sparklod_cli.codecs.formats import WriteOptions
from sparklod_cli.images.metrics import psnr
from sparklod_cli.io.reading import read_parts, read_scene
from sparklod_cli.model.scene import ASSUMED, AXES, SPECIFIED, Scene
from tests.codecs.cases import linear
from tests.commands.cli import NAMED, Cli

#: The note on a file, after its name.
SENTENCE = "y is up, as {} specifies; if the scene is upside down, its converter kept y down: give --up -y"


def up_of(path: Path | str) -> str | None:
    return read_scene(Path(path)).up


# --- Files of other writers -------------------------------------------------------------------------------------------


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
    """Files of the same coordinates by sparklod and by other writers, with specified and with unknown axes."""
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


def is_upright(cli: Cli, path: Path | str, options: str = "") -> bool:
    """Return whether the upper half of a picture of a file is red."""
    cli(f"render {path} -o picture.npy --size 40x40 --full -f {options}")
    image = np.load("picture.npy")
    upper, lower = image[:20, :, :3].sum(axis=(0, 1)), image[20:, :, :3].sum(axis=(0, 1))
    assert (upper[0] > upper[2]) == (lower[0] < lower[2])
    return bool(upper[0] > upper[2])


def notes(cli: Cli, line: str) -> list[str]:
    """Return the lines of a command that are about axes; those of `inspect` are joined."""
    done = cli(line)
    inspects = line.startswith("inspect")
    lines = " ".join(done.out.split()).split("note ") if inspects else done.err.splitlines()
    return [line for line in lines if "specifies" in line or "the files differ" in line]


@pytest.mark.parametrize(("name", "form"), SPECIFYING.items())
def test_every_command_has_the_same_note_on_an_axis_that_the_format_specifies(
    name: str, form: str, folder: Path, cli: Cli
) -> None:
    path, sentence = folder / name, SENTENCE.format(form)
    lines = [
        f"render {path} --size 8x8 -f -o x.png",
        f"build-lod {path} -f -o x.rad",
        f"build-lod {path} -f -o y.rad --memory 1G",
        f"simplify {path} --to 50% -f -o x.ply",
    ]
    if name.endswith("tileset.json"):
        lines.append(f"traverse {path} --orbit 2 -f -o x.csv")
    elif name != "others-4.spz":  # which no viewer of a page reads
        lines.append(f"view {path} --export site -f")
    for line in lines:
        (note,) = notes(cli, line)
        assert note.endswith(sentence), line
        assert notes(cli, f"{line} --up -y") == [], line
    (note,) = notes(cli, f"inspect {path}")
    assert note.startswith(sentence)
    assert is_upright(cli, path) and not is_upright(cli, path, "--up -y")


@pytest.mark.parametrize("name", UNKNOWN)
def test_an_unknown_axis_is_assumed_without_a_note(name: str, folder: Path, cli: Cli) -> None:
    path = folder / name
    assert up_of(path) is None and ASSUMED == "-y" and set(SPECIFIED.values()) == {"y"}
    assert notes(cli, f"render {path} --size 8x8 -o x.png") == notes(cli, f"inspect {path}") == []
    assert is_upright(cli, path, "--up y") and not is_upright(cli, path)


@pytest.mark.parametrize("name", ["others-3.spz", "others.glb"])
@pytest.mark.parametrize(
    "output", ["x.spz", "x.rad", "x/lod-meta.json", "x/tileset.json", "x.ply", "x.sog", "x.glb", "small.spz"]
)
def test_a_specified_axis_is_noted_in_the_output(name: str, output: str, folder: Path, cli: Cli) -> None:
    command = "build-lod" if output.endswith((".rad", ".json", "x.spz")) else "simplify --to 50%"
    cli(f"{command} {folder / name} -o {output}")
    report = cli(f"inspect {output} --json").json
    assert (report["up"], report["up_by"]) == ("y", "")
    assert notes(cli, f"render {output} --size 8x8 -o x.png") == [] and is_upright(cli, output)


def test_files_that_differ_are_noted(folder: Path, cli: Cli) -> None:
    pair, differing = (
        f"{folder}/others-3.spz {folder}/plain.ply",
        "the files differ in the axis that is up (y, unknown), so",
    )
    lines = notes(cli, f"render {pair} --size 8x8 -o x.png")
    assert lines == [f"others-3.spz: {SENTENCE.format('SPZ')}", f"{differing} {ASSUMED} is taken; --up chooses"]
    for files, note, up in (
        (pair, f"  {differing} none is noted unless --up names it", None),
        (f"{folder}/others-3.spz {folder}/others-2.spz", f"  {SENTENCE.format('SPZ')}", "y"),
    ):
        assert notes(cli, f"build-lod {files} --merge -o x.rad -f") == [note]
        assert up_of("x.rad") == up
    cli(f"build-lod {pair} --merge --up -y -o x.rad -f")
    assert up_of("x.rad") == "y"


def test_a_turned_instance_has_another_axis(folder: Path, cli: Cli) -> None:
    cli.put("town.json", json.dumps({"instances": [{"file": f"{folder}/others-3.spz", "rotation": [1, 0, 0, 0]}]}))
    assert notes(cli, "render --scene town.json --size 8x8 -o x.png") == []
    assert notes(cli, "build-lod --scene town.json -o x.rad") == []
    assert up_of("x.rad") == "-y"


# --- Outputs of sparklod ----------------------------------------------------------------------------------------------

#: Outputs in every format of trees, turned so that y is up, and their options.
TURNED = {
    "x.spz": "",
    "x.rad": "",
    "chunked.rad": "--format rad-chunked",
    "web/lod-meta.json": "--method quick --levels 30%",
}


@pytest.fixture
def turned(cli: Cli) -> Cli:
    cli("build-lod sh3.ply -o x.spz --up -y -q")
    return cli


@pytest.mark.slow
@pytest.mark.parametrize("name", TURNED)
def test_a_picture_of_the_turned_scene_is_that_of_the_scene(name: str, cli: Cli) -> None:
    cli(f"build-lod demo.ply -o {name} --up -y -q {TURNED[name]}")
    how, look = "--size 120x90 --full -q -f", "--look-at 0,2,6:0,0,0"
    images = []
    for line in ("demo.ply", name, f"{name} --up=-y", f"{name} {look}", f"{name} {look} --up=y"):
        cli(f"render {line} {how} -o x.npy")
        images.append(np.load("x.npy"))
    before, after, on_its_head, noted, named = images
    assert psnr(before, after) > max(35, psnr(before, on_its_head) + 15)
    np.testing.assert_array_equal(noted, named)
    assert cli(f"inspect {name} --json").json["up"] == "y" and "y is up" in cli(f"inspect {name}").out
    if name.endswith(".json"):
        assert read_parts(Path("web")).up == "y"
        return
    options: dict[str, Any] = {"served": True, "threads": 1}
    for up, expected in ((None, [0, 1, 0]), ((0.0, -1.0, 0.0), [0, -1, 0])):  # on a page
        page = prepare([Path(name)], **options, **({"up": up} if up else {})).resources["view.json"]
        assert isinstance(page, bytes) and json.loads(page)["up"] == expected


def test_orbits_go_around_the_axis_that_is_up(turned: Cli) -> None:
    line = "traverse x.spz --orbit 3 --elevation 40 --budget 500 --json"
    noted, given, other = (
        turned(f"{line} {up}").json["quantities"]["projected_px_p95"] for up in ("", "--up=y", "--up=-y")
    )
    assert noted == given != other
    tree = sparklod.read("x.spz")
    around = [camera.position for camera in sparklod.orbit(tree, count=3, elevation=40.0)]
    expected = [camera.position for camera in sparklod.orbit(tree, count=3, elevation=40.0, up=(0.0, 1.0, 0.0))]
    np.testing.assert_array_equal(around, expected)
    assert all(position[1] > tree.splats.center[:, 1].mean() for position in around)
    half_turn = {"file": "x.spz", "rotation": [1, 0, 0, 0], "name": "turned"}
    for instances in ([half_turn], [half_turn, {"file": "x.spz", "name": "not turned"}]):
        turned.put("scene.json", json.dumps({"instances": instances}))
        (camera,) = sparklod.orbit(sparklod.read_instances("scene.json"), count=1, elevation=60.0).cameras
        assert camera.camera_to_world[1, 1] < 0  # y is down, or no axis is up in both, as training leaves scenes


@pytest.mark.parametrize(
    ("options", "up"),
    [
        ("--up y", "y"),
        ("--up z", "y"),
        ("--up -y --rotate 5,-70,3", "y"),  # levelled
        ("--up y --rotate 90,0,0", "z"),
        ("--up -z --rotate 0,0,-90 --scale 2", "x"),
    ],
)
def test_the_axis_turns_with_the_scene(options: str, up: str, cli: Cli) -> None:
    cli(f"build-lod sh2.ply -o x.rad {options}")
    assert up_of("x.rad") == up


def test_every_output_has_the_axis_of_its_input(turned: Cli) -> None:
    for line, up in (
        *(("build-lod x.spz -o a.rad", "y"), ("build-lod x.spz -o b.rad --format rad-chunked", "y")),
        *(("build-lod x.spz -o c.rad --refine 2", "y"), ("build-lod a.rad -o d.spz", "y")),
        *((f"convert a.rad --leaves {name}", "y") for name in ("e.ply", "f.sog", "g.spz", "h.rad", "web/meta.json")),
        *(("build-lod e.ply -o i.spz", "y"), ("build-lod f.sog -o j.rad --rotate -90,0,0", "-z")),
        *(("build-lod e.ply h.rad --merge -o k.spz", "y"), ("build-lod e.ply sh2.ply --merge -o l.spz", None)),
    ):
        turned(line)
        name = next(word for word in reversed(line.split()) if "." in word and not word.startswith("-"))
        assert up_of(name) == up, line
    err = turned("convert a.rad x.splat").err
    assert re.search("y is up, which this format cannot note; give --up=y to render", err)
    assert "--up" not in turned("convert a.rad x.ply").err


@pytest.mark.parametrize("name", AXES)
def test_every_axis_can_be_noted(name: str, tmp_path: Path) -> None:
    scene = Scene(read_scene(NAMED["sh2.ply"]).splats, up=name)
    for suffix in (".spz", ".rad", ".ply", ".sog"):
        sparklod.write(tmp_path / f"x{suffix}", scene)
        again = read_scene(tmp_path / f"x{suffix}")
        (camera,) = sparklod.orbit(again, count=1).cameras
        assert again.up == name and camera.camera_to_world[:3, 1] @ AXES[name] > 0
    with pytest.raises(ValueError, match=r"up is 'Y'; give one of x, -x, y"):
        Scene(scene.splats, up="Y")


@pytest.mark.parametrize("name", ["x.spz", "x.rad"])
def test_a_wrong_axis_is_a_finding_and_ignored(name: str, cli: Cli) -> None:
    cli(f"build-lod sh2.ply -o {name} --up -y")
    data = Path(name).read_bytes()
    assert data.count(b'"up": "y"' if name == "x.spz" else b'\\"up\\": \\"y\\"') == 1
    Path(name).write_bytes(data.replace(b'\\"y\\"', b'\\"q\\"').replace(b'"up": "y"', b'"up": "q"'))
    report = cli(f"inspect {name} --check --json").json
    assert report["up"] is None and any("up axis" in finding["message"] for finding in report["findings"])
    cli(f"render {name} -o x.png --size 9x9")
