"""`sparklod build-lod` as a shell sees it: inputs, outputs, standard streams, signals, messages and exit codes."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import spz
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quality, quick
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.progress import Progress
from sparklod_cli.system.stdio import spooled
from tests.commands.build_lod.runs import ONE, SMALL, build, convert, sparklod
from tests.conftest import FIXTURES, ROOT, Capture
from tests.signals import heed_signals


def test_an_input_is_baked_beside_itself(scene: Path, capsys: Capture) -> None:
    assert build(scene) == 0
    out, err = capsys.readouterr()
    assert out == ""
    output = scene.with_name("scene-lod.spz")
    baked = read_scene(output)
    assert baked.tree is not None
    assert f"{baked.tree.is_leaf.sum():,} splats, SH 2  ->  {output}  {len(baked.splats):,} nodes" in err


def test_several_inputs_go_into_a_directory_that_is_made(tmp_path: Path) -> None:
    assert build(ONE, SMALL, "--output-dir", tmp_path / "new" / "web") == 0
    assert sorted(path.name for path in (tmp_path / "new" / "web").iterdir()) == ["one-lod.spz", "sh2-lod.spz"]


def test_a_failure_does_not_stop_the_others(tmp_path: Path, capsys: Capture) -> None:
    missing, broken = tmp_path / "missing.ply", tmp_path / "broken.ply"
    broken.write_bytes(b"ply\nnonsense\nend_header\n")
    assert build(missing, ONE, broken, SMALL, "--output-dir", tmp_path) == 1
    err = capsys.readouterr().err
    assert f"error: {missing}: cannot be read: no such file or directory\n" in err
    assert f"error: {broken}: bad PLY header" in err
    assert err.count("error:") == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.ply", "one-lod.spz", "sh2-lod.spz"]


def test_an_existing_output_is_refused_without_overwrite(scene: Path, capsys: Capture) -> None:
    output = scene.with_name("scene-lod.spz")
    output.write_bytes(b"precious")
    assert build(scene) == 1
    assert "exists, add --overwrite" in capsys.readouterr().err
    assert output.read_bytes() == b"precious"
    assert build(scene, "--overwrite") == 0
    assert read_scene(output).tree is not None


def test_json_is_an_object_a_file(scene: Path, tmp_path: Path, capsys: Capture) -> None:
    assert build(scene, tmp_path / "missing.ply", "--json", "-q", "--base", 2, "--max-sh", 1) == 1
    good, bad = map(json.loads, capsys.readouterr().out.splitlines())
    output = scene.with_name("scene-lod.spz")
    assert good["output"] == str(output)
    assert good["bytes"] == output.stat().st_size
    assert good["nodes"] == len(read_scene(output).splats)
    assert (good["splats"], good["sh_degree"], good["dropped"]) == (len(read_scene(scene).splats), 1, {})
    assert set(good["seconds"]) == {"read", "build", "write"}
    assert bad == {
        "schema_version": 1,
        "input": str(tmp_path / "missing.ply"),
        "error": "cannot be read: no such file or directory",
    }


def test_merged_splats_beyond_the_leaves_lower_the_fractional_bits(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """The quality builder may put them there: they get fewer bits where they would not fit."""

    def moved(splats: Splats, growth: float, *, progress: Progress) -> tuple[Splats, LodTree]:
        nodes, tree = quick.build(splats)
        center = nodes.center.copy()
        center[0] = 2.1 * np.abs(splats.center).max()
        return dataclasses.replace(nodes, center=center), tree

    monkeypatch.setattr(quality, "build", moved)
    splats = read_scene(scene).splats
    # So that it is the extent that bounds the bits.
    splats = dataclasses.replace(splats, center=splats.center * np.float32(1e5))
    far = tmp_path / "far.spz"
    far.write_bytes(b"".join(spz.encode(Scene(splats))))
    most = spz.largest_fractional_bits(float(np.abs(read_scene(far).splats.center).max()))
    assert build(far, "-o", tmp_path / "out.spz", "--method", "quality", "--json") == 0
    assert json.loads(capsys.readouterr().out)["fractional_bits"] < most


def test_dropped_splats_are_counted_by_reason(scene: Path, capsys: Capture) -> None:
    splats = read_scene(scene).splats
    x = float(sorted(splats.center[:, 0])[len(splats) // 2])
    assert build(scene, "--max-box", f"{x},1e9,1e9", "--json") == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    cropped = int((splats.center[:, 0] > x).sum())
    assert record["dropped"] == {"cropped": cropped}
    assert record["splats"] + cropped == record["read"] == len(splats)
    assert f"left out: {cropped} cropped" in err


def test_quiet_says_nothing_and_verbose_more(scene: Path, capsys: Capture) -> None:
    assert build(scene, "-q") == 0
    assert capsys.readouterr() == ("", "")
    assert build(scene, "-v", "--overwrite") == 0
    assert "fractional bits; read" in capsys.readouterr().err


def test_properties_of_the_file_are_kept_or_their_loss_is_said(tmp_path: Path, capsys: Capture) -> None:
    golden = FIXTURES / "golden"
    assert build(golden / "hand-v4.spz", golden / "hand-v4-sh4.spz", "--output-dir", tmp_path) == 0
    assert "SH degree 4 is cut to 3" in capsys.readouterr().err
    for name in ("hand-v4", "hand-v4-sh4"):
        before, after = read_scene(golden / f"{name}.spz"), read_scene(tmp_path / f"{name}-lod.spz")
        assert after.antialiased == before.antialiased
    assert read_scene(golden / "hand-v4.spz").antialiased


def test_a_tree_is_not_baked_again(scene: Path, capsys: Capture) -> None:
    assert build(scene) == 0
    assert build(scene.with_name("scene-lod.spz")) == 1
    assert "it is a Level-of-Detail file already" in capsys.readouterr().err


def test_a_file_too_large_for_memory_does_not_stop_the_others(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    def full(*args: object, **kwargs: object) -> None:
        raise MemoryError

    monkeypatch.setattr(quick, "build", full)
    assert build(scene, ONE, "--output-dir", scene.parent) == 1
    err = capsys.readouterr().err
    assert err.count("it does not fit into memory") == 2


def test_a_file_that_may_not_be_read_does_not_stop_the_others(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    closed = tmp_path / "closed.ply"
    closed.write_bytes(SMALL.read_bytes())
    opened, access = Path.open, os.access

    def refused(path: Path, *args: object, **kwargs: object) -> object:
        if path == closed:
            raise PermissionError(13, "Permission denied")
        return opened(path, *args, **kwargs)  # type: ignore[call-overload]

    # As for anybody but root, whom a test may be run by.
    monkeypatch.setattr(Path, "open", refused)
    monkeypatch.setattr(os, "access", lambda path, *args, **how: Path(path) != closed and access(path, *args, **how))
    assert build(scene, closed, ONE, "--output-dir", tmp_path / "web") == 1
    assert f"error: {closed}: cannot be read: permission denied\n" in capsys.readouterr().err
    assert sorted(path.name for path in (tmp_path / "web").iterdir()) == ["one-lod.spz", "scene-lod.spz"]
    assert run(["inspect", str(closed), str(ONE), "--check"]) == 3
    assert f"{closed}: error: file.unreadable: cannot be read: permission denied\n" in capsys.readouterr().out
    assert run(["inspect", str(ONE), str(closed)]) == 1


def test_build_lod_never_writes_over_its_input(scene: Path, capsys: Capture) -> None:
    before = scene.read_bytes()
    assert build(scene, "-o", scene, "--overwrite") == 2
    assert "is an input" in capsys.readouterr().err
    link = scene.with_name("link.ply")
    link.symlink_to(scene)
    assert build(link, "-o", scene, "--overwrite") == 2
    assert scene.read_bytes() == before


FILES = ("sh2.ply", "sh1-ascii.ply", "golden/sh3-v2.sog", "golden/sh2-level1.ksplat", "golden/hand-v4.spz")


class Piped(io.TextIOWrapper):
    def __init__(self, data: bytes) -> None:
        super().__init__(io.BytesIO(data))


def pipe(monkeypatch: pytest.MonkeyPatch, data: bytes) -> None:
    monkeypatch.setattr("sys.stdin", Piped(data))


@pytest.mark.parametrize("name", FILES)
def test_the_bytes_of_a_file_give_the_same_tree_as_the_file(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    source = FIXTURES / name
    pipe(monkeypatch, source.read_bytes())
    assert build("-", "-o", tmp_path / "piped.spz", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert build(source, "-o", tmp_path / "named.spz") == 0
    assert (tmp_path / "piped.spz").read_bytes() == (tmp_path / "named.spz").read_bytes()
    assert record["input"] == "-"


def test_a_process_reads_and_writes_pipes(tmp_path: Path) -> None:
    done = sparklod("build-lod", "-", "-o", "-", input=SMALL.read_bytes())
    assert done.returncode == 0, done.stderr
    assert build(SMALL, "-o", tmp_path / "named.spz") == 0
    assert done.stdout == (tmp_path / "named.spz").read_bytes()
    assert b"standard input  " in done.stderr
    assert b"->  standard output" in done.stderr


def test_the_leaves_of_a_piped_tree_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert build(SMALL, "-o", tmp_path / "tree.spz") == 0
    pipe(monkeypatch, (tmp_path / "tree.spz").read_bytes())
    assert convert("-", tmp_path / "piped.ply") == 0
    assert convert(tmp_path / "tree.spz", tmp_path / "named.ply") == 0
    assert (tmp_path / "piped.ply").read_bytes() == (tmp_path / "named.ply").read_bytes()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "error: standard input: the file is empty"),
        (b"hello", "error: standard input: not a splat file that sparklod reads"),
        ((FIXTURES / "golden/sh0.splat").read_bytes(), ".hier or .splat is not recognised by its content"),
        (SMALL.read_bytes()[:-9], "error: standard input: "),
        (b'{"version": 2, "means": {"files": ["means_l.webp", "means_u.webp"]}}', "error: standard input: "),
    ],
)
def test_errors_name_standard_input(
    data: bytes, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    pipe(monkeypatch, data)
    assert build("-", "-o", tmp_path / "out.spz") == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_standard_input_without_an_output_is_wrong_usage(capsys: Capture) -> None:
    for arguments in (["-"], ["-", "--output-dir", "web"], ["-", SMALL]):
        assert build(*arguments) == 2
        assert "standard input has no name to derive one from; name the output file" in capsys.readouterr().err


def test_a_terminal_as_standard_input_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    pipe(monkeypatch, b"")
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    assert build("-", "-o", tmp_path / "out.spz") == 1
    assert "standard input is a terminal; pipe a file into it" in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin", None)
    assert build("-", "-o", tmp_path / "out.spz") == 1
    assert "standard input is closed" in capsys.readouterr().err


def test_standard_input_can_be_read_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    for data in (b"first", b"second"):
        pipe(monkeypatch, data)
        files: list[Any] = [spooled().read() for _ in range(2)]
        assert files == [data, data]


def test_a_closed_standard_output_is_an_error_and_a_closed_standard_error_is_none(tmp_path: Path) -> None:
    command = f"{sys.executable} -m sparklod_cli build-lod {SMALL}"
    done = subprocess.run(["bash", "-c", f"{command} -o - >&-"], capture_output=True, text=True, check=False, cwd=ROOT)
    assert (done.returncode, done.stderr) == (1, f"error: {SMALL}: standard output is closed\n")
    done = subprocess.run(["bash", "-c", f"{command} -o {tmp_path}/out.spz 2>&-"], check=False, cwd=ROOT)
    assert done.returncode == 0
    assert read_scene(tmp_path / "out.spz").tree is not None


def test_standard_output_takes_the_file(tmp_path: Path) -> None:
    result = sparklod("build-lod", SMALL, "-o", "-")
    assert result.returncode == 0
    (tmp_path / "out.spz").write_bytes(result.stdout)
    assert read_scene(tmp_path / "out.spz").tree is not None


def test_a_reader_that_goes_away_is_a_failure_without_a_traceback() -> None:
    command = f"{sys.executable} -m sparklod_cli build-lod {FIXTURES / 'demo.ply'} -o - | head -c 10 > {os.devnull}"
    result = subprocess.run(["bash", "-c", f"set -o pipefail; {command}"], capture_output=True, check=False, cwd=ROOT)
    assert result.returncode == 1
    assert b"Traceback" not in result.stderr
    assert b"broken pipe" in result.stderr


def handles(process: int, how: signal.Signals) -> bool:
    """Whether a process has its own handler for SIGTERM and a signal; Python itself has one for SIGINT."""
    status = Path(f"/proc/{process}/status")
    if not status.exists():
        time.sleep(0.4)
        return True
    caught = int(re.search(r"SigCgt:\s*(\w+)", status.read_text())[1], 16)  # type: ignore[index]
    return all(caught >> number - 1 & 1 for number in (how, signal.SIGTERM))


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interruption_leaves_nothing_behind(tmp_path: Path, how: signal.Signals) -> None:
    source = FIXTURES / "demo.ply"
    command = [sys.executable, "-m", "sparklod_cli", "build-lod", str(source), "--output-dir", str(tmp_path), "-q"]
    # Wherever it is caught: while it imports, reads, compiles, builds or writes. Before that it is Python's to handle.
    for delay in (0.05, 0.3, 0.6):
        process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, preexec_fn=heed_signals)
        while process.poll() is None and not handles(process.pid, how):
            time.sleep(0.01)
        time.sleep(delay)
        process.send_signal(how)
        _, err = process.communicate()
        assert process.returncode in (0, 130, -how), err  # -how: while Python left
        left = list(tmp_path.iterdir())
        if left:  # it was done before, or all but done
            assert [path.name for path in left] == ["demo-lod.spz"]
            assert read_scene(left[0]).tree is not None
            left[0].unlink()
        else:
            assert process.returncode != 0
        assert b"Exception ignored" not in err
