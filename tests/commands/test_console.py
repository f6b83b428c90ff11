"""Progress bars appear where a person sits at a terminal, and nowhere else."""

from __future__ import annotations

import io

import pytest

from sparklod_cli.commands import console as console_module
from sparklod_cli.commands.console import Console, count_of, say_error


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown_on(stream: io.StringIO, monkeypatch: pytest.MonkeyPatch, *, quiet: bool = False) -> str:
    monkeypatch.setattr("sys.stderr", stream)
    with Console(quiet=quiet, verbose=False) as console:
        for done in (0, 5, 10):
            console.progress("reading", done, 10, "splat")
        console.progress("writing", 1, 4, "B")
    return stream.getvalue()


def test_a_terminal_gets_a_bar_a_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    text = shown_on(Terminal(), monkeypatch)
    assert "reading:" in text
    assert "splats" in text
    assert "writing:" in text
    assert text.endswith("\r")  # and takes it away


def test_a_file_or_a_quiet_terminal_gets_none(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shown_on(io.StringIO(), monkeypatch) == ""
    assert shown_on(Terminal(), monkeypatch, quiet=True) == ""


@pytest.mark.parametrize("quiet", [False, True])
def test_a_log_gets_a_line_of_a_long_stage_every_ten_seconds(quiet: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    log, clock = io.StringIO(), iter([0, 4, 9, 11, 15, 22, 29, 33, 100, 104, 109])
    monkeypatch.setattr("sys.stderr", log)
    monkeypatch.setattr(console_module, "monotonic", lambda: next(clock))
    with Console(quiet=quiet, verbose=False) as console:
        for done in range(8):
            console.progress("refining", 250 * done, 1750, "step")
        for done in range(3):
            console.progress("writing", done, 4, "B")
    lines = ["refining: 750 of 1,750 steps (43 %), 11 s", "refining: 1,250 of 1,750 steps (71 %), 22 s"]
    assert log.getvalue().splitlines() == ([] if quiet else lines)


def test_colour_is_for_terminals_that_want_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value, colour in (("NO_COLOR", "", True), ("NO_COLOR", "1", False), ("TERM", "dumb", False)):
        with monkeypatch.context() as patch:
            patch.delenv("NO_COLOR", raising=False)
            patch.setenv("TERM", "xterm")
            patch.setenv(name, value)
            patch.setattr("sys.stderr", stream := Terminal())
            say_error("no")
            assert ("\x1b[31m" in stream.getvalue()) == colour


def test_counts_are_said_properly() -> None:
    assert [count_of(n, "node") for n in (0, 1, 1234)] == ["0 nodes", "1 node", "1,234 nodes"]
