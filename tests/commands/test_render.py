"""`sparklod render` as a shell sees it: pictures, exit codes, what goes where, and files that are whole or absent."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sparklod_cli import limits
from sparklod_cli.cli import run
from sparklod_cli.preview import scenery
from sparklod_cli.preview.metrics import psnr
from sparklod_cli.preview.pictures import Painter
from sparklod_cli.preview.sheet import cells
from sparklod_cli.render.backends import BACKENDS
from tests.conftest import FIXTURES, ROOT

TOWN, TREE = FIXTURES / "traverse" / "town.spz", FIXTURES / "golden" / "hand-tree-v3.spz"
DEMO, PLAIN = FIXTURES / "demo.ply", FIXTURES / "sh2.ply"
FAULTS, CAMERAS = FIXTURES / "faults", FIXTURES / "cameras"
SIZE = ("--size", "160x90")
AT = ("--look-at", "0,-3,9:0,0,0")

Said = pytest.CaptureFixture[str]


def render(*arguments: object) -> int:
    return run(["render", *map(str, arguments)])


def pixels(path: Path | io.BytesIO) -> np.ndarray:
    with Image.open(path) as picture:
        return np.array(picture)


def floats(path: Path) -> np.ndarray:
    image: np.ndarray = np.load(path)
    assert image.dtype == np.float32
    return image


@pytest.fixture(scope="module", autouse=True)
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A baked tree; from here on nothing is compiled any more, which would be said."""
    folder = tmp_path_factory.mktemp("baked")
    assert run(["build-lod", str(DEMO), "--output-dir", str(folder), "-q"]) == 0
    assert render(PLAIN, TOWN, *SIZE, "-q", "-o", folder / "warm.png") == 0
    assert render(TOWN, *SIZE, "-q", "--style", "billboards", "-o", folder / "warm2.png") == 0
    return folder / "demo-lod.spz"


def test_a_picture_of_a_tree(built: Path, tmp_path: Path, capsys: Said) -> None:
    output = tmp_path / "preview.png"
    assert render(built, "--budget", "5k", "--size", "320x180", "-o", output) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"{output}  320 x 180, ")
    assert err.count("\n") == 1
    image = pixels(output)
    assert image.shape == (180, 320, 3)
    assert image.any(axis=2).mean() > 0.2
    assert [path.name for path in tmp_path.iterdir()] == ["preview.png"]


def test_the_name_is_made_of_the_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert render(PLAIN, *SIZE, "-q") == 0
    assert render(TOWN, *SIZE, "-q", "--orbit", 2, "--budget", "1k") == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sh2.png", "town.0000.png", "town.0001.png"]
    assert render(PLAIN, *SIZE, "-q") == 1
    assert render(PLAIN, *SIZE, "-q", "--overwrite") == 0


@pytest.mark.parametrize(
    "file", [*sorted(FIXTURES.glob("golden/*")), *sorted(FIXTURES.glob("*.ply"))], ids=lambda p: p.name
)
def test_every_format_is_drawn(file: Path, tmp_path: Path) -> None:
    if file.suffix not in (".ply", ".spz", ".splat", ".ksplat", ".sog") or file.stem in ("huge", "flat", "points"):
        pytest.skip("not a scene to look at")
    assert render(file, "--size", "64x48", "-q", "-o", tmp_path / "x.png") == 0


def test_the_leaves_of_a_tree_are_the_scene_that_it_was_made_of(built: Path, tmp_path: Path) -> None:
    how = ("--size", "320x180", *AT, "-q")
    assert render(DEMO, *how, "-o", tmp_path / "plain.npy") == 0
    assert render(built, *how, "--full", "-o", tmp_path / "tree.npy") == 0
    assert render(DEMO, *how, "--through", "spz", "-o", tmp_path / "rounded.npy") == 0
    assert render(built, *how, "--budget", 500, "-o", tmp_path / "cut.npy") == 0
    plain, tree, rounded, cut = (floats(tmp_path / f"{name}.npy") for name in ("plain", "tree", "rounded", "cut"))
    assert psnr(plain, tree) > 45
    assert psnr(rounded, tree) > psnr(plain, tree)
    assert psnr(plain, cut) < psnr(plain, tree) - 10


