"""What `sparklod render` refuses or wonders at, and that failures leave nothing half written."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.render.renderer import Renderer
from tests.commands.render.runs import CAMERAS, FAULTS, PLAIN, SIZE, TREE, pixels, render
from tests.conftest import Capture


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "a FILE is missing; name one, or an instances file with --scene"),
        ([TREE, "--scene", "s.json"], "FILE cannot be used with --scene"),
        ([TREE, "--budget", "many"], "--budget"),
        ([TREE, "--budget", "5k", "--preset", "quest"], "--preset cannot be used with --budget"),
        ([TREE, "--full", "--budget", "5k"], "--budget cannot be used with --full"),
        ([TREE, TREE, "--budget", "1"], "a budget of 1 splat is less than one for each of 2 instances"),
        ([TREE, "--chunk-cache", "5"], "--chunk-cache can only be used with --after"),
        ([TREE, "--bandwidth", "5Mbit"], "--bandwidth can only be used with --after"),
        ([TREE, "--view", "0,0,9:0,0,0", "--orbit", "3"], "--orbit and --view cannot be used together"),
        ([TREE, "--view", "0,0,0:0,0,0"], "looks at its own eye"),
        ([TREE, "--orbit", "3", "--dolly"], "--orbit and --dolly cannot be used together"),
        ([TREE, "--background", "red"], "'red' is not a colour"),
        ([TREE, "--background", "#12345"], "is not a colour"),
        ([TREE, "--alpha", "--background", "white"], "--alpha cannot be used with --background"),
        ([TREE, "--alpha", "-o", "x.gif"], ".gif has no alpha"),
        ([TREE, "--alpha", "-o", "x.mp4"], ".mp4 has no alpha"),
        ([TREE, "--alpha", "-o", "x.webm"], ".webm has no alpha"),
        ([TREE, "--alpha", "-o", "x.jpg"], ".jpg has no alpha; write .png or .webp, or name a --background"),
        ([TREE, "--jpeg-quality", "50"], "--jpeg-quality can only be used with a .jpg"),
        ([TREE, "--thumbnail", "--size", "64x64"], "--size cannot be used with --thumbnail"),
        ([TREE, "--thumbnail", "--orbit", "3"], "--orbit cannot be used with --thumbnail"),
        ([TREE, "--thumbnail", "--compare"], "--thumbnail cannot be used with --compare"),
        ([TREE, "--fps", "3"], "--fps cannot be used with a camera that does not move"),
        ([TREE, "--budget", "5%,10%"], "--budget 5%,10% names several, which only render --compare takes"),
        ([TREE, "--size", "65536x65536"], "are more than 134,217,728; give a smaller --size"),
        ([TREE, "--size", "9000x9000", "--supersample", "2"], "9,000 x 9,000 pixels x 4 (--supersample 2)"),
        ([TREE, "--size", "17000x10", "-o", "x.webp"], "more than 16,383 a side"),
        ([TREE, "--near", "5", "--far", "5"], "--near 5 must be less than --far 5"),
        ([TREE, "--style", "points", "--backend", "numba"], "--backend cannot be used with --style points"),
        ([TREE, "--color-by", "overdraw", "--style", "points"], "--style cannot be used with --color-by overdraw"),
        ([TREE, "--no-bar"], "--no-bar can only be used with --color-by or --diff"),
        ([TREE, "--gain", "3"], "--gain can only be used with --diff"),
        ([TREE, "--diff", TREE, "--color-by", "level"], "--color-by cannot be used with --diff"),
        ([TREE, "--diff", TREE, "--alpha"], "--diff compares pictures without alpha; name a --background"),
        ([TREE, "-o", "x.tif"], "--output x.tif does not end in .png, .jpg, .webp, .npy, .gif, .mp4 or .webm"),
        ([TREE, "-o", "x"], "--output x has no suffix, which chooses the format; end it in .png"),
        ([TREE, "--orbit", "3", "-o", "x.png"], "there are 3 cameras: write frames (x.%04d.png)"),
        ([TREE, "--orbit", "3", "-o", "-"], "standard output takes one picture, not 3"),
        ([TREE, "--orbit", "3", "-o", "%d.%d.png"], "does not name frames"),
        ([TREE, "--orbit", "3", "-o", "%d.mp4"], "does not name frames"),
        ([TREE, "--sheet", "-o", "x.npy"], "a contact sheet is one .png, .jpg or .webp"),
        ([TREE, "--json", "-o", "-"], "--output - and --json cannot both go to standard output"),
    ],
)
def test_wrong_usage_of_render_is_exit_code_2(
    arguments: list[object], message: str, capsys: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert render(*arguments) == 2
    out, err = capsys.readouterr()
    assert message in err
    assert out == ""
    assert list(tmp_path.iterdir()) == []


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
        ([TREE, "-o", TREE / "out.png"], TREE, "is a file, not a folder"),
    ],
    ids=str,
)
def test_a_file_that_cannot_be_drawn_is_named_in_a_line(
    arguments: list[object],
    named: object,
    message: str,
    capsys: Capture,
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


def test_render_never_writes_over_its_inputs(tmp_path: Path, capsys: Capture) -> None:
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
        assert "is an input; name another output" in capsys.readouterr().err
    assert {each: each.read_bytes() for each in before} == before


def test_an_existing_frame_stays_without_overwrite(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "out.0002.png").write_text("precious")
    assert render(TREE, *SIZE, "--orbit", 3, "-o", tmp_path / "out.%04d.png") == 1
    assert "out.0002.png exists, add --overwrite to replace it" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["out.0002.png"]
    assert render(TREE, *SIZE, "--orbit", 3, "-o", tmp_path / "out.%04d.png", "--overwrite", "-q") == 0
    assert len(list(tmp_path.iterdir())) == 3


def test_an_interrupted_render_leaves_no_half_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    draw, count = Renderer.draw, []

    def falling(self: Renderer, *arguments: Any) -> Any:
        count.append(1)
        if len(count) == 3:
            raise KeyboardInterrupt
        return draw(self, *arguments)

    monkeypatch.setattr(Renderer, "draw", falling)
    for name in ("x.gif", "out.%04d.png"):
        count.clear()
        assert render(TREE, *SIZE, "--orbit", 5, "--jobs", 1, "-o", tmp_path / name) == 130
    # Frames that are done are whole.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.0000.png", "out.0001.png"]
    assert all(pixels(path).shape == (90, 160, 3) for path in tmp_path.iterdir())
    assert "interrupted" in capsys.readouterr().err


def test_cameras_that_see_nothing_give_a_warning(tmp_path: Path, capsys: Capture) -> None:
    assert render(PLAIN, *SIZE, "--look-at", "0,0,50:0,0,99", "-o", tmp_path / "x.png") == 0
    assert capsys.readouterr().err.startswith("warning: nothing is in view")
    assert render(PLAIN, *SIZE, "--look-at", "0,0,50:0,0,99", "-o", tmp_path / "x.png", "--overwrite", "-q") == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "options",
    [
        ("--budget", "50"),
        ("--preset", "quest"),
        ("--lod-multiplier", "3"),
        ("--bandwidth", "20Mbit", "--latency", "60ms", "--after", "1s"),
    ],
)
def test_options_of_levels_are_refused_for_files_without(
    options: tuple[str, ...], tmp_path: Path, capsys: Capture
) -> None:
    assert render(PLAIN, *SIZE, *options, "-o", tmp_path / "x.png") == 2
    err = capsys.readouterr().err
    assert re.search(f"error: ({'|'.join(options)}) is for Level-of-Detail files, and no file is one", err)
    assert not any(tmp_path.iterdir())
