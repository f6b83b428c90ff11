"""`sparklod render`: pictures, frames, animations, sheets, thumbnails, differences, loading, reports, interruptions."""

from __future__ import annotations

import io
import json
import sys
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sparklod_cli.codecs.formats import ROUND_TRIPS
from sparklod_cli.images.metrics import psnr
from sparklod_cli.images.picture_files import THUMBNAIL_SIZE, THUMBNAIL_SUPERSAMPLE
from sparklod_cli.images.pixels import cells
from sparklod_cli.render.render_settings import BACKENDS, COLOR_BY
from sparklod_cli.render.renderer import Renderer
from sparklod_cli.system.machine import install_hint
from sparklod_cli.viewers import scenes
from tests.commands.cli import NAMED, Cli, process

TREE, TOWN, PLAIN, DEMO = "hand-tree-v3.spz", "town.spz", "sh2.ply", "demo.ply"
SIZE, AT = "--size 160x90", "--look-at 0,-3,9:0,0,0"


def pixels(path: Path | str | io.BytesIO) -> np.ndarray:
    with Image.open(path) as picture:
        return np.array(picture)


def floats(path: Path | str) -> np.ndarray:
    image: np.ndarray = np.load(path)
    assert image.dtype == np.float32
    return image


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tree of the demo scene."""
    path = tmp_path_factory.mktemp("built") / "demo-lod.spz"
    assert process("build-lod", NAMED[DEMO], "-o", path).returncode == 0
    return path


# --- Pictures ---------------------------------------------------------------------------------------------------------


def test_a_picture_is_beside_the_scene_and_has_its_name_or_is_named(cli: Cli) -> None:
    done = cli(f"render {TOWN} --budget 5k --size 320x180 -o preview.png")
    assert done.out == "" and done.err.startswith("preview.png  320 x 180, ") and done.err.count("\n") == 1
    image = pixels("preview.png")
    assert image.shape == (180, 320, 3) and image.any(axis=2).mean() > 0.2
    cli.put("town 100%.spz", NAMED[TOWN].read_bytes())
    cli(f"render {PLAIN} {SIZE} -q")
    cli(f"render 'town 100%.spz' {PLAIN} {SIZE} -q --orbit 2 --budget 1k")
    with zipfile.ZipFile(NAMED["sh2-v1.sog"]) as archive:
        archive.extractall("unpacked")
    for source in ("unpacked", "unpacked/meta.json"):
        cli(f"render {source} {SIZE} -q")
    made = {"sh2.png", "town 100_.0000.png", "town 100_.0001.png", "unpacked.png", "unpacked/unpacked.png"}
    assert made < {*cli.made()}


@pytest.mark.slow
def test_the_leaves_of_a_tree_are_the_scene_that_it_was_made_of(built: Path, cli: Cli) -> None:
    how = f"--size 320x180 {AT} -q"
    cli(f"render {DEMO} {how} -o plain.npy")
    cli(f"render {built} {how} --full -o tree.npy")
    cli(f"render {DEMO} {how} --through spz -o rounded.npy")
    cli(f"render {built} {how} --budget 500 -o cut.npy")
    plain, tree, rounded, cut = (floats(f"{name}.npy") for name in ("plain", "tree", "rounded", "cut"))
    assert psnr(rounded, tree) > psnr(plain, tree) > max(45, psnr(plain, cut) + 10)


@pytest.mark.slow
def test_floats_are_premultiplied_and_pixels_are_not(cli: Cli) -> None:
    line = f"render {DEMO} {SIZE} {AT} -q -f"
    cli(f"{line} -o x.npy")
    image = floats("x.npy")
    assert image.shape == (90, 160, 4) and (image[..., :3].max(axis=2) <= image[..., 3] + 1e-5).all()
    alpha = image[..., 3:]
    for color, rgb in (
        *(("black", (0, 0, 0)), ("white", (1, 1, 1))),
        *(("#ff8000", (1, 128 / 255, 0)), ("#f80", (1, 136 / 255, 0))),
    ):
        cli(f"{line} --background '{color}' -o x.png")
        expected = np.rint(255 * np.clip(image[..., :3] + (1 - alpha) * np.array(rgb), 0, 1))
        assert np.abs(pixels("x.png") - expected).max() <= 1
    cli(f"{line} --background white -o x.npy")
    assert np.allclose(floats("x.npy")[..., :3], image[..., :3] + (1 - alpha), atol=1e-6)
    solid = image[..., 3] > 0.05
    for option in ("--alpha", "--background transparent"):
        for name in ("x.png", "x.webp"):
            cli(f"{line} {option} -o {name}")
            codes = pixels(name)
            assert codes.shape == (90, 160, 4) and np.abs(codes[..., 3] - 255 * image[..., 3]).max() <= 0.51
            assert np.abs(codes[solid][:, :3] - np.clip(255 * image[solid][:, :3] / alpha[solid], 0, 255)).max() <= 0.6


def test_standard_output_and_threads_give_the_same_bytes(cli: Cli) -> None:
    line = f"render {TOWN} {PLAIN} --size 64x48 -q"
    for threads in (1, 2):
        cli(f"{line} --threads {threads} -o {threads}.png")
    assert Path("1.png").read_bytes() == Path("2.png").read_bytes()
    done = process(f"render {TOWN} {PLAIN} --size 64x48 -q -o -")
    assert (done.returncode, done.stdout, done.stderr) == (0, Path("1.png").read_bytes(), b"")


@pytest.mark.slow
@pytest.mark.parametrize("by", COLOR_BY)
def test_color_by_draws_a_color_scale(by: str, cli: Cli) -> None:
    line = f"render {TOWN} --budget 4k --size 480x270 -q --color-by {by}"
    cli(f"{line} -o bar.png")
    cli(f"{line} --no-bar -o no.png")
    bar, no = pixels("bar.png"), pixels("no.png")
    assert no.any() and bar.shape[1] > no.shape[1] == 480
    assert np.array_equal(bar[:, :480], no), "it hides nothing"
    cli(f"{line} -o x.npy")
    assert floats("x.npy").shape == ((270, 480) if by in ("overdraw", "depth") else (270, 480, 4))


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["osmesa", "open3d"])
def test_other_backends_draw_or_name_the_missing_package(backend: str, cli: Cli) -> None:
    assert f"[{'|'.join(BACKENDS)}]" in cli("render --help-all").out
    done = cli(f"render {PLAIN} {SIZE} --backend {backend} -o x.png", status=None)
    if done.status == 0:
        assert pixels("x.png").any()
    else:
        assert done.status == 1 and done.err.startswith("error: ") and done.err.count("\n") == 1 and cli.made() == []


def test_instances_are_drawn_where_and_as_large_as_they_are_placed(cli: Cli) -> None:
    for name in (TREE, PLAIN):
        cli.copy(name)
    counts = []
    for more in ([], [{"file": PLAIN, "translation": [3, 0, 0]}]):
        cli.put("scene.json", json.dumps({"instances": [{"file": TREE}, *more]}))
        done = cli(f"render --scene scene.json {SIZE} --look-at 0,0,-9:0,0,0 --json -q -o {len(more)}.png")
        counts.append(done.json["frames"][0]["splats"])
    assert counts[1] > counts[0] and (pixels("0.png") != pixels("1.png")).any()
    images = []
    for scale in (1, 1e-4, 1e5):
        cli.put("scene.json", json.dumps({"instances": [{"file": PLAIN, "scale": scale}]}))
        cli(f"render --scene scene.json {SIZE} -o x.npy -q -f")
        images.append(floats("x.npy"))
    assert all(psnr(images[0], image) > 35 for image in images)


def test_a_jpeg_is_nearly_the_picture(cli: Cli) -> None:
    line = f"render {PLAIN} {SIZE} {AT} -q"
    cli(f"{line} -o x.png")
    exact = pixels("x.png").astype(float)
    errors = []
    for name, quality in (("x.jpg", ""), ("x.jpeg", "--jpeg-quality 20"), ("X.JPG", "")):
        cli(f"{line} -o {name} {quality}")
        with Image.open(name) as picture:
            assert picture.format == "JPEG"
        errors.append(float(np.sqrt(np.mean((pixels(name) - exact) ** 2))))
    assert exact.max() > 50 and errors[0] == errors[2] < 3 and 1.5 * errors[0] < errors[1]


def test_a_budget_can_be_a_share_of_the_leaves(cli: Cli) -> None:
    leaves = int(cli(f"inspect {TOWN} --field tree.leaves").out)
    (row,) = cli(f"traverse {TOWN} {AT} --budget 5% --no-timing").rows
    assert int(row["budget"]) == leaves // 20
    drawn = {}
    for budget in ("5%", str(leaves // 20), "5% --lod-splat-scale 0.5"):
        done = cli(f"render {TOWN} {SIZE} {AT} --budget {budget} --json -q -f -o x.npy")
        drawn[budget] = done.json["frames"][0]["splats"], Path("x.npy").read_bytes()
    share, count, half = drawn.values()
    assert share == count and 0.9 * (leaves // 40) < half[0] <= leaves / 40


def test_cameras_that_see_nothing_give_a_warning(cli: Cli) -> None:
    line = f"render {PLAIN} {SIZE} --look-at 0,0,50:0,0,99 -o x.png -f"
    assert cli(line).err.startswith("warning: nothing is in view")
    assert cli(f"{line} -q").err == ""


# --- Frames, animations and sheets ------------------------------------------------------------------------------------


def test_frames_of_a_path_are_its_views(cli: Cli) -> None:
    line = f"render {TOWN} --budget 2k {SIZE} -q -f"
    views = "-6,-2,-6:0,0,0", "0,-1,-3:0,-0.5,0"
    keys = f"--keyframes '{' '.join(views)}' --seconds 1 --fps 4"
    for jobs in (1, 3):
        done = cli(f"{line} {keys} -o jobs{jobs}.%04d.png --jobs {jobs}")
        assert done[1:] == ("", "")
    assert cli.made() == [f"jobs{jobs}.{n:04d}.png" for jobs in (1, 3) for n in range(5)]
    for n in range(5):
        assert Path(f"jobs1.{n:04d}.png").read_bytes() == Path(f"jobs3.{n:04d}.png").read_bytes()
    for number, view in ((0, views[0]), (4, views[1])):
        cli(f"{line} --look-at={view} -o one.png")
        assert np.array_equal(pixels("one.png"), pixels(f"jobs1.{number:04d}.png"))
    cli(f"{line} {keys} --every 2 -o f%d.npy")
    assert [name for name in cli.made() if name[0] == "f"] == ["f0.npy", "f2.npy", "f4.npy"]


def test_several_views_make_a_contact_sheet(cli: Cli) -> None:
    line = f"render {PLAIN} {SIZE} -q -f"
    views = "0,-3,9:0,0,0", "9,-3,0:0,0,0", "0,-9,1:0,0,0"
    cli(f"{line} {' '.join(f'--view={view}' for view in views)} -o sheet.png")
    sheet = pixels("sheet.png")
    for (x, y), view in zip(cells(3, (160, 90)), views, strict=True):
        for option in ("--look-at", "--view"):
            cli(f"{line} {option}={view} -o one.png")
            assert np.array_equal(sheet[y : y + 90, x : x + 160], pixels("one.png"))
    for name in ("orbit.webp", "orbit.jpg"):
        cli(f"{line} --orbit 4 --sheet -o {name}")
        assert pixels(name).shape[0] > 180
    cli(f"{line} --orbit 2 -o x.%d.jpg")
    assert {"x.0.jpg", "x.1.jpg"} < {*cli.made()}


@pytest.mark.slow
@pytest.mark.parametrize("form", ["gif", "webp", "mp4", "webm"])
def test_an_animation_has_the_frames_of_its_path(form: str, cli: Cli) -> None:
    if form in ("mp4", "webm"):
        pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    assert cli(f"render {DEMO} {SIZE} --orbit 5 -o a.{form}").err.startswith(f"a.{form}  5 frames, 160 x 90, ")
    if form in ("mp4", "webm"):
        import imageio.v3

        assert imageio.v3.imread(f"a.{form}").shape == (5, 90, 160, 3)
        return
    with Image.open(f"a.{form}") as picture:
        assert (picture.n_frames, picture.size) == (5, (160, 90))


def test_mp4_without_imageio_is_an_error_before_the_work(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio", None)
    monkeypatch.setattr(Renderer, "draw", None)
    assert install_hint("video") in cli(f"render {DEMO} --orbit 3 -o x.mp4", status=1).err
    assert cli.made() == []


def test_an_animation_of_cameras_of_several_sizes_needs_one(cli: Cli) -> None:
    path = json.loads(NAMED["transforms.json"].read_text())
    for number, frame in enumerate(path["frames"]):
        frame |= {"w": 64 + number, "h": 48, "fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24}
    cli.put("sizes.json", json.dumps(path))
    line = f"render {TREE} --camera-path sizes.json -q -o"
    assert "pictures of several sizes" in cli(f"{line} x.gif", status=2).err
    cli(f"{line} x.gif --size 64x48")
    cli(f"{line} %04d.png")


def test_an_interruption_leaves_no_half_picture(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    draw, count = Renderer.draw, []

    def falling(self: Renderer, *arguments: Any) -> Any:
        count.append(1)
        if len(count) == 3:
            raise KeyboardInterrupt
        return draw(self, *arguments)

    monkeypatch.setattr(Renderer, "draw", falling)
    for name in ("x.gif", "out.%04d.png"):
        count.clear()
        assert "interrupted" in cli(f"render {TREE} {SIZE} --orbit 5 --jobs 1 -o {name}", status=130).err
    assert cli.made() == ["out.0000.png", "out.0001.png"]  # frames that are done are whole
    assert all(pixels(name).shape == (90, 160, 3) for name in cli.made())


# --- Thumbnails, differences and reports ------------------------------------------------------------------------------


def test_a_thumbnail_is_the_whole_scene_made_small(cli: Cli) -> None:
    assert cli(f"render {PLAIN} --thumbnail").err.startswith("sh2-thumbnail.png  512 x 512, ")
    width, height = THUMBNAIL_SIZE
    cli(f"render {PLAIN} --size {width}x{height} --supersample {THUMBNAIL_SUPERSAMPLE} -o hand.png -q")
    assert np.array_equal(pixels("sh2-thumbnail.png"), pixels("hand.png"))
    cli(f"render {PLAIN} --thumbnail -f -q --alpha --color-by size --no-bar")
    assert pixels("sh2-thumbnail.png").shape == (512, 512, 4)
    cli(f"render {PLAIN} --thumbnail -o small.jpg -q")
    with Image.open("small.jpg") as picture:
        assert (picture.format, picture.size) == ("JPEG", (512, 512))


def test_json_has_a_record_of_each_frame_and_the_whole_time(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = scenes.read_scenes

    def slow(*arguments: Any, **named: Any) -> Any:
        time.sleep(0.5)
        return whole(*arguments, **named)

    monkeypatch.setattr(scenes, "read_scenes", slow)
    done = cli(f"render {TOWN} {SIZE} --budget 3k --orbit 3 --json -o out.%04d.png")
    report = done.json
    assert (report["output"], report["format"], report["kind"]) == ("out.%04d.png", "png", "frames")
    assert [frame["frame"] for frame in report["frames"]] == [0, 1, 2]
    assert all(0 < frame["splats"] <= 3000 for frame in report["frames"])
    assert [frame["file"] for frame in report["frames"]] == cli.made()
    assert report["bytes"] == sum(Path(name).stat().st_size for name in cli.made())
    assert report["seconds"] >= 0.5 and float(done.err.rsplit(" ", 2)[1]) >= 0.5


def test_a_difference_is_drawn_with_its_psnr_and_gain(built: Path, cli: Cli) -> None:
    how = f"{SIZE} {AT} -f"
    done = cli(f"render {DEMO} {how} --diff {DEMO} -o same.png --json -q")
    assert done.json["frames"][0]["psnr_db"] == 100 and not pixels("same.png").any()
    for name, scene in (("a", f"{built} --budget 300"), ("b", DEMO)):
        cli(f"render {scene} {how} -q -o {name}.npy --background white")
    a, b = (np.clip(floats(f"{name}.npy")[..., :3], 0, 1) for name in "ab")
    done = cli(f"render {built} --budget 300 {how} --diff {DEMO} --background white --gain 3 --json -o d.png")
    value = done.json["frames"][0]["psnr_db"]
    assert value == pytest.approx(psnr(a, b), abs=2e-3) and f"PSNR {value:.2f} dB" in done.err
    assert np.abs(pixels("d.png") - np.rint(255 * np.clip(3 * np.abs(a - b), 0, 1))).max() <= 1
    line = f"render {built} --budget 9000 --size 400x240 {AT} --diff {DEMO} --json -o"
    done = cli(f"{line} bar.png")
    gain, bar = done.json["gain"], pixels("bar.png")
    assert f"differences times {gain:g}" in done.err
    assert done.json["frames"][0]["width"] == bar.shape[1] > 400 and bar[:, :400].max() > 90
    cli(f"{line} no-bar.png --gain {gain} --no-bar")
    assert np.array_equal(pixels("no-bar.png"), bar[:, :400])


def test_an_encoding_is_seen_in_the_difference_to_the_file_itself(cli: Cli) -> None:
    values = set()
    for through in ROUND_TRIPS:
        done = cli(f"render {PLAIN} {SIZE} --through {through} --diff {PLAIN} --json -q -f -o x.png")
        values.add(done.json["frames"][0]["psnr_db"])
    assert all(25 < value < 100 for value in values) and len(values) == len(ROUND_TRIPS)


# --- Pictures while chunks are loading --------------------------------------------------------------------------------

LOADING = "--size 64x48 --bandwidth 800kbit --latency 100ms --budget 20k -q -f"


@pytest.fixture
def loaded(cli: Cli) -> Cli:
    """The town as RAD: a header that takes 0.8 s, and three chunks of 0.4 to 0.7 s."""
    cli("convert town.spz town.rad -q")
    cli.inputs.add("town.rad")
    return cli


def test_the_picture_becomes_that_of_the_whole_cut(loaded: Cli) -> None:
    view = "--look-at 1,-1,-2:0,0,0"
    loaded(f"render town.rad {view} --size 64x48 --budget 20k -q -o whole.npy")
    errors = []
    for after in ("1ms", "1.7s", "2.1s", "99s"):
        loaded(f"render town.rad {view} {LOADING} --after {after} -o x.npy")
        errors.append(float(np.abs(floats("x.npy") - floats("whole.npy")).mean()))
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > errors[1] > 0 == errors[-1]
    # Views are of visitors who opened the page in front of each, so that none has more than a moment's chunks.
    views = "--view 1,-1,-2:0,0,0 " * 3
    done = loaded(f"render town.rad {views} {LOADING} --after 1.7s --json -o x.png")
    (splats,) = {frame["splats"] for frame in done.json["frames"]}
    assert splats > 0


@pytest.mark.parametrize("look", ["", "--color-by overdraw", "--color-by depth", "--style points"])
def test_nothing_is_drawn_before_the_first_chunk_and_a_line_says_why(look: str, loaded: Cli) -> None:
    options = LOADING.replace(" -q", "")
    done = loaded(f"render town.rad --look-at 1,-1,-2:0,0,0 {options} --after 100ms {look} --json -o x.npy")
    assert [frame["splats"] for frame in done.json["frames"]] == [0]
    assert "the first chunk has not arrived yet (--after)" in done.err
    assert not np.nan_to_num(np.load("x.npy")).any()