def test_floats_are_premultiplied_and_pixels_are_not(tmp_path: Path) -> None:
    how = (DEMO, *SIZE, *AT, "-q")
    assert render(*how, "-o", tmp_path / "x.npy") == 0
    image = floats(tmp_path / "x.npy")
    assert image.shape == (90, 160, 4)
    assert (image[..., :3].max(axis=2) <= image[..., 3] + 1e-5).all()
    alpha = image[..., 3:]
    for color, rgb in (
        ("black", (0, 0, 0)),
        ("white", (1, 1, 1)),
        ("#ff8000", (1, 128 / 255, 0)),
        ("#f80", (1, 136 / 255, 0)),
    ):
        assert render(*how, "--background", color, "-o", tmp_path / "x.png", "--overwrite") == 0
        expected = np.rint(255 * np.clip(image[..., :3] + (1 - alpha) * np.array(rgb), 0, 1))
        assert np.abs(pixels(tmp_path / "x.png") - expected).max() <= 1
    assert render(*how, "--background", "white", "-o", tmp_path / "x.npy", "--overwrite") == 0
    assert np.allclose(floats(tmp_path / "x.npy")[..., :3], image[..., :3] + (1 - alpha), atol=1e-6)
    for said in (("--alpha",), ("--background", "transparent")):
        for name in ("x.png", "x.webp"):
            assert render(*how, *said, "-o", tmp_path / name, "--overwrite") == 0
            codes = pixels(tmp_path / name)
            assert codes.shape == (90, 160, 4)
            assert np.abs(codes[..., 3] - 255 * image[..., 3]).max() <= 0.51
            solid = image[..., 3] > 0.05
            assert np.abs(codes[solid][:, :3] - np.clip(255 * image[solid][:, :3] / alpha[solid], 0, 255)).max() <= 0.6


def test_frames_of_a_path_are_its_views(tmp_path: Path, capsys: Said) -> None:
    how = (TOWN, "--budget", "2k", *SIZE, "-q")
    views = ["-6,-2,-6:0,0,0", "0,-1,-3:0,-0.5,0"]
    keys = ("--keyframes", " ".join(views), "--seconds", 1, "--fps", 4)
    for jobs in (1, 3):
        folder = tmp_path / f"jobs{jobs}"
        folder.mkdir()
        assert render(*how, *keys, "-o", folder / "out.%04d.png", "--jobs", jobs) == 0
        assert sorted(path.name for path in folder.iterdir()) == [f"out.{n:04d}.png" for n in range(5)]
    for n in range(5):
        name = f"out.{n:04d}.png"
        assert (tmp_path / "jobs1" / name).read_bytes() == (tmp_path / "jobs3" / name).read_bytes()
    for number, view in ((0, views[0]), (4, views[1])):
        assert render(*how, f"--look-at={view}", "-o", tmp_path / "one.png", "--overwrite") == 0
        assert np.array_equal(pixels(tmp_path / "one.png"), pixels(tmp_path / "jobs1" / f"out.{number:04d}.png"))
    assert render(*how, *keys, "--every", 2, "-o", tmp_path / "f%d.npy") == 0
    assert sorted(path.name for path in tmp_path.glob("*.npy")) == ["f0.npy", "f2.npy", "f4.npy"]
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("path", sorted(CAMERAS.iterdir()), ids=lambda path: path.name)
def test_every_format_of_cameras_makes_frames(path: Path, tmp_path: Path) -> None:
    if path.name.startswith("open3d"):
        pytest.importorskip("open3d")
    how = ("--camera-path", path, "--size", "64x48", "-q")
    assert render(TREE, *how, "-o", tmp_path / "out.%04d.png") == 0
    assert len(list(tmp_path.glob("out.*.png"))) >= 3


