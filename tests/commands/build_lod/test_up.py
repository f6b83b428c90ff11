"""`build-lod --up` and what says of a file which axis points up: pictures of the output stand on their feet."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as api
from sparklod_cli.api.viewing import prepare
from sparklod_cli.cli import run
from sparklod_cli.images.metrics import psnr
from sparklod_cli.io.reading import read_parts, read_scene
from sparklod_cli.model.scene import AXES
from tests.commands.build_lod.runs import SMALL, build, convert
from tests.conftest import Capture

pytestmark = pytest.mark.slow

DEMO = Path(SMALL.parent, "demo.ply")

#: Names of outputs, and the options that write them: all formats of trees.
OUTPUTS = {
    "x.spz": (),
    "x.rad": (),
    "chunked.rad": ("--format", "rad-chunked"),
    "web/lod-meta.json": ("--method", "quick", "--levels", "30%"),
}


def render(path: Path, output: Path, *options: object) -> np.ndarray:
    command = ["render", path, "-o", output, "--size", "120x90", "--full", "-q", "--overwrite", *options]
    assert run([*map(str, command)]) == 0
    image: np.ndarray = np.load(output)
    return image


def inspected(path: Path, capsys: Capture) -> dict[str, object]:
    capsys.readouterr()
    assert run(["inspect", str(path), "--json"]) == 0
    report: dict[str, object] = json.loads(capsys.readouterr().out)
    return report


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo scene in every format of trees, turned so that y is up."""
    folder = tmp_path_factory.mktemp("turned")
    for name, options in OUTPUTS.items():
        assert build(DEMO, "-o", folder / name, "--up", "-y", "-q", *options) == 0
    return folder


@pytest.mark.parametrize("name", OUTPUTS)
def test_a_picture_of_the_turned_scene_is_that_of_the_scene(name: str, turned: Path, tmp_path: Path) -> None:
    output = tmp_path / "x.npy"
    before, after = render(DEMO, output), render(turned / name, output)
    on_its_head = render(turned / name, output, "--up=-y")
    assert psnr(before, after) > 35
    assert psnr(before, after) > psnr(before, on_its_head) + 15
    look = ("--look-at", "0,2,6:0,0,0")
    np.testing.assert_array_equal(render(turned / name, output, *look), render(turned / name, output, *look, "--up=y"))


@pytest.mark.parametrize("name", OUTPUTS)
def test_inspect_and_view_say_which_axis_is_up(name: str, turned: Path, tmp_path: Path, capsys: Capture) -> None:
    assert inspected(turned / name, capsys)["up"] == "y"
    assert run(["inspect", str(turned / name)]) == 0
    assert "y is up" in capsys.readouterr().out
    if name.endswith(".json"):
        assert read_parts(turned / name).up == "y"
        return
    assert shown_up(turned / name) == [0, 1, 0]
    assert shown_up(turned / name, up=(0.0, -1.0, 0.0)) == [0, -1, 0]


def shown_up(path: Path, **options: Any) -> list[float]:
    page = prepare([path], served=True, threads=1, **options).resources["view.json"]
    assert isinstance(page, bytes)
    found: list[float] = json.loads(page)["up"]
    return found


def test_traverse_and_the_api_go_around_the_axis_that_is_up(turned: Path, capsys: Capture) -> None:
    command = ["traverse", str(turned / "x.spz"), "--orbit", "3", "--elevation", "40", "--budget", "500", "--json"]
    summaries = []
    for up in ([], ["--up=y"], ["--up=-y"]):
        capsys.readouterr()
        assert run([*command, *up]) == 0
        summaries.append(json.loads(capsys.readouterr().out))
    noted, given, other = (summary["quantities"]["projected_px_p95"] for summary in summaries)
    assert noted == given != other
    tree = api.read(turned / "x.spz")
    assert tree.up == "y"
    around = [camera.position for camera in api.orbit(tree, count=3, elevation=40.0)]
    expected = [camera.position for camera in api.orbit(tree, count=3, elevation=40.0, up=(0.0, 1.0, 0.0))]
    np.testing.assert_array_equal(around, expected)
    assert all(position[1] > tree.splats.center[:, 1].mean() for position in around)


