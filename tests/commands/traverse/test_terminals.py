"""What a person at a terminal sees of a traversal: the summary, unless the table was asked for."""

from __future__ import annotations

import sys

import pytest

from tests.commands.traverse.runs import ORBIT, TOWN, table, traverse
from tests.conftest import Capture


def at_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)


def test_a_terminal_gets_the_summary(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    at_a_terminal(monkeypatch)
    for quiet in ((), ("-q",)):
        assert traverse(TOWN, *ORBIT, *quiet) == 0
        out, err = capsys.readouterr()
        assert "splats drawn" in out
        assert "frame,time_s" not in out
        assert "splats drawn" not in err  # once is enough


@pytest.mark.parametrize("option", [("--format", "csv"), ("--per-instance",), ("--no-timing",)], ids=str)
def test_a_terminal_gets_the_table_by_output_alone(
    option: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    at_a_terminal(monkeypatch)
    assert traverse(TOWN, *ORBIT, *option) == 2
    assert f"{option[0]} is of the table, and a terminal gets the summary; redirect" in capsys.readouterr().err
    assert traverse(TOWN, *ORBIT, *option, "-o", "-") == 0
    assert len({row["frame"] for row in table(capsys.readouterr().out)}) == 3


def test_a_terminal_gets_no_summary_that_nobody_wants(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    at_a_terminal(monkeypatch)
    assert traverse(TOWN, *ORBIT, "--no-summary") == 0
    assert capsys.readouterr() == ("", "")


def test_a_pipe_gets_the_table(capsys: Capture) -> None:
    assert traverse(TOWN, *ORBIT) == 0
    out, err = capsys.readouterr()
    assert len(table(out)) == 3
    assert err == ""


def test_what_must_hold_is_checked_without_a_table(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    at_a_terminal(monkeypatch)
    assert traverse(TOWN, *ORBIT, "--assert", "selected<0") == 3
    out, err = capsys.readouterr()
    assert "splats drawn" in out
    assert err.startswith("error: ")
