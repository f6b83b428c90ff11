"""Messages that say what is wrong, with the value, and what to do."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import ply
from sparklod_cli.commands.build_lod_text import CLAMPED_BY_SPZ
from sparklod_cli.io import read_scene
from sparklod_cli.model.scene import Scene
from tests.conftest import FIXTURES, Capture
from tests.scenes import random_splats

TREE, PLAIN = FIXTURES / "golden" / "tree-v3.spz", FIXTURES / "one.ply"

#: A plural of one.
ONES = re.compile(r"(?<![\d.,])1 (?:\w+ )?(splats|nodes|levels|leaves|frames|cameras|chunks|texels|rows|instances)\b")


@pytest.mark.parametrize(
    ("size", "said"),
    [
        ("100000x100000", "is too large; give at most 65,536 pixels along a side, such as 1280x720"),
        (f"8x{'9' * 5000}", "is too large"),
        ("8x65537", "is too large"),
        ("8x" + "0" * 5000, "is not a width and a height"),
        ("0x8", "is not a width and a height in pixels, such as 1280x720"),
        ("8", "is not a width and a height"),
        ("8x-8", "is not a width and a height"),
        ("8x²", "is not a width and a height"),
    ],
)
def test_a_wrong_picture_size_is_quoted(size: str, said: str, capsys: Capture) -> None:
    assert run(["render", str(TREE), "--size", size]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert size[:20] in err


@pytest.mark.parametrize(("size", "status"), [("3MB", 0), ("3MiB", 0), ("10", 3), ("0.01kB", 3), ("1GiB", 0)])
def test_max_bytes_takes_units(size: str, status: int) -> None:
    assert run(["inspect", str(TREE), "--max-bytes", size]) == status


@pytest.mark.parametrize("size", ["-1", "3Mbit", "3 apples", "1.5", "3iB"])
def test_a_text_that_is_not_a_size_is_wrong_usage(size: str, capsys: Capture) -> None:
    assert run(["inspect", str(TREE), f"--max-bytes={size}"]) == 2
    assert f"{size!r} is not a size: whole bytes, such as 3000000, 3MB or 3MiB" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("first", "said"),
    [
        ("x,y,z,yaw,pitch", "lacks target_x, target_y, target_z; a camera needs x, y, z, and"),
        ("x,y,z,qx,qy,qz", "lacks qw; a camera needs"),
        ("X, Y, target_x, target_y, target_z", "lacks z; a camera needs"),
        ("frame,position,rotation", "lacks x, y, z, target_x, target_y, target_z"),
    ],
)
def test_a_camera_csv_is_told_its_columns(first: str, said: str, tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "cameras.csv"
    path.write_text(f"{first}\n0,0,0,0,0\n")
    for arguments in ([], ["--camera-format", "csv"]):
        assert run(["traverse", str(TREE), "--camera-path", str(path), *arguments]) == 1
        err = capsys.readouterr().err
        assert f"error: {path}: its first line, which names the columns, {said}" in err
        assert "target_x, target_y, target_z or qx, qy, qz, qw" in err


def clamped_scene(tmp_path: Path, **values: float) -> Path:
    """A scene with one splat that has such values."""
    splats = read_scene(FIXTURES / "sh1.ply").splats
    changed = {name: np.array(getattr(splats, name)) for name in values}
    for name, value in values.items():
        changed[name][0] = value
    scene = read_scene(FIXTURES / "sh1.ply")
    path = tmp_path / "clamped.ply"
    path.write_bytes(b"".join(ply.encode(dataclasses.replace(scene, splats=dataclasses.replace(splats, **changed)))))
    return path


@pytest.mark.parametrize(
    ("name", "value", "detail", "consequence"),
    [
        ("scale", 1e-7, "scales of N are below 4.4e-05, down to 1e-07", "1.7 % of splats are smaller"),
        ("scale", 4e3, "scales of N are above 391, up to 4e+03", "1.7 % of splats are larger"),
        ("rgb", -3.0, "colours of N are below -0.444, down to -3", ""),  # black is black
        ("rgb", 4.0, "colours of N are above 1.44, up to 4", "1.7 % of colours are brighter"),
        ("sh", -2.0, "SH of N are below -1, down to -2", ""),  # too few to be seen
        ("sh", 2.5, "SH of N are above 0.996, up to 2.5", ""),
    ],
)
def test_what_is_clamped_is_said_in_a_line_and_with_verbose_in_detail(
    name: str, value: float, detail: str, consequence: str, tmp_path: Path, capsys: Capture
) -> None:
    source = clamped_scene(tmp_path, **{name: value, "opacity": 0.5})
    assert run(["build-lod", str(source)]) == 0
    _, *lines = capsys.readouterr().err.splitlines()
    expected = [f"  {consequence} than SPZ can hold; --format rad keeps more of them"] if consequence else []
    assert lines == expected
    assert run(["build-lod", str(source), "--overwrite", "-v"]) == 0
    err = capsys.readouterr().err
    advice = CLAMPED_BY_SPZ[name, "above" in detail][1]
    said = re.escape(detail).replace("N", r"\d+ nodes? \(.* %\)")
    assert re.search(rf"\n  {said}, and are clamped to what SPZ holds: {re.escape(advice)}\n", err), err
    assert err.count("clamped to") == 1
    assert "--scale" not in err


@pytest.mark.parametrize("column", [slice(0, 1), slice(0, 3)])
@pytest.mark.parametrize("count", [0, 1, 2, 300])
def test_the_note_and_inspect_go_by_one_rule(count: int, column: slice, tmp_path: Path, capsys: Capture) -> None:
    """That flat splats get thicker cannot be seen; that whole splats grow can, if they are more than 0.1 %."""
    splats = random_splats(1_000)
    splats.scale[:count, column] = 1e-6
    splats.opacity[:] = 0.5
    source, output = tmp_path / "small.ply", tmp_path / "small-lod.spz"
    source.write_bytes(b"".join(ply.encode(Scene(splats))))
    assert run(["build-lod", str(source), "-o", str(output)]) == 0
    assert ("than SPZ can hold" in capsys.readouterr().err) == (count > 1 and column.stop == 3)
    assert run(["inspect", str(output), "--check", "--json"]) == 0
    codes = [each["code"] for each in json.loads(capsys.readouterr().out)["findings"]]
    assert ("values.scale-clamped" in codes) == (count > 1 and column.stop == 3)


def test_counts_of_one_have_a_singular_noun(tmp_path: Path, capsys: Capture) -> None:
    look = ("--look-at", "0,-1,4:0,0,0", "--size", "8x8")
    lod = tmp_path / "one-lod.spz"
    for arguments in (
        ["build-lod", PLAIN, "-o", lod, "-v"],
        ["build-lod", lod, "--unlod", "-o", tmp_path / "back.ply"],
        ["inspect", PLAIN],
        ["inspect", lod],
        ["inspect", lod, "--min-splats", 2],
        ["inspect", PLAIN, "--min-splats", 2],
        ["inspect", lod, "--leaves-of", FIXTURES / "sh1.ply"],
        ["inspect", TREE, "--leaves-of", PLAIN],
        ["traverse", lod, *look, "--summary"],
        ["traverse", lod, TREE, *look, "--budget", 1],
        ["render", lod, *look, "-o", tmp_path / "a.png"],
        ["render", lod, *look, "--compare", "--budget", "1"],
        ["build-lod", PLAIN, "--rgba", FIXTURES / "sh1.ply"],
    ):
        run([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        assert out + err
        assert ONES.search(out + err) is None, (arguments, out, err)
