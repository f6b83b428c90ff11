"""Frames, thumbnails, and pictures while chunks are loading, of `sparklod render`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sparklod_cli.images.pixels import cells
from sparklod_cli.render.renderer import Renderer
from sparklod_cli.system.packages import install_hint
from tests.commands.render.runs import CAMERAS, DEMO, SIZE, TOWN, TREE, pixels, render
from tests.conftest import Capture

pytestmark = pytest.mark.slow


def test_frames_of_a_path_are_its_views(tmp_path: Path, capsys: Capture) -> None:
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


@pytest.mark.parametrize("form", ["gif", "webp", "mp4", "webm"])
def test_an_animation_has_the_frames_of_its_path(form: str, tmp_path: Path, capsys: Capture) -> None:
    if form in ("mp4", "webm"):
        pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    output = tmp_path / f"orbit.{form}"
    assert render(DEMO, *SIZE, "--orbit", 5, "-o", output) == 0
    assert capsys.readouterr().err.startswith(f"{output}  5 frames, 160 x 90, ")
    if form in ("mp4", "webm"):
        import imageio.v3

        assert imageio.v3.imread(output).shape == (5, 90, 160, 3)
        return
    with Image.open(output) as picture:
        assert picture.n_frames == 5
        assert picture.size == (160, 90)


def test_mp4_without_imageio_is_an_error_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setitem(sys.modules, "imageio", None)
    monkeypatch.setattr(Renderer, "draw", None)
    assert render(DEMO, "--orbit", 3, "-o", tmp_path / "x.mp4") == 1
    assert install_hint("video") in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_cameras_of_several_sizes_need_one(tmp_path: Path, capsys: Capture) -> None:
    frames = json.loads((CAMERAS / "transforms.json").read_text())
    for number, frame in enumerate(frames["frames"]):
        frame |= {"w": 64 + number, "h": 48, "fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(frames))
    assert render(TREE, "--camera-path", path, "-o", tmp_path / "x.gif") == 2
    assert "pictures of several sizes" in capsys.readouterr().err
    assert render(TREE, "--camera-path", path, "-o", tmp_path / "x.gif", "--size", "64x48", "-q") == 0
    assert render(TREE, "--camera-path", path, "-o", tmp_path / "%04d.png", "-q") == 0
