"""`inspect --assert`: the language of `traverse --assert`, about the report on a file."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest

from sparklod_cli.inspection.expectations import FORMATS, NAMES
from tests.commands.inspect.runs import PLAIN, RAD, STREAMED, TREE, inspect, records
from tests.conftest import Capture

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
    files = {"Streamed SOG": STREAMED, "RAD": RAD, "RAD or Streamed SOG": STREAMED}
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
    path = tmp_path / "expect.toml"
    path.write_text('assert = ["nodes<9"]\nmax_bytes = 1_000_000\n')
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
