"""Findings as annotations of GitHub, a line each."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sparklod_cli.inspection.findings import CODES, Finding
from tests.commands.inspect.runs import BROKEN, CORRUPT, NOTED, TREE, WARNED, inspect
from tests.conftest import Capture


def test_every_finding_is_an_annotation_for_github(capsys: Capture) -> None:
    assert inspect("--check", "--format", "github", CORRUPT, BROKEN, WARNED, NOTED, TREE) == 3
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert [line.split(" ")[0] for line in lines] == ["::error", "::error", "::warning", "::notice"]
    assert lines[1] == f"::error file={BROKEN},title=tree.orphan::node 9 has no parent"
    assert err == f"{TREE}: nothing is wrong with its 9 nodes\n"


def test_no_name_ends_an_annotation_or_begins_a_command(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name could end the annotation, or begin another command."""
    path = tmp_path / "50%, a:b\n::stop.spz"
    shutil.copy(BROKEN, path)
    monkeypatch.setitem(CODES, "tree.orphan", CODES["tree.orphan"])
    monkeypatch.setattr(
        "sparklod_cli.inspection.tree.link_findings",
        lambda *_: [Finding("tree.orphan", "100% of it\r\nis: lost, all")],
    )
    monkeypatch.chdir(tmp_path)
    assert inspect("--check", "--format", "github", path.name) == 3
    name = "50%25%2C a%3Ab%0A%3A%3Astop.spz"
    assert capsys.readouterr().out == f"::error file={name},title=tree.orphan::100%25 of it%0D%0Ais: lost, all\n"


def test_a_line_is_a_finding_whatever_the_name_is(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "two\nlines.spz"
    shutil.copy(BROKEN, path)
    assert inspect("--check", path) == 3
    assert capsys.readouterr().out.count("\n") == 1
