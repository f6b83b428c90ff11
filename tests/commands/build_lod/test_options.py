"""Options of `sparklod build-lod`: they reach the file and the tree, and wrong ones are refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.io import read_scene
from sparklod_cli.lod.builders import METHODS
from tests.commands.build_lod.runs import build
from tests.conftest import FIXTURES, Capture


def test_options_of_spz_reach_the_file(scene: Path, tmp_path: Path, capsys: Capture) -> None:
    assert build(scene, "-o", tmp_path / "a.spz", "--json", "--spz-version", 2, "--fractional-bits", 9) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["version"], record["fractional_bits"]) == (2, 9)
    assert read_scene(tmp_path / "a.spz").format == "SPZ 2 LoD"
    sizes = {}
    for base in (1.1, 2.0):
        assert build(scene, "-o", tmp_path / f"{base}.spz", "--base", base) == 0
        sizes[base] = len(read_scene(tmp_path / f"{base}.spz").splats)
    assert sizes[1.1] > sizes[2.0]


def test_quality_builds_a_tree_of_all_splats(scene: Path, tmp_path: Path, capsys: Capture) -> None:
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


def test_the_default_method_is_quick(scene: Path, tmp_path: Path, capsys: Capture) -> None:
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


def test_options_reach_the_tree(scene: Path, tmp_path: Path, capsys: Capture) -> None:
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


def test_more_processors_than_the_most_threads_are_no_error(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.support.parallel.processors", lambda: 5000)
    assert build(scene) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Missing argument"),
        (["a.ply", "--method", "quality", "--base", "1.5"], "--base is an option of --method quick, not of quality"),
        (["a.ply", "--method", "quick", "--growth", "1.4"], "--growth is an option of --method quality, not of quick"),
        (["a.ply", "--growth", "1.4"], "--growth is an option of --method quality, not of quick"),
        (["a.ply", "--fractional-bits", "many"], "--fractional-bits"),
        (["a.ply", "--min-box", "1,2"], "x,y,z"),
        (["a.ply", "--max-box", "1,2,nan"], "x,y,z"),
        (["a.ply", "--within", "1,2,3"], "x,y,z,radius"),
        (["a.ply", "--within", "1,2,3,-1"], "radius"),
        (["a.ply", "b.ply", "-o", "c.spz"], "--output takes one input, not 2"),
        (["a.ply", "-o", "c.spz", "--output-dir", "d"], "--output cannot be used with --output-dir"),
        (["x/a.ply", "y/a.ply", "--output-dir", "d"], "two outputs would be written to d/a-lod.spz"),
        (["a.ply", "-o", "-", "--json"], "standard output"),
        (["a.ply", "-o", "out.glb"], "written as SPZ, RAD or Streamed SOG, not as .glb; name the output .spz, .rad or"),
        (["a.ply", "-o", "out.RADC"], "trees are written as SPZ, RAD or Streamed SOG, not as .radc"),
        (["a.ply", "-o", "out.spz.gz"], "trees are written as SPZ, RAD or Streamed SOG, not as .gz"),
        (["a.ply", "-o", "out.ply"], ".ply cannot hold a tree; name the output .spz, .rad or lod-meta.json"),
        (["a.ply", "-o", "out.bin"], ".bin is a file of arrays; choose their layout with --encoding"),
        (["a.ply", "-o", "out.spz", "--encoding", "ext"], "--encoding writes .npz, .bin, .raw, not .spz"),
        (["a.ply", "-o", "out.png", "--encoding", "packed"], "--encoding writes .npz, .bin, .raw, not .png"),
        (
            ["a-lod.spz", "-o", "out.glb", "--unlod"],
            "--unlod writes .ply, .spz, .rad, .sog, meta.json, .splat, not .glb",
        ),
        (["a.ply", "--quality"], "there is no option --quality; did you mean --method quality?"),
        (["a.ply", "--ext"], "there is no option --ext; did you mean --encoding ext?"),
        (["a.ply", "--overwritten"], "--overwrite"),
    ],
)
def test_wrong_usage_of_build_lod_is_exit_code_2(arguments: list[str], message: str, capsys: Capture) -> None:
    assert build(*arguments) == 2
    assert message in capsys.readouterr().err