def test_several_views_make_a_contact_sheet(tmp_path: Path) -> None:
    views = ["0,-3,9:0,0,0", "9,-3,0:0,0,0", "0,-9,1:0,0,0"]
    how = (DEMO, *SIZE, "-q")
    assert render(*how, *(f"--view={view}" for view in views), "-o", tmp_path / "sheet.png") == 0
    sheet = pixels(tmp_path / "sheet.png")
    for (x, y), view in zip(cells(3, (160, 90)), views, strict=True):
        assert render(*how, f"--look-at={view}", "-o", tmp_path / "one.png", "--overwrite") == 0
        one = pixels(tmp_path / "one.png")
        assert np.array_equal(sheet[y : y + 90, x : x + 160], one)
    assert render(*how, f"--view={views[2]}", "-o", tmp_path / "view.png") == 0
    assert np.array_equal(pixels(tmp_path / "view.png"), one)
    assert render(*how, "--orbit", 4, "--sheet", "-o", tmp_path / "orbit.webp") == 0
    assert pixels(tmp_path / "orbit.webp").shape[0] > 180


@pytest.mark.parametrize("form", ["gif", "webp", "mp4"])
def test_an_animation(form: str, tmp_path: Path, capsys: Said) -> None:
    if form == "mp4":
        pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    output = tmp_path / f"orbit.{form}"
    assert render(DEMO, *SIZE, "--orbit", 5, "-o", output) == 0
    assert capsys.readouterr().err.startswith(f"{output}  5 frames, 160 x 90, ")
    if form == "mp4":
        assert output.read_bytes()[4:8] == b"ftyp"
        return
    with Image.open(output) as picture:
        assert picture.n_frames == 5
        assert picture.size == (160, 90)


def test_mp4_without_imageio_is_an_error_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said
) -> None:
    monkeypatch.setitem(sys.modules, "imageio", None)
    monkeypatch.setattr(Painter, "draw", None)
    assert render(DEMO, "--orbit", 3, "-o", tmp_path / "x.mp4") == 1
    assert "pip install 'sparklod[video]'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_standard_output_is_a_png(capfdbinary: pytest.CaptureFixture[bytes], tmp_path: Path) -> None:
    assert render(PLAIN, *SIZE, "-o", "-", "-q") == 0
    out, err = capfdbinary.readouterr()
    assert err == b""
    assert render(PLAIN, *SIZE, "-o", tmp_path / "x.png", "-q") == 0
    assert out == (tmp_path / "x.png").read_bytes()


def test_two_runs_give_the_same_bytes(tmp_path: Path) -> None:
    made = set()
    for threads in (1, 2):
        assert render(TOWN, PLAIN, *SIZE, "--threads", threads, "-o", tmp_path / f"{threads}.png", "-q") == 0
        made.add((tmp_path / f"{threads}.png").read_bytes())
    assert len(made) == 1


def test_json_says_what_was_drawn(tmp_path: Path, capsys: Said) -> None:
    output = tmp_path / "out.%04d.png"
    assert render(TOWN, *SIZE, "--budget", "3k", "--orbit", 3, "--json", "-q", "-o", output) == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert err == ""
    assert (report["output"], report["format"], report["kind"]) == (str(output), "png", "frames")
    assert [frame["frame"] for frame in report["frames"]] == [0, 1, 2]
    assert all(0 < frame["splats"] <= 3000 for frame in report["frames"])
    assert [frame["file"] for frame in report["frames"]] == [str(tmp_path / f"out.000{n}.png") for n in range(3)]
    assert report["bytes"] == sum(path.stat().st_size for path in tmp_path.iterdir())


