"""`sparklod build-lod -` makes of standard input what it makes of the file."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.support.stdin import spooled
from tests.commands.build_lod.runs import SMALL, build, sparklod
from tests.conftest import FIXTURES, Capture

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
    assert build("-", "--unlod", "-o", tmp_path / "piped.ply") == 0
    assert build(tmp_path / "tree.spz", "--unlod", "-o", tmp_path / "named.ply") == 0
    assert (tmp_path / "piped.ply").read_bytes() == (tmp_path / "named.ply").read_bytes()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "error: standard input: the file is empty"),
        (b"hello", "error: standard input: not a splat file that sparklod reads"),
        ((FIXTURES / "golden/sh0.splat").read_bytes(), "a .splat file is not recognised by its content"),
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
