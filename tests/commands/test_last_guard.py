"""Whatever nobody foresaw is one line that asks for a report, and exit status 1."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.io import reading
from tests.conftest import FIXTURES, Capture

SCENE = FIXTURES / "one.ply"
Break = Callable[[BaseException], None]


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> Break:
    """Makes the reading of any file end in an exception."""

    def end_in(error: BaseException) -> None:
        def fail(*args: object, **kwargs: object) -> None:
            raise error

        monkeypatch.setattr(reading, "opened", fail)

    return end_in


@pytest.mark.parametrize("command", ["build-lod", "build-lod --unlod", "inspect", "inspect --check", "render"])
@pytest.mark.parametrize(
    "error",
    [ZeroDivisionError("division\nby zero"), EOFError("cut"), AssertionError(), KeyError("x"), StopIteration(1)],
)
def test_a_bug_is_one_line_that_asks_for_a_report(
    command: str, error: Exception, broken: Break, tmp_path: Path, capsys: Capture
) -> None:
    broken(error)
    out = [] if command.startswith("inspect") else ["-o", str(tmp_path / "out.spz" if "build" in command else "a.png")]
    assert run([*command.split(), str(SCENE), *out]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: sparklod failed in a way that it should not: ")
    assert type(error).__name__ in line
    assert "please report" in line
    assert "-v shows" in line
    assert not list(tmp_path.iterdir())


def test_verbose_shows_the_traceback_before_the_error(broken: Break, capsys: Capture) -> None:
    broken(ZeroDivisionError("division by zero"))
    assert run(["inspect", str(SCENE), "-v"]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback")
    assert lines[-2] == "ZeroDivisionError: division by zero"
    assert lines[-1].startswith("error: sparklod failed")
    assert "-v shows" not in lines[-1]
    assert run(["inspect", str(SCENE)]) == 1  # what one run was told does not last
    assert "Traceback" not in capsys.readouterr().err


def test_the_line_of_a_bug_is_short_and_printable(broken: Break, capsys: Capture) -> None:
    broken(RuntimeError("\x1b[31m" + "x" * 100_000))
    assert run(["inspect", str(SCENE)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "\x1b" not in line
    assert len(line) < 400


def test_an_interruption_is_not_reported_as_a_bug(broken: Break, capsys: Capture) -> None:
    broken(KeyboardInterrupt())
    assert run(["inspect", str(SCENE)]) == 130
    assert capsys.readouterr().err.strip() == "interrupted"
    broken(SystemExit(7))
    with pytest.raises(SystemExit) as caught:
        run(["inspect", str(SCENE)])
    assert caught.value.code == 7
