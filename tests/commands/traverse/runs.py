"""Runs of `sparklod traverse` and what it reads."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

from sparklod_cli.cli import run
from sparklod_cli.simulation.results import COLUMNS
from tests.conftest import FIXTURES

TOWN, TREE = FIXTURES / "traverse" / "town.spz", FIXTURES / "golden" / "hand-tree-v3.spz"
OTHER = FIXTURES / "golden" / "tree-v3.spz"
FAULTS, CAMERAS = FIXTURES / "faults", FIXTURES / "cameras"
NAMES = [column.name for column in COLUMNS]
ORBIT = ("--orbit", 3, "--distance", 5, "--center", "0,0,0")


def traverse(*arguments: object) -> int:
    return run(["traverse", *map(str, arguments)])


def table(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def scene_file(folder: Path, *instances: object) -> Path:
    path = folder / "scene.json"
    path.write_text(json.dumps({"instances": instances}))
    return path
