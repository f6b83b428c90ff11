"""Inputs of `sparklod inspect`, and assertions about them."""

from __future__ import annotations

import io
import json
import shutil
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.api import inspect_jobs
from sparklod_cli.codecs import spz
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.inspection.expectations import FORMATS, NAMES
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from tests.commands.inspect.runs import FAULTS, FOLDER, PLAIN, RAD, STREAMED, TILES, TREE, inspect, records
from tests.conftest import Capture


def test_an_unpacked_sog_counts_as_one_file(tmp_path: Path, capsys: Capture) -> None:
    assert inspect(FOLDER, FOLDER / "meta.json", "--json") == 0
    folder, meta = records(capsys.readouterr().out)
    size = sum(path.stat().st_size for path in FOLDER.iterdir())
    assert (folder["bytes"], folder["splats"], folder["format"]) == (size, 60, "SOG 2")
    assert folder | {"file": ""} == meta | {"file": ""}
    assert inspect(FOLDER, "--check", "--assert", f"bytes<={size}") == 0
    assert inspect(FOLDER, "--assert", f"bytes<={size - 1}") == 3
    broken = tmp_path / "sog"
    shutil.copytree(FOLDER, broken)
    (broken / "quats.webp").unlink()
    capsys.readouterr()
    assert inspect(broken, tmp_path, "--check") == 3
    assert capsys.readouterr().out.splitlines() == [
        f"{broken}: error: container.corrupt: 'quats.webp', which it names, cannot be read: no such file or directory",
        f"{tmp_path}: error: file.unreadable: cannot be read: is a directory, without the meta.json of an"
        " unpacked SOG, a lod-meta.json or a tileset.json",
    ]


def test_inspect_does_not_read_devices(capsys: Capture) -> None:
    assert inspect("/dev/null", "--check") == 3
    assert capsys.readouterr().out.count(": error: file.unreadable: ") == 1


@pytest.mark.parametrize("name", ["no-splats.ply", "no-splats.spz"])
def test_files_without_splats_have_a_report(name: str, capsys: Capture) -> None:
    assert inspect(FAULTS / name) == 0
    assert "0 splats, SH 0" in capsys.readouterr().out
    assert inspect(FAULTS / name, "--json", "--stats") == 0
    (record,) = records(capsys.readouterr().out)
    assert (record["splats"], record["values"]["box"], record["bytes_per_splat"]) == (0, None, None)
    assert inspect(FAULTS / name, "--check") == 3
    assert capsys.readouterr().out == f"{FAULTS / name}: error: values.empty: there are no splats\n"


def test_a_scene_is_freed_before_the_next_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    read = inspect_jobs.inspect
    seen: list[weakref.ref[object]] = []

    def look(*arguments: Any, **settings: Any) -> Any:
        assert not any(scene() for scene in seen[:-1])
        report, scene = read(*arguments, **settings)
        seen.append(weakref.ref(scene))
        return report, scene

    monkeypatch.setattr(inspect_jobs, "inspect", look)
    assert inspect(*[FOLDER] * 4, "--json") == 0
    assert len(seen) == 4


def chain(nodes: int) -> bytes:
    """A tree of nodes with a single child each: a file of bytes that are all alike, and as many levels as nodes."""
    splats = Splats.empty(nodes, 0)
    for name, value in (("center", 1), ("scale", 0.1), ("quat_xyzw", 0.5), ("opacity", 0.5), ("rgb", 0.5)):
        getattr(splats, name)[:] = value
    count, start = np.ones(nodes, np.uint16), np.arange(1, nodes + 1, dtype=np.uint32)
    count[-1] = start[-1] = 0
    return b"".join(spz.encode(Scene(splats, LodTree(count, start)), WriteOptions(compression_level=1)))


@pytest.mark.parametrize("nodes", [1000, 1001, 50_000])
def test_the_report_of_a_deep_chain_is_bounded(nodes: int, tmp_path: Path, capsys: Capture) -> None:
    """Reports do not grow with the levels of a tree, and say how many they leave out."""
    path, page = tmp_path / "chain.spz", tmp_path / "page.html"
    path.write_bytes(chain(nodes))
    left_out = max(0, nodes - 1000)
    assert inspect(path, "--html", page, "--stats") == 0
    text = capsys.readouterr().out
    assert f"depth {nodes - 1}" in text
    assert f"and {nodes - 64:,} more" in text
    assert len(text) < 10_000
    html = page.read_text()
    assert len(html) < 600_000
    assert (f"{left_out:,} greater depths are not listed" in html) == bool(left_out)
    assert f"<dt>Depth</dt><dd>{nodes - 1:,}<" in html
    assert inspect(path, "--json") == 0
    out = capsys.readouterr().out
    tree = json.loads(out)["tree"]
    assert (tree["depth"], len(tree["levels"]), tree["levels_left_out"]) == (nodes - 1, min(nodes, 1000), left_out)
    assert len(out) < 100_000


