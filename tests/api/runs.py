"""What the tests of the public interface share."""

from __future__ import annotations

from typing import Any

import sparklod_cli as sparklod
from sparklod_cli.cli import run
from tests.conftest import FIXTURES

DEMO = FIXTURES / "demo.ply"
EYE, TARGET = (0.5, -1.0, 4.0), (0.0, 0.0, 0.0)
VIEW = "0.5,-1,4:0,0,0"
SIZE = (160, 120)


def camera(size: tuple[int, int] = SIZE) -> sparklod.Camera:
    return sparklod.Camera.look_at(EYE, TARGET, size=size)


def command(*arguments: object) -> None:
    """Runs a command, which must succeed."""
    assert run([str(argument) for argument in arguments]) == 0


def without_time(rows: Any) -> list[dict[str, Any]]:
    return [{name: cell for name, cell in row.items() if name != "traverse_ms"} for row in rows]
