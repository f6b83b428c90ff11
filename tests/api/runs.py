"""What the tests of the public interface share."""

from __future__ import annotations

import sys
from typing import Any

import pytest

import sparklod_cli as sparklod
from sparklod_cli.cli import main
from tests.conftest import FIXTURES

DEMO = FIXTURES / "demo.ply"
EYE, TARGET = (0.5, -1.0, 4.0), (0.0, 0.0, 0.0)
VIEW = "0.5,-1,4:0,0,0"
SIZE = (160, 120)


def camera(size: tuple[int, int] = SIZE) -> sparklod.Camera:
    return sparklod.Camera.look_at(EYE, TARGET, size=size)


def command(*arguments: object) -> None:
    """Runs a command, which must succeed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["sparklod", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
    assert not caught.value.code


def without_time(rows: Any) -> list[dict[str, Any]]:
    return [{name: cell for name, cell in row.items() if name != "traverse_ms"} for row in rows]