@pytest.mark.parametrize("options", [(), ("--rotate", "90,0,0"), ("--translate", "1,2,3")])
@pytest.mark.parametrize("suffix", [".spz", ".rad"])
def test_without_up_nothing_is_said(suffix: str, options: tuple[str, ...], tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / f"x{suffix}"
    assert build(SMALL, "-o", path, *options) == 0
    assert b'"up"' not in path.read_bytes()[:4096]
    assert inspected(path, capsys)["up"] is None


@pytest.mark.parametrize(
    ("options", "up"),
    [
        (("--up", "y"), "y"),
        (("--up", "z"), "y"),
        (("--up", "-y", "--rotate", "5,-70,3"), "y"),  # levelled
        (("--up", "y", "--rotate", "90,0,0"), "z"),
        (("--up", "-z", "--rotate", "0,0,-90", "--scale", 2), "x"),
    ],
)
def test_the_axis_turns_with_the_scene(options: tuple[str, ...], up: str, tmp_path: Path) -> None:
    assert build(SMALL, "-o", tmp_path / "x.rad", *options) == 0
    assert read_scene(tmp_path / "x.rad").up == up


def test_whatever_is_made_of_a_file_has_its_axis(turned: Path, tmp_path: Path, capsys: Capture) -> None:
    source = turned / "x.spz"
    for name, options in {"a.rad": (), "b.rad": ("--format", "rad-chunked"), "c.rad": ("--refine", 2)}.items():
        assert build(source, "-o", tmp_path / name, *options) == 0
    assert build(tmp_path / "a.rad", "-o", tmp_path / "d.spz") == 0
    for name in ("e.ply", "f.sog", "g.spz", "h.rad"):
        assert convert(tmp_path / "a.rad", tmp_path / name, "--leaves") == 0
    assert convert(tmp_path / "a.rad", tmp_path / "folder" / "meta.json") == 0
    assert build(tmp_path / "e.ply", "-o", tmp_path / "i.spz") == 0
    assert build(tmp_path / "f.sog", "-o", tmp_path / "j.rad", "--rotate", "-90,0,0") == 0
    assert {path.name: read_scene(path).up for path in tmp_path.glob("?.*") if path.suffix != ".radc"} == {
        **dict.fromkeys((f"{name}.rad" for name in "abch"), "y"),
        **dict.fromkeys(("d.spz", "e.ply", "f.sog", "g.spz", "i.spz"), "y"),
        "j.rad": "-z",
    }
    assert read_scene(tmp_path / "folder").up == "y"


def test_a_format_that_cannot_note_it_is_told(turned: Path, tmp_path: Path, capsys: Capture) -> None:
    assert convert(turned / "x.rad", tmp_path / "x.splat") == 0
    (option,) = re.findall(r"y is up, which this format cannot note; give (--up=y) to render", capsys.readouterr().err)
    output = tmp_path / "x.npy"
    assert psnr(render(DEMO, output), render(tmp_path / "x.splat", output, option)) > 35
    assert convert(turned / "x.rad", tmp_path / "x.ply") == 0
    assert "--up" not in capsys.readouterr().err


def test_merged_files_have_an_axis_if_it_is_the_same_for_all(turned: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert convert(turned / "x.rad", tmp_path / f"{name}.ply") == 0
    paths = {"both": ("a.ply", "b.ply"), "one": ("a.ply", str(SMALL))}
    for name, files in paths.items():
        assert build(*(tmp_path / file for file in files), "--merge", "-o", tmp_path / f"{name}.spz") == 0
    assert read_scene(tmp_path / "both.spz").up == "y"
    assert read_scene(tmp_path / "one.spz").up is None
    assert build(tmp_path / "a.ply", SMALL, "--merge", "--up", "-y", "-o", tmp_path / "given.spz") == 0
    assert read_scene(tmp_path / "given.spz").up == "y"


def test_instances_turn_the_axis(turned: Path, tmp_path: Path) -> None:
    half_turn = {"file": str(turned / "x.spz"), "rotation": [1, 0, 0, 0], "name": "turned"}
    scenes = {"turned": [half_turn], "both": [half_turn, {"file": str(turned / "x.spz"), "name": "not turned"}]}
    found = {}
    for name, instances in scenes.items():
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps({"instances": instances}))
        found[name] = api.orbit(api.read_instances(path), count=1, elevation=60.0).cameras[0].camera_to_world[1, 1]
    assert found["turned"] < 0  # y is down
    assert found["both"] < 0  # nothing is up in both, so that it is as training leaves scenes


@pytest.mark.parametrize("name", AXES)
def test_every_axis_can_be_noted(name: str, tmp_path: Path) -> None:
    scene = api.Scene(read_scene(SMALL).splats, up=name)
    for suffix in (".spz", ".rad", ".ply", ".sog"):
        api.write(tmp_path / f"x{suffix}", scene)
        assert read_scene(tmp_path / f"x{suffix}").up == name
        assert (
            api.orbit(read_scene(tmp_path / f"x{suffix}"), count=1).cameras[0].camera_to_world[:3, 1] @ AXES[name] > 0
        )


def test_a_wrong_axis_is_a_finding_and_ignored(turned: Path, tmp_path: Path, capsys: Capture) -> None:
    for name in ("x.spz", "x.rad"):
        data = (turned / name).read_bytes()
        assert data.count(b'"up": "y"' if name == "x.spz" else b'\\"up\\": \\"y\\"') == 1
        path = tmp_path / name
        path.write_bytes(data.replace(b'\\"y\\"', b'\\"q\\"').replace(b'"up": "y"', b'"up": "q"'))
        assert read_scene(path).up is None
        capsys.readouterr()
        assert run(["inspect", str(path), "--check", "--json"]) == 0
        report = json.loads(capsys.readouterr().out)
        assert report["up"] is None
        assert any("up axis" in each["message"] for each in report["findings"])
        assert run(["render", str(path), "-o", str(tmp_path / "x.png"), "--size", "9x9", "--overwrite"]) == 0


def test_no_scene_has_another_axis() -> None:
    with pytest.raises(ValueError, match=r"up is 'Y'; give one of x, -x, y"):
        api.Scene(read_scene(SMALL).splats, up="Y")