def test_a_difference_and_its_psnr(built: Path, tmp_path: Path, capsys: Said) -> None:
    how = (*SIZE, *AT)
    assert render(DEMO, *how, "--diff", DEMO, "-o", tmp_path / "same.png", "--json", "-q") == 0
    assert json.loads(capsys.readouterr().out)["frames"][0]["psnr_db"] == 100
    assert not pixels(tmp_path / "same.png").any()
    for name, said in (("a", (built, "--budget", 300)), ("b", (DEMO,))):
        assert render(*said, *how, "-q", "-o", tmp_path / f"{name}.npy", "--background", "white") == 0
    a, b = (floats(tmp_path / f"{name}.npy")[..., :3] for name in "ab")
    settings = (built, "--budget", 300, *how, "--diff", DEMO, "--background", "white", "--gain", 3, "--json")
    assert render(*settings, "-o", tmp_path / "d.png") == 0
    out, err = capsys.readouterr()
    value = json.loads(out)["frames"][0]["psnr_db"]
    assert value == pytest.approx(psnr(np.clip(a, 0, 1), np.clip(b, 0, 1)), abs=2e-3)
    assert f"PSNR {value:.2f} dB" in err
    expected = np.rint(255 * np.clip(3 * np.abs(np.clip(a, 0, 1) - np.clip(b, 0, 1)), 0, 1))
    assert np.abs(pixels(tmp_path / "d.png") - expected).max() <= 1


def test_a_difference_says_what_it_shows(built: Path, tmp_path: Path, capsys: Said) -> None:
    how = (built, "--budget", 300, "--size", "400x240", *AT, "--diff", DEMO, "--json")
    assert render(*how, "-o", tmp_path / "bar.png") == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert f"differences {report['gain']:g} times as strong" in err
    bar = pixels(tmp_path / "bar.png")
    assert report["frames"][0]["width"] == bar.shape[1] > 400
    assert render(*how, "-o", tmp_path / "same.png", "--gain", report["gain"], "--no-bar") == 0
    assert np.array_equal(pixels(tmp_path / "same.png"), bar[:, :400])
    assert bar[:, :400].max() > 90


def test_the_time_that_is_said_is_the_whole_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said) -> None:
    whole = scenery.read_scenery

    def slow(*arguments: Any, **named: Any) -> Any:
        time.sleep(0.5)
        return whole(*arguments, **named)

    monkeypatch.setattr(scenery, "read_scenery", slow)
    assert render(PLAIN, *SIZE, "--json", "-o", tmp_path / "x.png") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["seconds"] >= 0.5
    assert float(err.rsplit(" ", 2)[1]) >= 0.5


def test_an_encoding_is_seen_in_the_difference_to_the_file_itself(tmp_path: Path, capsys: Said) -> None:
    values = {}
    for through in limits.THROUGH:
        settings = (PLAIN, *SIZE, "--through", through, "--diff", PLAIN, "--json", "-q")
        assert render(*settings, "-o", tmp_path / f"{through}.png") == 0
        values[through] = json.loads(capsys.readouterr().out)["frames"][0]["psnr_db"]
    assert all(25 < value < 100 for value in values.values())
    assert len(set(values.values())) == len(values)


@pytest.mark.parametrize("by", limits.COLOR_BY)
def test_colours_that_mean_something(by: str, tmp_path: Path) -> None:
    how = (TOWN, "--budget", "4k", "--size", "480x270", "-q", "--color-by", by)
    assert render(*how, "-o", tmp_path / "bar.png") == 0
    assert render(*how, "--no-bar", "-o", tmp_path / "no.png") == 0
    bar, no = pixels(tmp_path / "bar.png"), pixels(tmp_path / "no.png")
    assert no.any()
    assert bar.shape[1] > no.shape[1] == 480
    assert np.array_equal(bar[:, :480], no), "it hides nothing"
    assert render(*how, "-o", tmp_path / "x.npy") == 0
    image = floats(tmp_path / "x.npy")
    assert image.shape == ((270, 480) if by in ("overdraw", "depth") else (270, 480, 4))


@pytest.mark.parametrize("style", limits.STYLES)
def test_styles(style: str, tmp_path: Path) -> None:
    assert render(TOWN, "--budget", "4k", *SIZE, "-q", "--style", style, "-o", tmp_path / "x.png") == 0
    assert pixels(tmp_path / "x.png").any()


