"""What `sparklod render` says of its work: JSON, times, help."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.api import jobs
from tests.commands.render.runs import PLAIN, SIZE, TOWN, TREE, pixels, render
from tests.conftest import ROOT, Capture


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
    whole = jobs.read_scenes

    def slow(*arguments: Any, **named: Any) -> Any:
        time.sleep(0.5)
        return whole(*arguments, **named)

    monkeypatch.setattr(jobs, "read_scenes", slow)
    assert render(PLAIN, *SIZE, "--json", "-o", tmp_path / "x.png") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["seconds"] >= 0.5
    assert float(err.rsplit(" ", 2)[1]) >= 0.5


def test_help_of_render_has_examples(capsys: Capture) -> None:
    assert render("--help") == 0
    out = capsys.readouterr().out
    assert "Examples:" in out
    assert out.count("  sparklod render ") >= 6
    for option in ("--camera-path", "--view", "--style", "--color-by", "--through", "--diff", "--supersample"):
        assert option in out


def test_a_process_writes_a_png_and_says_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sparklod_cli", "render", str(TREE), "--size", "64x48", "-o", "-", "-q"]
    done = subprocess.run(command, capture_output=True, check=False, cwd=ROOT)
    assert done.returncode == 0
    assert pixels(io.BytesIO(done.stdout)).shape == (48, 64, 3)
    assert done.stderr == b""
