"""Small pictures of whole scenes, and JPEG."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sparklod_cli.cli import run
from sparklod_cli.images.defaults import THUMBNAIL_SIZE, THUMBNAIL_SUPERSAMPLE
from tests.commands.render.runs import AT, DEMO, FIXTURES, PLAIN, SIZE, TOWN, pixels, render
from tests.conftest import Capture


def test_a_thumbnail_is_the_whole_scene_made_small(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(DEMO, tmp_path)
    demo = "demo.ply"
    assert render(demo, "--thumbnail", "--jobs", 1) == 0
    assert capsys.readouterr().err.startswith("demo-thumbnail.png  512 x 512, ")
    width, height = THUMBNAIL_SIZE
    by_hand = ("--size", f"{width}x{height}", "--supersample", THUMBNAIL_SUPERSAMPLE)
    assert render(demo, *by_hand, "-o", "hand.png", "-q") == 0
    assert np.array_equal(pixels(tmp_path / "demo-thumbnail.png"), pixels(tmp_path / "hand.png"))
    assert render(demo, "--thumbnail") == 1
    assert "demo-thumbnail.png exists" in capsys.readouterr().err
    assert render(demo, "--thumbnail", "-f", "-q", "--alpha", "--color-by", "size", "--no-bar") == 0
    assert pixels(tmp_path / "demo-thumbnail.png").shape == (512, 512, 4)
    assert render(demo, "--thumbnail", "-o", "small.jpg", "-q") == 0
    with Image.open("small.jpg") as picture:
        assert (picture.format, picture.size) == ("JPEG", (512, 512))


@pytest.mark.parametrize("name", ["x.jpg", "x.jpeg", "X.JPG"])
def test_a_jpeg_is_nearly_the_picture(name: str, tmp_path: Path) -> None:
    how = (PLAIN, *SIZE, *AT, "-q")
    assert render(*how, "-o", tmp_path / "x.png") == 0
    exact = pixels(tmp_path / "x.png").astype(float)
    assert exact.max() > 50
    errors = {}
    for quality in ((), ("--jpeg-quality", 20)):
        assert render(*how, "-o", tmp_path / name, "--overwrite", *quality) == 0
        with Image.open(tmp_path / name) as picture:
            assert picture.format == "JPEG"
        errors[quality] = float(np.sqrt(np.mean((pixels(tmp_path / name) - exact) ** 2)))
    assert errors[()] < 3
    assert 1.5 * errors[()] < errors["--jpeg-quality", 20]


def test_frames_and_sheets_can_be_jpegs(tmp_path: Path) -> None:
    assert render(PLAIN, *SIZE, "--orbit", 2, "-q", "-o", tmp_path / "x.%d.jpg") == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.0.jpg", "x.1.jpg"]
    assert render(PLAIN, *SIZE, "--orbit", 2, "--sheet", "-q", "-o", tmp_path / "sheet.jpg") == 0
    height, width, _ = pixels(tmp_path / "sheet.jpg").shape
    assert height * width > 2 * 160 * 90


def test_a_budget_can_be_a_share_of_the_leaves(tmp_path: Path, capsys: Capture) -> None:
    how = (TOWN, *SIZE, *AT)
    assert run(["traverse", *map(str, how), "--budget", "5%", "--no-timing"]) == 0
    header, row = (line.split(",") for line in capsys.readouterr().out.splitlines())
    budget = int(dict(zip(header, row, strict=True))["budget"])
    assert render(*how, "--full", "-o", tmp_path / "full.npy") == 0
    leaves = int(capsys.readouterr().err.split(" splats")[0].rsplit(" ", 1)[1].replace(",", ""))
    assert budget == leaves // 20
    for name, given in (("share", "5%"), ("count", budget)):
        assert render(*how, "--budget", given, "-o", tmp_path / f"{name}.npy", "-q") == 0
    assert (tmp_path / "share.npy").read_bytes() == (tmp_path / "count.npy").read_bytes()
    assert render(*how, "--budget", "5%", "--lod-splat-scale", "0.5", "-o", tmp_path / "half.npy") == 0
    drawn = int(capsys.readouterr().err.split(" splats")[0].rsplit(" ", 1)[1].replace(",", ""))
    assert 0.9 * budget / 2 < drawn <= budget / 2


def test_a_plain_spz_may_stand_on_its_head(tmp_path: Path, capsys: Capture) -> None:
    file = FIXTURES / "golden" / "hand-v4.spz"
    for number, (arguments, noted) in enumerate(
        (((), True), (("--up", "0,1,0"), False), (("--look-at", "0,0,3:0,0,0"), True), (("-q",), False))
    ):
        assert render(file, "--size", "64x48", *arguments, "-o", tmp_path / f"{number}.png") == 0
        assert ("--up y if the scene is upside down" in capsys.readouterr().err) == noted
    assert render(TOWN, PLAIN, "--size", "64x48", "-o", tmp_path / "tree.png") == 0
    assert "upside down" not in capsys.readouterr().err


def test_a_comparison_shows_a_terminal_its_summary(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    how = (TOWN, "--size", "64x48", *AT, "--compare", "--budget", "5%", "-q")
    assert render(*how) == 0
    assert capsys.readouterr().out.startswith("frame,time_s,")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    assert render(*how) == 0
    out = capsys.readouterr().out
    assert "psnr_black" not in out
    assert "worst tile" in out
