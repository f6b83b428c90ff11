"""The command line: arguments, messages, exit codes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli import __version__
from sparklod_cli.cli import COMMANDS, run
from sparklod_cli.codecs import spz
from sparklod_cli.io import read_scene
from sparklod_cli.limits import METHODS
from sparklod_cli.lod import quality, quick
from sparklod_cli.progress import Progress
from sparklod_cli.scene import Scene
from sparklod_cli.splats import Splats
from sparklod_cli.tree import LodTree
from tests.conftest import FIXTURES, ROOT

ONE, SMALL = FIXTURES / "one.ply", FIXTURES / "sh2.ply"


def build(*arguments: object) -> int:
    return run(["build-lod", *map(str, arguments)])


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    path.write_bytes(SMALL.read_bytes())
    return path


def test_an_input_is_baked_beside_itself(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_a_failure_does_not_stop_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    missing, broken = tmp_path / "missing.ply", tmp_path / "broken.ply"
    broken.write_bytes(b"ply\nnonsense\nend_header\n")
    assert build(missing, ONE, broken, SMALL, "--output-dir", tmp_path) == 1
    err = capsys.readouterr().err
    assert f"error: {missing}: cannot be read: no such file or directory\n" in err
    assert f"error: {broken}: bad PLY header" in err
    assert err.count("error:") == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.ply", "one-lod.spz", "sh2-lod.spz"]


def test_an_existing_output_is_refused_without_overwrite(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = scene.with_name("scene-lod.spz")
    output.write_bytes(b"precious")
    assert build(scene) == 1
    assert "exists, add --overwrite" in capsys.readouterr().err
    assert output.read_bytes() == b"precious"
    assert build(scene, "--overwrite") == 0
    assert read_scene(output).tree is not None


def test_json_is_an_object_a_file(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert build(scene, tmp_path / "missing.ply", "--json", "-q", "--base", 2, "--max-sh", 1) == 1
    good, bad = map(json.loads, capsys.readouterr().out.splitlines())
    output = scene.with_name("scene-lod.spz")
    assert good["output"] == str(output)
    assert good["bytes"] == output.stat().st_size
    assert good["nodes"] == len(read_scene(output).splats)
    assert (good["splats"], good["sh_degree"], good["dropped"]) == (len(read_scene(scene).splats), 1, {})
    assert set(good["seconds"]) == {"read", "build", "write"}
    assert bad == {"input": str(tmp_path / "missing.ply"), "error": "cannot be read: no such file or directory"}


def test_options_reach_the_file(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert build(scene, "-o", tmp_path / "a.spz", "--json", "--spz-version", 2, "--fractional-bits", 9) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["version"], record["fractional_bits"]) == (2, 9)
    assert read_scene(tmp_path / "a.spz").format == "SPZ 2 LoD"
    sizes = {}
    for base in (1.1, 2.0):
        assert build(scene, "-o", tmp_path / f"{base}.spz", "--base", base) == 0
        sizes[base] = len(read_scene(tmp_path / f"{base}.spz").splats)
    assert sizes[1.1] > sizes[2.0]


def test_quality_builds_a_tree_of_all_splats(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    total = len(read_scene(scene).splats)
    sizes = {}
    for growth in (1.05, 1.2, 2.0):
        output = tmp_path / f"{growth}.spz"
        assert build(scene, "-o", output, "--method", "quality", "--growth", growth, "--json", "-v") == 0
        out, err = capsys.readouterr()
        record, baked = json.loads(out), read_scene(output)
        assert baked.tree is not None
        baked.tree.validate()
        assert baked.tree.is_leaf.sum() == total
        assert (record["method"], record["nodes"]) == ("quality", len(baked.splats))
        assert len(baked.splats) <= growth * total
        assert "PLY -> quality tree -> SPZ 3 LoD" in err
        sizes[growth] = len(baked.splats)
    assert sizes[1.05] < sizes[1.2] < sizes[2.0]


def test_a_method_is_quick_if_nothing_is_said(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, arguments in {"a": [], "b": ["--method", "quick"], "c": ["--method", "quality"]}.items():
        assert build(scene, "-o", tmp_path / f"{name}.spz", "--json", *arguments) == 0
    records = map(json.loads, capsys.readouterr().out.splitlines())
    assert [record["method"] for record in records] == ["quick", "quick", "quality"]
    a, b, c = ((tmp_path / f"{name}.spz").read_bytes() for name in "abc")
    assert a == b != c


@pytest.mark.parametrize("method", METHODS)
def test_threads_do_not_change_the_file(method: str, tmp_path: Path) -> None:
    for threads in (1, 2):
        output = tmp_path / f"{threads}.spz"
        assert build(FIXTURES / "demo.ply", "-o", output, "--method", method, "--threads", threads) == 0
    assert (tmp_path / "1.spz").read_bytes() == (tmp_path / "2.spz").read_bytes()


def test_merged_splats_outside_of_the_box_of_the_leaves(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The quality builder may put them there: they get fewer bits where they would not fit."""

    def moved(splats: Splats, growth: float, *, progress: Progress) -> tuple[Splats, LodTree]:
        nodes, tree = quick.build(splats)
        nodes.center[0] = 2.1 * np.abs(splats.center).max()
        return nodes, tree

    monkeypatch.setattr(quality, "build", moved)
    splats = read_scene(scene).splats
    splats.center[:] *= 1e5  # so that it is the extent that bounds the bits
    far = tmp_path / "far.spz"
    far.write_bytes(b"".join(spz.encode(Scene(splats), spz.Options())))
    most = spz.largest_fractional_bits(read_scene(far).splats.center)
    assert build(far, "-o", tmp_path / "out.spz", "--method", "quality", "--json") == 0
    assert json.loads(capsys.readouterr().out)["fractional_bits"] < most


