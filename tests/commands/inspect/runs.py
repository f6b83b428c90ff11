"""Runs of `sparklod inspect` and what it reads."""

from __future__ import annotations

import json
from typing import Any

from sparklod_cli.cli import run
from tests.conftest import FIXTURES

TREE, PLAIN = FIXTURES / "golden" / "hand-tree-v3.spz", FIXTURES / "sh2.ply"
RAD = FIXTURES / "golden" / "sh1-tree.rad"
STREAMED, TILES = FIXTURES / "golden" / "sh1-streamed-sog", FIXTURES / "golden" / "sh1-tiles"
FOLDER = FIXTURES / "golden" / "sh1-sog"
FAULTS = FIXTURES / "faults"
CORRUPT, WARNED, NOTED = FAULTS / "spz-flipped-bit.spz", FAULTS / "spz-flags.spz", FAULTS / "tree-fine-first.spz"
BROKEN, MISSING = FAULTS / "tree-orphan.spz", FAULTS / "missing.spz"


def inspect(*arguments: object) -> int:
    return run(["inspect", *map(str, arguments)])


def records(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]
