"""`sparklod doctor`: text, JSON and exit status."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.commands import installation as doctor
from sparklod_cli.commands.installation import Check
from tests.conftest import ROOT, Capture

FINE = Check("sparklod", "ok", "0.1.0")
NOTE = Check("extra video", "note", "imageio is missing", "pip install imageio")
MEMORY = Check("memory", "note", "1.0 of 2.0 GB are available", "free some")
PROBLEM = Check("numba", "problem", "is \x1b[31mmissing", "pip install 'numba>=0.60'")


def find(monkeypatch: pytest.MonkeyPatch, *checks: Check) -> None:
    def check_all(begun: Callable[[str], None]) -> list[Check]:
        begun("everything")
        return list(checks)

    monkeypatch.setattr(doctor, "check_all", check_all)


def test_columns_are_aligned_and_advice_is_below(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    find(monkeypatch, FINE, NOTE, PROBLEM)
    assert run(["doctor"]) == 1
    captured = capsys.readouterr()
    assert captured.out.splitlines() == [
        "ok      sparklod     0.1.0",
        "note    extra video  imageio is missing",
        "                     -> pip install imageio",
        "problem numba        is \\x1b[31mmissing",
        "                     -> pip install 'numba>=0.60'",
    ]
    assert captured.err == "1 problem to solve before baking works; 1 optional extra not installed (video)\n"


def test_notes_alone_are_no_failure(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    find(monkeypatch, FINE, NOTE)
    assert run(["doctor", "-v"]) == 0
    greeting = "OK: everything that baking needs works; 1 optional extra not installed (video)"
    assert capsys.readouterr().err == f"checking everything\n{greeting}\n"


@pytest.mark.parametrize(
    ("checks", "said"),
    [
        ((FINE,), "OK: everything that baking needs works"),
        ((FINE, MEMORY), "OK: everything that baking needs works; 1 note"),
        (
            (NOTE, dataclasses.replace(NOTE, name="extra cuda"), MEMORY, MEMORY),
            "OK: everything that baking needs works; 2 optional extras not installed (video, cuda); 2 other notes",
        ),
        ((PROBLEM, PROBLEM, MEMORY), "2 problems to solve before baking works; 1 note"),
    ],
)
def test_the_last_line_greets_or_warns(
    checks: tuple[Check, ...], said: str, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    find(monkeypatch, *checks)
    run(["doctor"])
    assert capsys.readouterr().err == f"{said}\n"


def test_quiet_prints_problems_only(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    find(monkeypatch, FINE, NOTE, PROBLEM)
    assert run(["doctor", "-q"]) == 1
    captured = capsys.readouterr()
    assert [line.split()[0] for line in captured.out.splitlines()] == ["problem", "->"]
    assert captured.err == ""


@pytest.mark.parametrize("checks", [(FINE, NOTE), (FINE, PROBLEM)])
def test_json_has_all_of_it(checks: tuple[Check, ...], monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    find(monkeypatch, *checks)
    fine = PROBLEM not in checks
    assert run(["doctor", "--json", "--quiet"]) == (0 if fine else 1)
    about = json.loads(capsys.readouterr().out)
    assert about["ok"] is fine
    assert [Check(**check) for check in about["checks"]] == list(checks)


@pytest.mark.parametrize("broken", ["numpy", "numba", "moderngl"])
def test_a_package_that_breaks_is_told_and_the_rest_is_still_looked_at(broken: str, tmp_path: Path) -> None:
    for name in {broken, "open3d"}:  # which takes many seconds where it works
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('broken on purpose')")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    command = [sys.executable, "-m", "sparklod_cli", "doctor", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)
    needed = broken in ("numpy", "numba")
    assert done.returncode == (1 if needed else 0), done.stderr
    checks = {check["name"]: check for check in json.loads(done.stdout)["checks"]}
    assert {"processors", "memory", "Node", "Chromium"} <= set(checks)
    if needed:
        assert checks["kernels"]["state"] == "problem"
        assert "broken on purpose" in checks["kernels"]["value"]
