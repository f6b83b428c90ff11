"""`sparklod render` and `sparklod traverse` of Streamed SOG."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from tests.conftest import FIXTURES, Capture
from tests.lod.trees import row_of_regions
from tests.part_files import write_streamed

AT = ("--look-at", "0,0,-6:0,0,0", "--size", "48x32")
TREE = FIXTURES / "golden" / "hand-tree-v3.spz"


@pytest.fixture(scope="module")
def web(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a lod-meta.json: six regions of 64, 32 and 16 splats, and 5 splats around them."""
    return write_streamed(tmp_path_factory.mktemp("scene") / "web", row_of_regions(environment=5)).parent


def command(name: str, *arguments: object) -> int:
    return run([name, *map(str, arguments)])


def splats_of(capsys: Capture, *arguments: object) -> int:
    """How many splats `render` draws of one picture."""
    assert command("render", *arguments, *AT, "--overwrite", "--json") == 0, capsys.readouterr().err
    (frame,) = json.loads(capsys.readouterr().out)["frames"]
    splats: int = frame["splats"]
    return splats


def test_render_draws_the_levels_of_a_budget(web: Path, tmp_path: Path, capsys: Capture) -> None:
    out = ("-o", tmp_path / "out.png")
    for path in (web, web / "lod-meta.json"):
        assert 150 < splats_of(capsys, path, *out, "--budget", "200") <= 205
        assert splats_of(capsys, path, *out) == 6 * 64 + 5
    assert splats_of(capsys, web, *out, "--full") == 6 * 64 + 5
    assert splats_of(capsys, web, *out, "--budget", "1") == 6 * 16 + 5
    limit = ("--budget-mode", "limit", "--lod-base-distance")
    assert splats_of(capsys, web, *out, *limit, 0.1) == 6 * 16 + 5
    assert splats_of(capsys, web, *out, *limit, 1000) == 6 * 64 + 5


def test_instances_of_streamed_sog_stand_in_a_scene(web: Path, tmp_path: Path, capsys: Capture) -> None:
    scene = tmp_path / "scene.json"
    twice = [{"file": str(web)}, {"file": str(web / "lod-meta.json"), "translation": [3, 0, 0]}]
    scene.write_text(json.dumps({"instances": twice}))
    assert splats_of(capsys, "--scene", scene, "-o", tmp_path / "out.png", "--full") == 2 * (6 * 64 + 5)
    assert splats_of(capsys, "--scene", scene, "-o", tmp_path / "out.png", "--budget", "400") <= 400 + 10


def test_pictures_of_levels_frames_and_sheets(web: Path, tmp_path: Path, capsys: Capture) -> None:
    views = ("--view", "0,0,-6:0,0,0", "--view", "3,0,-6:0,0,0", "--size", "48x32")
    for arguments in (
        (*AT, "--color-by", "level", "-o", tmp_path / "levels.png"),
        (*AT, "--color-by", "chunk", "-o", tmp_path / "chunks.png"),
        (*views, "-o", tmp_path / "sheet.png"),
        ("--orbit", 2, "--size", "48x32", "-o", tmp_path / "frame.%d.png"),
        (*AT, "--after", "1s", "--bandwidth", "100kbit", "-o", tmp_path / "after.png"),
    ):
        assert command("render", web, "--budget", "200", *arguments, "-q") == 0, capsys.readouterr().err
    assert len(list(tmp_path.iterdir())) == 6


def test_compare_measures_levels_against_full_detail(web: Path, capsys: Capture) -> None:
    arguments = (*AT, "--budget", "30%,100%", "--compare", "--json", "-q")
    assert command("render", web, *arguments, "--assert", "30%:psnr<60") == 0, capsys.readouterr().err
    whole = json.loads(capsys.readouterr().out)
    assert whole["leaves"] == 6 * 64 + 5
    coarse, full = whole["budgets"]
    assert coarse["psnr"] < 60 and full["psnr"] == 100 and full["selected"] == 6 * 64 + 5


