"""Thumbnails, differences and reports of `sparklod render`."""

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

from sparklod_cli.cli import run
from sparklod_cli.codecs.formats import ROUND_TRIPS
from sparklod_cli.images.metrics import psnr
from sparklod_cli.images.picture_files import THUMBNAIL_SIZE, THUMBNAIL_SUPERSAMPLE
from sparklod_cli.viewers import scenes
from tests.commands.render.runs import AT, DEMO, PLAIN, SIZE, TOWN, TREE, floats, pixels, render
from tests.conftest import ROOT, Capture


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


def test_a_comparison_shows_a_terminal_its_summary(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    how = (TOWN, "--size", "64x48", *AT, "--compare", "--budget", "5%", "-q")
    assert render(*how) == 0
    assert capsys.readouterr().out.startswith("frame,time_s,")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    assert render(*how) == 0
    out = capsys.readouterr().out
    assert "psnr_black" not in out
    assert "worst tile" in out


def test_json_says_what_was_drawn(tmp_path: Path, capsys: Capture) -> None:
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


def test_the_time_that_is_said_is_the_whole_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    whole = scenes.read_scenes

    def slow(*arguments: Any, **named: Any) -> Any:
        time.sleep(0.5)
        return whole(*arguments, **named)

    monkeypatch.setattr(scenes, "read_scenes", slow)
    assert render(PLAIN, *SIZE, "--json", "-o", tmp_path / "x.png") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["seconds"] >= 0.5
    assert float(err.rsplit(" ", 2)[1]) >= 0.5


def test_a_process_writes_a_png_and_says_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sparklod_cli", "render", str(TREE), "--size", "64x48", "-o", "-", "-q"]
    done = subprocess.run(command, capture_output=True, check=False, cwd=ROOT)
    assert done.returncode == 0
    assert pixels(io.BytesIO(done.stdout)).shape == (48, 64, 3)
    assert done.stderr == b""


def test_a_difference_is_drawn_and_its_psnr_said(built: Path, tmp_path: Path, capsys: Capture) -> None:
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


def test_a_difference_says_what_it_shows(built: Path, tmp_path: Path, capsys: Capture) -> None:
    how = (built, "--budget", 9_000, "--size", "400x240", *AT, "--diff", DEMO, "--json")
    assert render(*how, "-o", tmp_path / "bar.png") == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert f"differences times {report['gain']:g}" in err
    bar = pixels(tmp_path / "bar.png")
    assert report["frames"][0]["width"] == bar.shape[1] > 400
    assert render(*how, "-o", tmp_path / "same.png", "--gain", report["gain"], "--no-bar") == 0
    assert np.array_equal(pixels(tmp_path / "same.png"), bar[:, :400])
    assert bar[:, :400].max() > 90


def test_an_encoding_is_seen_in_the_difference_to_the_file_itself(tmp_path: Path, capsys: Capture) -> None:
    values = {}
    for through in ROUND_TRIPS:
        settings = (PLAIN, *SIZE, "--through", through, "--diff", PLAIN, "--json", "-q")
        assert render(*settings, "-o", tmp_path / f"{through}.png") == 0
        values[through] = json.loads(capsys.readouterr().out)["frames"][0]["psnr_db"]
    assert all(25 < value < 100 for value in values.values())
    assert len(set(values.values())) == len(values)