#: Of a tree of nine nodes, of which six are leaves.
HOLD = (
    *("nodes==9", "leaves==6", "growth<=1.5", "depth==2", "sh==0", "lod==true", "bytes<1MB", "bytes<1MiB"),
    *("splats>=9", "tree.leaves!=5", "tree.levels.1.nodes<=3", "header.version==3", 'format=="SPZ 3 LoD"'),
    *("antialiased==false", "values.non_finite==0", "values.box.max.0<=4", "nodes<0.01k", "tree.growth<=150%"),
)
FAIL = (
    *("nodes==8", "leaves>6", "growth<1.5", "depth!=2", "sh>=1", "lod==false", "lod!=true", "bytes<10", "format<3"),
    *('format=="SPZ"', "values.box==3", "antialiased==0", "tree.levels.99.nodes==0", "header.nothing==null"),
)


@pytest.mark.parametrize("text", HOLD)
def test_an_assertion_that_holds_is_exit_code_0(text: str, capsys: Capture) -> None:
    assert inspect(TREE, "--assert", text) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("text", FAIL)
def test_one_that_does_not_hold_is_exit_code_3_and_says_what_there_is(text: str, capsys: Capture) -> None:
    assert inspect(TREE, "--assert", text) == 3
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(f"{TREE}: error: expect.")
    assert f"{text}: " in line


def test_the_value_is_said(capsys: Capture) -> None:
    assert inspect(TREE, "--assert", "nodes<5", "--assert", "leaves<5", "--assert", "bytes<=1") == 3
    out = capsys.readouterr().out
    assert ": error: expect.value: nodes<5: nodes is 9\n" in out
    assert ": error: expect.splats: leaves<5: leaves is 6\n" in out
    assert f": error: expect.bytes: bytes<=1: bytes is {TREE.stat().st_size}\n" in out


def test_what_a_plain_file_does_not_have_does_not_hold(capsys: Capture) -> None:
    for name in ("growth", "depth"):
        assert inspect(PLAIN, "--assert", f"{name}<99") == 3
        assert f"{name}<99: the file has no tree\n" in capsys.readouterr().out
    assert inspect(PLAIN, "--assert", "lod==false", "--assert", "leaves>1") == 0


@pytest.mark.parametrize("name", NAMES)
def test_every_short_name_has_a_value_of_a_tree(name: str, capsys: Capture) -> None:
    files = {"Streamed SOG": STREAMED, "RAD": RAD, "RAD, Streamed SOG or 3D Tiles": STREAMED, "3D Tiles": TILES}
    assert inspect(files.get(FORMATS.get(name, ""), TREE), "--assert", f"{name}==12345") == 3
    assert f"{name}==12345: {name} is " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nodes", "--assert 'nodes' is not an assertion like 'nodes<=5M'"),
        ("nodes=5", "= is not one of <= >= == != < >"),
        ("nodes<many", "'many' is not a number such as 0.2, 500k, 2M or 20%"),
        ("nodes<5iB", "has no unit that is known"),
        ('format=="SPZ', "is not a text in double quotes"),
        ("node<5", "there is no 'node' in a report, did you mean nodes"),
        ("tre.leaves<5", "there is no 'tre.leaves' in a report"),
    ],
)
def test_what_cannot_be_understood_is_wrong_usage(text: str, message: str, capsys: Capture) -> None:
    assert inspect(TREE, "--assert", text) == 2
    assert message in capsys.readouterr().err


def test_assertions_of_a_file_and_of_options_all_count(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "expect.txt"
    path.write_text("nodes<9\nbytes<=1MB\n")
    assert inspect(TREE, "--expect", path, "--assert", "leaves<6") == 3
    assert [line.split(": ")[3] for line in capsys.readouterr().out.splitlines()] == ["nodes<9", "leaves<6"]


def test_standard_input_is_reported_as_the_file_is(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    assert inspect(TREE, "--json", "--stats", "--check") == 0
    (named,) = records(capsys.readouterr().out)
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(TREE.read_bytes())))
    assert inspect("-", "--json", "--stats", "--check") == 0
    (piped,) = records(capsys.readouterr().out)
    assert piped == named | {"file": "-"}
    assert inspect("-") == 0
    assert capsys.readouterr().out.startswith("standard input  SPZ 3 LoD, ")
    assert inspect("-", "--assert", "nodes<5") == 3
    assert capsys.readouterr().out.startswith("standard input: error: expect.value: ")
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"")))
    assert inspect("-") == 1
    assert "error: standard input: the file is empty" in capsys.readouterr().err
    assert inspect("-", "--json", "--check") == 3
    assert json.loads(capsys.readouterr().out)["bytes"] == 0
