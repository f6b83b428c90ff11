"""What `sparklod traverse` refuses, and that failures leave nothing half written."""

from __future__ import annotations

import contextlib
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.simulation.frames import Simulation
from tests.commands.traverse.runs import CAMERAS, FAULTS, ORBIT, OTHER, TOWN, TREE, scene_file, traverse
from tests.conftest import FIXTURES, ROOT, Capture


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "a FILE is missing; name one, or an instances file with --scene"),
        ([TREE, "--scene", "s.json"], "FILE cannot be used with --scene"),
        ([TREE, "--budget", "many"], "--budget"),
        ([TREE, "--budget", "0"], "the budget must be from 1 to 2^53, not 0"),
        ([TREE, "--budget", "1e60"], "the budget must be from 1 to 2^53, not 1e60"),
        ([TREE, "--budget", "0%"], "a budget of 0% leaves nothing to draw"),
        ([TREE, "--budget", "5%,10%"], "--budget 5%,10% names several, which only render --compare takes"),
        ([TREE, "--budget", "5k", "--preset", "quest"], "--preset cannot be used with --budget"),
        ([TREE, "--lod-splat-scale", "inf"], "2^53, not 2500000 times --lod-splat-scale inf"),
        (
            [TREE, "--pixel-scale-limit", "0.1", "--lod-render-scale", "2"],
            "--lod-render-scale cannot be used with --pixel-",
        ),
        ([TREE, "--outside-foveate", "0.5", "--cone-fov", "100"], "--cone-fov cannot be used with --outside-foveate"),
        ([TREE, "--latency", "60ms"], "--latency can only be used with --bandwidth"),
        ([TREE, "--fetchers", "3"], "--fetchers can only be used with --bandwidth"),
        ([TREE, "--bandwidth", "20"], "--bandwidth"),
        ([TREE, "--bandwidth", "0Mbit"], "--bandwidth"),
        ([TREE, "--bandwidth", "1Mbit", "--latency", "60"], "--latency"),
        ([TREE, "--orbit", "3", "--dolly"], "--orbit and --dolly cannot be used together"),
        ([TREE, "--camera-axes", "opengl-c2w"], "--camera-axes"),
        ([TREE, "--look-at", "0,0,0:0,0,0"], "looks at its own eye"),
        ([TREE, "--keyframes", "0,0,0:1,0,0"], "two keyframes"),
        ([TREE, "--size", "0x720"], "--size"),
        ([TREE, "--up", "0,0,0"], "0,0,0 is no direction"),
        ([TREE, "-o", "t.xlsx"], "--output t.xlsx: tables are written as .csv, .json, .parquet"),
        ([TREE, "-o", "t.png"], "--output t.png: tables are written as .csv"),
        ([TREE, "-o", "t.spz", "--format", "json"], "t.spz does not end in .json, which --format asks for"),
        ([TREE, "-o", "t.webm", "--format", "csv"], "t.webm does not end in .csv, which --format asks for"),
        ([TREE, "-o", "t.jpeg", "--format", "csv"], "t.jpeg does not end in .csv, which --format asks for"),
        ([TREE, "--plot", "t.jpg"], "'t.jpg' does not end in .png, which is what is written"),
        ([TREE, "--json", "-o", "-"], "--output - and --json cannot both go to standard output"),
        ([TREE, "--json", "--per-instance"], "--per-instance cannot be used with --json without --output"),
        ([TREE, "--padded"], "--padded can only be used with --indices-out"),
        ([TREE, "--assert", "churn"], "--assert 'churn' is not an assertion"),
        ([TREE, OTHER, "--budget", "1"], "a budget of 1 splat is less than one for each of 2 instances"),
        ([TREE, OTHER, "--chunk-cache", "1"], "cannot hold the roots of 2 trees"),
    ],
)
def test_wrong_usage_of_traverse_is_exit_code_2(arguments: list[object], message: str, capsys: Capture) -> None:
    assert traverse(*arguments) == 2
    out, err = capsys.readouterr()
    assert message in err
    assert out == ""