def test_what_is_dropped_is_said(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    splats = read_scene(scene).splats
    x = float(sorted(splats.center[:, 0])[len(splats) // 2])
    assert build(scene, "--max-box", f"{x},1e9,1e9", "--json") == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    cropped = int((splats.center[:, 0] > x).sum())
    assert record["dropped"] == {"cropped": cropped}
    assert record["splats"] + cropped == record["read"] == len(splats)
    assert f"dropped {cropped} cropped" in err


def test_quiet_says_nothing_and_verbose_more(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert build(scene, "-q") == 0
    assert capsys.readouterr() == ("", "")
    assert build(scene, "-v", "--overwrite") == 0
    assert "fractional bits; read" in capsys.readouterr().err


def test_options_reach_the_tree(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    splats = read_scene(scene).splats
    x, y, z = splats.center[0].tolist()
    distance = np.sqrt(((splats.center - splats.center[0]) ** 2).sum(axis=1, dtype=np.float64))
    radius = float(np.median(distance))
    opacity = float(np.median(splats.opacity))
    left = {
        ("--within", f"{x},{y},{z},{radius}"): int((distance <= radius).sum()),
        ("--min-opacity", str(opacity)): int((splats.opacity >= opacity).sum()),
        ("--min-box", f"{x},{y},{z}"): int((splats.center >= splats.center[0]).all(axis=1).sum()),
        ("--max-sh", "0"): len(splats),
    }
    for arguments, count in left.items():
        assert build(scene, "-o", tmp_path / "out.spz", "--overwrite", "--json", "-q", *arguments) == 0
        assert json.loads(capsys.readouterr().out)["splats"] == count
    assert read_scene(tmp_path / "out.spz").splats.sh_degree == 0
    sizes = []
    for level in (1, 9):
        assert build(FIXTURES / "demo.ply", "-o", tmp_path / f"{level}.spz", "--compression-level", level) == 0
        sizes.append((tmp_path / f"{level}.spz").stat().st_size)
    assert sizes[1] < sizes[0]


def test_what_belongs_to_the_file_is_kept_or_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    golden = FIXTURES / "golden"
    assert build(golden / "hand-v4.spz", golden / "hand-v4-sh4.spz", "--output-dir", tmp_path) == 0
    assert "SH degree 4 is cut to 3" in capsys.readouterr().err
    for name in ("hand-v4", "hand-v4-sh4"):
        before, after = read_scene(golden / f"{name}.spz"), read_scene(tmp_path / f"{name}-lod.spz")
        assert after.antialiased == before.antialiased
    assert read_scene(golden / "hand-v4.spz").antialiased


def test_a_tree_is_not_baked_again(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert build(scene) == 0
    assert build(scene.with_name("scene-lod.spz")) == 1
    assert "it is a Level-of-Detail file already" in capsys.readouterr().err


def test_what_does_not_fit_into_memory_does_not_stop_the_others(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*args: object, **kwargs: object) -> None:
        raise MemoryError

    monkeypatch.setattr(quick, "build", full)
    assert build(scene, ONE, "--output-dir", scene.parent) == 1
    err = capsys.readouterr().err
    assert err.count("it does not fit into memory") == 2


@pytest.mark.parametrize("options", [[], ["--encoding", "ext"], ["--unlod"]])
def test_a_name_without_a_suffix_promises_nothing(options: list[str], scene: Path, tmp_path: Path) -> None:
    source = FIXTURES / "golden" / "tree-v3.spz" if options == ["--unlod"] else scene
    assert build(source, "-o", tmp_path / "out", *options) == 0
    assert (tmp_path / "out").stat().st_size


def test_a_file_that_may_not_be_read_does_not_stop_the_others(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
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


def test_an_input_is_never_an_output(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = scene.read_bytes()
    assert build(scene, "-o", scene, "--overwrite") == 2
    assert "is an input" in capsys.readouterr().err
    link = scene.with_name("link.ply")
    link.symlink_to(scene)
    assert build(link, "-o", scene, "--overwrite") == 2
    assert scene.read_bytes() == before


def test_more_processors_than_threads_that_are_taken(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.commands.options.processors", lambda: 5000)
    assert build(scene) == 0


def test_closed_streams(tmp_path: Path) -> None:
    command = f"{sys.executable} -m sparklod_cli build-lod {SMALL}"
    done = subprocess.run(["bash", "-c", f"{command} -o - >&-"], capture_output=True, text=True, check=False, cwd=ROOT)
    assert (done.returncode, done.stderr) == (1, f"error: {SMALL}: standard output is closed\n")
    done = subprocess.run(["bash", "-c", f"{command} -o {tmp_path}/out.spz 2>&-"], check=False, cwd=ROOT)
    assert done.returncode == 0
    assert read_scene(tmp_path / "out.spz").tree is not None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Missing argument"),
        (["a.ply", "--base", "1.05"], "--base"),
        (["a.ply", "--base", "nan"], "--base"),
        (["a.ply", "--method", "best"], "--method"),
        (["a.ply", "--method", "quality", "--growth", "1.04"], "--growth"),
        (["a.ply", "--method", "quality", "--growth", "2.1"], "--growth"),
        (["a.ply", "--method", "quality", "--growth", "nan"], "--growth"),
        (["a.ply", "--method", "quality", "--base", "1.5"], "--base is of --method quick, not of quality"),
        (["a.ply", "--method", "quick", "--growth", "1.4"], "--growth is of --method quality, not of quick"),
        (["a.ply", "--growth", "1.4"], "--growth is of --method quality, not of quick"),
        (["a.ply", "--spz-version", "4"], "--spz-version"),
        (["a.ply", "--fractional-bits", "25"], "--fractional-bits"),
        (["a.ply", "--fractional-bits", "many"], "--fractional-bits"),
        (["a.ply", "--min-box", "1,2"], "x,y,z"),
        (["a.ply", "--max-box", "1,2,nan"], "x,y,z"),
        (["a.ply", "--within", "1,2,3"], "x,y,z,radius"),
        (["a.ply", "--within", "1,2,3,-1"], "radius"),
        (["a.ply", "b.ply", "-o", "c.spz"], "-o takes one input"),
        (["a.ply", "-o", "c.spz", "--output-dir", "d"], "exclude each other"),
        (["x/a.ply", "y/a.ply", "--output-dir", "d"], "would both be written to"),
        (["a.ply", "-o", "-", "--json"], "standard output"),
        (["a.ply", "--threads", "0"], "--threads"),
        (["a.ply", "-o", "out.glb"], "a tree is written as SPZ, not as .glb; name the output .spz"),
        (["a.ply", "-o", "out.RAD"], "a tree is written as SPZ, not as .rad"),
        (["a.ply", "-o", "out.spz.gz"], "a tree is written as SPZ, not as .gz"),
        (["a.ply", "-o", "out.ply"], ".ply holds no tree"),
        (["a.ply", "-o", "out.bin"], "a .bin output needs --encoding"),
        (["a.ply", "-o", "out.spz", "--encoding", "ext"], "--encoding writes .npz, .bin, .raw, not .spz"),
        (["a.ply", "-o", "out.png", "--encoding", "packed"], "--encoding writes .npz, .bin, .raw, not .png"),
        (["a-lod.spz", "-o", "out.glb", "--unlod"], "--unlod writes .spz, .ply, .splat, not .glb"),
        (["a.ply", "--quality"], "there is no option --quality; did you mean --method quality?"),
        (["a.ply", "--ext"], "there is no option --ext; did you mean --encoding ext?"),
        (["a.ply", "--overwritten"], "--overwrite"),
    ],
)
def test_wrong_usage_is_exit_code_2(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert build(*arguments) == 2
    assert message in capsys.readouterr().err


def sparklod(*arguments: object, **how: object) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "sparklod_cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, check=False, cwd=ROOT, **how)


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


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interruption_leaves_nothing_behind(tmp_path: Path, how: signal.Signals) -> None:
    source = FIXTURES / "demo.ply"
    command = [sys.executable, "-m", "sparklod_cli", "build-lod", str(source), "--output-dir", str(tmp_path), "-q"]
    # Wherever it is caught: while it imports, reads, compiles, builds or writes.
    for delay in (0.4, 0.7, 1.0):
        process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE)
        time.sleep(delay)
        process.send_signal(how)
        _, err = process.communicate()
        assert process.returncode in (0, 130, -how)  # -how: before Python came to us, or while it left
        left = list(tmp_path.iterdir())
        if left:  # it was done before, or all but done
            assert [path.name for path in left] == ["demo-lod.spz"]
            assert read_scene(left[0]).tree is not None
            left[0].unlink()
        else:
            assert process.returncode != 0
        assert b"Exception ignored" not in err


def test_version_and_help_everywhere() -> None:
    for arguments in (["--version"], ["build-lod", "--version"]):
        assert sparklod(*arguments).stdout.decode() == f"sparklod, version {__version__}\n"
    for arguments in (["--help"], *([command, "--help"] for command in COMMANDS)):
        assert b"Usage: sparklod" in sparklod(*arguments).stdout
    assert b"Examples:" in sparklod("build-lod", "--help").stdout


def test_help_imports_nothing_heavy() -> None:
    code = "import sys; from sparklod_cli.cli import run; run(sys.argv[1:]); print(*sys.modules, file=sys.stderr)"
    for arguments in (["--help"], *([command, "--help"] for command in COMMANDS)):
        result = subprocess.run(
            [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True, cwd=ROOT
        )
        modules = set(result.stderr.split())
        assert not modules & {"numpy", "numba", "plyfile", "zstandard", "tqdm", "PIL", "open3d", "pyvista"}


def test_completion_knows_the_options() -> None:
    words = {"COMP_WORDS": "sparklod build-lod --over", "COMP_CWORD": "2", "_SPARKLOD_COMPLETE": "bash_complete"}
    code = "from sparklod_cli.cli import cli; cli(prog_name='sparklod')"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT, env={**os.environ, **words}
    )
    assert "--overwrite" in result.stdout