def test_traverse_writes_rows_and_a_summary(web: Path, tmp_path: Path, capsys: Capture) -> None:
    path = ("--keyframes", "0,0,-6:0,0,40 0,0,16:0,0,40", "--seconds", 4, "--every", 10)
    arguments = (web, *path, "--budget", "200", "--per-instance", "--no-timing", "-o", tmp_path / "out.csv")
    assert command("traverse", *arguments, "--assert", "selected<=205", "--assert", "level_max<=2") == 0
    rows = list(csv.DictReader(io.StringIO((tmp_path / "out.csv").read_text())))
    assert {row["instance"] for row in rows} == {"total", "web"}
    assert all(row["pixel_scale_limit"] == row["frontier"] == "" for row in rows)
    capsys.readouterr()
    loading = ("--bandwidth", "500kbit", "--latency", "20ms", "--json")
    assert command("traverse", web, *path, *loading, "--assert", "first_picture_s<5") == 0
    whole = json.loads(capsys.readouterr().out)
    assert whole["loading"]["resident_all_bytes"] >= whole["loading"]["resident_90_bytes"] > 0
    assert "pixel_scale_min" not in whole["quantities"]


@pytest.mark.parametrize("name", ["render", "traverse"])
@pytest.mark.parametrize(
    "flags",
    [
        ("--pixel-scale-limit", "0.01"),
        ("--lod-render-scale", "2"),
        ("--cone-fov", "100"),
        ("--outside-foveate", "0.5"),
        ("--behind-foveate", "0.5"),
        ("--precision", "float16"),
    ],
)
def test_options_of_trees_are_refused(web: Path, name: str, flags: tuple[str, str], capsys: Capture) -> None:
    assert command(name, web, *AT, *flags, "-q") == 2
    said = f"error: {flags[0]} is for trees; use --budget, --budget-mode and --lod-multiplier for Streamed SOG"
    assert said in capsys.readouterr().err


def test_options_of_one_command_are_refused(web: Path, tmp_path: Path, capsys: Capture) -> None:
    for name, flags in (
        ("render", ("--continuous",)),
        ("traverse", ("--chunk-cache", "3")),
        ("traverse", ("--indices-out", tmp_path / "cuts")),
    ):
        assert command(name, web, *AT, *flags, "-q") == 2
        assert f"{flags[0]} is for trees" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "flags", [("--budget-mode", "limit"), ("--lod-multiplier", "2"), ("--lod-behind-penalty", "3")]
)
def test_options_of_streamed_sog_are_refused_for_trees(flags: tuple[str, str], tmp_path: Path, capsys: Capture) -> None:
    for name in ("render", "traverse"):
        assert command(name, TREE, *AT, *flags, "-o", tmp_path / ("out.png" if name == "render" else "out.csv")) == 2
        assert f"{flags[0]} is for Streamed SOG, and no file is" in capsys.readouterr().err


def test_options_that_have_nothing_to_do_are_refused(web: Path, capsys: Capture) -> None:
    for flags, said in (
        (("--lod-base-distance", "3"), "--lod-base-distance can only be used with --budget-mode limit"),
        (("--lod-underfill", "3"), "--lod-underfill can only be used with --bandwidth"),
        (("--lod-multiplier", "1.1"), "1.1 is not in the range x>=1.2"),
    ):
        assert command("traverse", web, *AT, *flags) == 2
        assert said in capsys.readouterr().err
    assert command("render", web, *AT, "--full", "--lod-multiplier", "2") == 2
    assert "--lod-multiplier cannot be used with --full" in capsys.readouterr().err


@pytest.mark.parametrize("name", [("render",), ("traverse",), ("render", "--compare")])
def test_trees_and_streamed_sog_are_refused_together(web: Path, name: tuple[str, ...], capsys: Capture) -> None:
    assert command(*name, web, TREE, *AT, "-q") == 2
    error = capsys.readouterr().err
    assert "is a Level-of-Detail tree and" in error and "look at one of them at a time" in error