@pytest.mark.slow
def test_traverse_never_writes_over_its_inputs(tmp_path: Path, capsys: Capture) -> None:
    tree, cameras = tmp_path / "tree.spz", tmp_path / "path.json"
    shutil.copy(TREE, tree)
    shutil.copy(CAMERAS / "sparklod.json", cameras)
    scene = scene_file(tmp_path, {"file": "tree.spz"})
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    link = tmp_path / "link.csv"
    link.symlink_to(tree)
    pytest.importorskip("matplotlib")
    for said in (
        (tree, "-o", tree),
        (tree, "-o", link),
        ("--scene", scene, "-o", tree),
        ("--scene", scene, "-o", scene),
        (tree, "--camera-path", cameras, "-o", cameras),
        (tree, "--plot", tree),
    ):
        assert traverse(*said, "--overwrite") == 2
        assert "is an input; name another output" in capsys.readouterr().err
    assert traverse(tree, "-o", tmp_path / "x", "--plot", tmp_path / "x") == 2
    assert "two outputs would be written to" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize(
    ("arguments", "named", "message"),
    [
        ([FAULTS / "missing.spz"], FAULTS / "missing.spz", "no such file"),
        ([TREE, FAULTS / "missing.spz"], FAULTS / "missing.spz", "no such file"),
        ([FAULTS / "spz-flipped-bit.spz"], FAULTS / "spz-flipped-bit.spz", "corrupt gzip data"),
        ([FAULTS / "tree-cycle.spz"], FAULTS / "tree-cycle.spz", "its tree is broken"),
        ([FIXTURES / "sh2.ply"], FIXTURES / "sh2.ply", "bake it first with sparklod build-lod"),
        ([TREE, "--camera-path", FAULTS / "no.json"], FAULTS / "no.json", "no such file"),
        ([TREE, "--camera-path", TREE], TREE, "of no known format"),
        (["--scene", FAULTS / "no.json"], FAULTS / "no.json", "no such file"),
        (["--scene", CAMERAS / "inria.json"], CAMERAS / "inria.json", "has no list of instances"),
        ([TREE, "-o", TREE / "out.csv"], TREE, "is a file, not a folder"),
    ],
    ids=str,
)
def test_a_file_that_cannot_be_traversed_is_named_in_a_line(
    arguments: list[object], named: object, message: str, capsys: Capture
) -> None:
    assert traverse(*arguments) == 1
    out, err = capsys.readouterr()
    assert err.startswith("error: ")
    assert str(named) in err
    assert message in err
    assert (out, err.count("\n")) == ("", 1)


def test_an_interrupted_traversal_leaves_no_half_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    fly = Simulation.run

    def falling(self: Simulation, *arguments: Any, **settings: Any) -> Any:
        for frame in fly(self, *arguments, **settings):
            if frame.number == 2:
                raise KeyboardInterrupt
            yield frame

    monkeypatch.setattr(Simulation, "run", falling)
    output = tmp_path / "out.csv"
    assert traverse(TREE, *ORBIT, "-o", output) == 130
    assert list(tmp_path.iterdir()) == []
    output.write_text("precious")
    assert traverse(TREE, *ORBIT, "-o", output, "--overwrite") == 130
    assert output.read_text() == "precious"
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]
    assert "interrupted" in capsys.readouterr().err


def is_writing(process: int, folder: Path) -> bool:
    """Whether a process has a file open in a folder; it may not have a name yet."""
    with contextlib.suppress(OSError):  # one that is being closed, or a system without /proc
        if any(str(file.readlink()).startswith(str(folder)) for file in Path(f"/proc/{process}/fd").iterdir()):
            return True
    return any(folder.iterdir())


@pytest.mark.slow
def test_sigterm_leaves_nothing_behind(tmp_path: Path) -> None:
    """As Ctrl-C, which whoever runs tests in the background may have turned off."""
    settings = ("--distance", "5", "--center", "0,0,0", "--budget", "50k", "--threads", "2", "-q")
    command = [sys.executable, "-m", "sparklod_cli", "traverse", str(TOWN), "--orbit", "10000", *settings]
    process = subprocess.Popen([*command, "-o", str(tmp_path / "out.csv")], cwd=ROOT, stderr=subprocess.PIPE)
    for _ in range(600):
        if is_writing(process.pid, tmp_path):
            break
        time.sleep(0.05)
    time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err.strip()) == (130, b"interrupted")
    assert list(tmp_path.iterdir()) == []


def test_a_usage_error_makes_no_folder(tmp_path: Path, capsys: Capture) -> None:
    """Also one that only shows when the cameras are looked at."""
    folder = tmp_path / "cuts"
    assert traverse(TREE, "--look-at", "0,0,4:0,0,0", "--seconds", "2", "--indices-out", folder) == 2
    assert "--seconds" in capsys.readouterr().err
    assert not folder.exists()