def test_a_scene_file_says_what_stands_where(tmp_path: Path, capsys: Said) -> None:
    shutil.copy(TREE, tmp_path / "tree.spz")
    shutil.copy(PLAIN, tmp_path / "plain.ply")
    scene = tmp_path / "scene.json"
    how = (*SIZE, "--look-at", "0,0,-9:0,0,0", "--json", "-q")
    counts = []
    for instances in ([{"file": "tree.spz"}], [{"file": "tree.spz"}, {"file": "plain.ply", "translation": [3, 0, 0]}]):
        scene.write_text(json.dumps({"instances": instances}))
        assert render("--scene", scene, *how, "-o", tmp_path / f"{len(instances)}.png") == 0
        counts.append(json.loads(capsys.readouterr().out)["frames"][0]["splats"])
    assert counts[1] > counts[0]
    one, two = (pixels(tmp_path / f"{n}.png") for n in (1, 2))
    assert (one != two).any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "a FILE is missing, or --scene"),
        ([TREE, "--scene", "s.json"], "--scene names the files; leave out FILE"),
        ([TREE, "--budget", "many"], "--budget"),
        ([TREE, "--budget", "5k", "--preset", "quest"], "--budget and --preset exclude each other"),
        ([TREE, "--far", "1e308"], "--far"),
        ([TREE, "--full", "--budget", "5k"], "--budget cannot be used with --full"),
        ([TREE, TREE, "--budget", "1"], "a budget of 1 splat is less than one for each of 2 instances"),
        ([TREE, "--chunk-cache", "5"], "No such option"),
        ([TREE, "--bandwidth", "5Mbit"], "No such option"),
        ([TREE, "--view", "0,0,9:0,0,0", "--orbit", "3"], "--view and --orbit cannot go together"),
        ([TREE, "--view", "0,0,0:0,0,0"], "looks at the point where it is"),
        ([TREE, "--orbit", "3", "--dolly"], "--orbit and --dolly cannot go together"),
        ([TREE, "--background", "red"], "'red' is not a colour"),
        ([TREE, "--background", "#12345"], "is not a colour"),
        ([TREE, "--alpha", "--background", "white"], "--alpha keeps what --background would fill"),
        ([TREE, "--alpha", "-o", "x.gif"], ".gif has no alpha"),
        ([TREE, "--alpha", "-o", "x.mp4"], ".mp4 has no alpha"),
        ([TREE, "--supersample", "5"], "--supersample"),
        ([TREE, "--supersample", "0"], "--supersample"),
        ([TREE, "--size", "65536x65536"], "are more than 134,217,728; see --size"),
        ([TREE, "--size", "9000x9000", "--supersample", "2"], "9,000 x 9,000 pixels x 4 (--supersample 2)"),
        ([TREE, "--size", "17000x10", "-o", "x.webp"], "more than 16,383 a side"),
        ([TREE, "--near", "5", "--far", "5"], "--near 5 is not less than --far 5"),
        ([TREE, "--near", "0"], "--near"),
        ([TREE, "--style", "cubes"], "--style"),
        ([TREE, "--style", "points", "--backend", "numba"], "has no --style points"),
        ([TREE, "--color-by", "opacity"], "--color-by"),
        ([TREE, "--color-by", "overdraw", "--style", "points"], "--color-by overdraw counts splats"),
        ([TREE, "--no-bar"], "--no-bar only means something with --color-by or --diff"),
        ([TREE, "--gain", "3"], "--gain only means something with --diff"),
        ([TREE, "--diff", TREE, "--color-by", "level"], "leave out --color-by"),
        ([TREE, "--diff", TREE, "--alpha"], "--diff is between pictures without alpha"),
        ([TREE, "--through", "ply"], "--through"),
        ([TREE, "--backend", "cuda"], "--backend"),
        ([TREE, "-o", "x.jpg"], "--output x.jpg is none of .png, .webp, .npy, .gif, .mp4"),
        ([TREE, "-o", "x"], "--output x is none of .png"),
        ([TREE, "--orbit", "3", "-o", "x.png"], "there are 3 cameras: write frames (x.%04d.png)"),
        ([TREE, "--orbit", "3", "-o", "-"], "standard output takes one picture, not 3"),
        ([TREE, "--orbit", "3", "-o", "%d.%d.png"], "does not name frames"),
        ([TREE, "--orbit", "3", "-o", "%d.mp4"], "does not name frames"),
        ([TREE, "--sheet", "-o", "x.npy"], "a contact sheet is one .png or .webp"),
        ([TREE, "--json", "-o", "-"], "--json and the picture cannot both go to standard output"),
        ([TREE, "--jobs", "0"], "--jobs"),
        ([TREE, "--threads", "0"], "--threads"),
    ],
)
def test_wrong_usage_is_exit_code_2(
    arguments: list[object], message: str, capsys: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert render(*arguments) == 2
    out, err = capsys.readouterr()
    assert message in err
    assert out == ""
    assert list(tmp_path.iterdir()) == []


def test_cameras_of_several_sizes_need_one(tmp_path: Path, capsys: Said) -> None:
    frames = json.loads((CAMERAS / "transforms.json").read_text())
    for number, frame in enumerate(frames["frames"]):
        frame |= {"w": 64 + number, "h": 48, "fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(frames))
    assert render(TREE, "--camera-path", path, "-o", tmp_path / "x.gif") == 2
    assert "pictures of several sizes" in capsys.readouterr().err
    assert render(TREE, "--camera-path", path, "-o", tmp_path / "x.gif", "--size", "64x48", "-q") == 0
    assert render(TREE, "--camera-path", path, "-o", tmp_path / "%04d.png", "-q") == 0


@pytest.mark.parametrize(
    ("arguments", "named", "message"),
    [
        ([FAULTS / "missing.spz"], FAULTS / "missing.spz", "no such file"),
        ([TREE, "--diff", FAULTS / "missing.spz"], FAULTS / "missing.spz", "no such file"),
        ([FAULTS / "spz-flipped-bit.spz"], FAULTS / "spz-flipped-bit.spz", "corrupt gzip data"),
        ([FAULTS / "tree-cycle.spz"], FAULTS / "tree-cycle.spz", "its tree is broken"),
        ([FAULTS / "no-splats.ply"], FAULTS / "no-splats.ply", "it has no splats"),
        ([PLAIN, "--color-by", "level"], "level", "no file is a Level-of-Detail tree"),
        ([TREE, "--camera-path", FAULTS / "no.json"], FAULTS / "no.json", "no such file"),
        (["--scene", FAULTS / "no.json"], FAULTS / "no.json", "no such file"),
        ([TREE, "-o", "no/such/folder/out.png"], "no/such/folder", "does not exist"),
    ],
    ids=str,
)
def test_a_file_that_fails_is_named_in_a_line(
    arguments: list[object],
    named: object,
    message: str,
    capsys: Said,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert render(*arguments, *SIZE) == 1
    out, err = capsys.readouterr()
    assert err.startswith("error: ")
    assert str(named) in err
    assert message in err
    assert (out, err.count("\n")) == ("", 1)
    assert list(tmp_path.iterdir()) == []


def test_an_input_is_never_an_output(tmp_path: Path, capsys: Said) -> None:
    scene, path, sheet = tmp_path / "scene.png", tmp_path / "0001.png", tmp_path / "x.png"
    shutil.copy(PLAIN, scene)
    shutil.copy(CAMERAS / "sparklod.json", path)
    sheet.symlink_to(scene)
    before = {each: each.read_bytes() for each in tmp_path.iterdir()}
    for said in (
        (scene, "-o", scene),
        (scene, "-o", sheet),
        (PLAIN, "--diff", scene, "-o", scene),
        (PLAIN, "--camera-path", path, "-o", tmp_path / "%04d.png"),
    ):
        assert render(*said, "--overwrite") == 2
        assert "is an input; write elsewhere" in capsys.readouterr().err
    assert {each: each.read_bytes() for each in before} == before


def test_what_exists_stays(tmp_path: Path, capsys: Said) -> None:
    (tmp_path / "out.0002.png").write_text("precious")
    assert render(TREE, *SIZE, "--orbit", 3, "-o", tmp_path / "out.%04d.png") == 1
    assert "out.0002.png exists, add --overwrite to replace it" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["out.0002.png"]
    assert render(TREE, *SIZE, "--orbit", 3, "-o", tmp_path / "out.%04d.png", "--overwrite", "-q") == 0
    assert len(list(tmp_path.iterdir())) == 3


def test_a_failure_leaves_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said) -> None:
    draw, count = Painter.draw, []

    def falling(self: Painter, *arguments: Any) -> Any:
        count.append(1)
        if len(count) == 3:
            raise KeyboardInterrupt
        return draw(self, *arguments)

    monkeypatch.setattr(Painter, "draw", falling)
    for name in ("x.gif", "out.%04d.png"):
        count.clear()
        assert render(TREE, *SIZE, "--orbit", 5, "--jobs", 1, "-o", tmp_path / name) == 130
    # Frames that are done are whole.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.0000.png", "out.0001.png"]
    assert all(pixels(path).shape == (90, 160, 3) for path in tmp_path.iterdir())
    assert "interrupted" in capsys.readouterr().err


def test_cameras_that_see_nothing_are_wondered_at(tmp_path: Path, capsys: Said) -> None:
    assert render(PLAIN, *SIZE, "--look-at", "0,0,50:0,0,99", "-o", tmp_path / "x.png") == 0
    assert capsys.readouterr().err.startswith("warning: nothing is in view")
    assert render(PLAIN, *SIZE, "--look-at", "0,0,50:0,0,99", "-o", tmp_path / "x.png", "--overwrite", "-q") == 0
    assert capsys.readouterr().err == ""


def test_a_budget_for_files_without_a_tree_is_wondered_at(tmp_path: Path, capsys: Said) -> None:
    assert render(PLAIN, *SIZE, "--budget", 50, "-o", tmp_path / "x.png") == 0
    assert "no file is a Level-of-Detail tree, so all splats are drawn" in capsys.readouterr().err


def test_a_scene_of_any_size_is_seen_from_where_it_fits(tmp_path: Path) -> None:
    scene = tmp_path / "scene.json"
    shutil.copy(PLAIN, tmp_path / "plain.ply")
    images = []
    for scale in (1e-4, 1, 1e5):
        scene.write_text(json.dumps({"instances": [{"file": "plain.ply", "scale": scale}]}))
        assert render("--scene", scene, *SIZE, "-o", tmp_path / f"{scale}.npy", "-q") == 0
        images.append(floats(tmp_path / f"{scale}.npy"))
    for image in images:
        assert psnr(images[1], image) > 35


@pytest.mark.parametrize("backend", ["osmesa", "open3d"])
def test_other_backends_draw_or_say_what_is_missing(backend: str, tmp_path: Path, capsys: Said) -> None:
    code = render(PLAIN, *SIZE, "--backend", backend, "-o", tmp_path / "x.png")
    err = capsys.readouterr().err
    if code == 0:
        assert pixels(tmp_path / "x.png").any()
    else:
        assert code == 1
        assert err.startswith("error: ")
        assert err.count("\n") == 1
        assert list(tmp_path.iterdir()) == []


def test_names_are_those_of_the_backends() -> None:
    assert tuple(BACKENDS) == limits.BACKENDS


def test_help_shows_how(capsys: Said) -> None:
    assert render("--help") == 0
    out = capsys.readouterr().out
    assert "Examples:" in out
    assert out.count("  sparklod render ") >= 6
    for option in ("--camera-path", "--view", "--style", "--color-by", "--through", "--diff", "--supersample"):
        assert option in out


def test_as_a_process(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sparklod_cli", "render", str(TREE), "--size", "64x48", "-o", "-", "-q"]
    done = subprocess.run(command, capture_output=True, check=False, cwd=ROOT)
    assert done.returncode == 0
    assert pixels(io.BytesIO(done.stdout)).shape == (48, 64, 3)
    assert done.stderr == b""
