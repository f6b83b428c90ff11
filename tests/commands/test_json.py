"""What a command prints with --json is one object for each result, with the version of its fields."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sparklod_cli.cli import COMMANDS, run
from sparklod_cli.commands.console import JSON_VERSION
from sparklod_cli.inspection.report import SCHEMA_VERSION
from tests.conftest import FIXTURES, Capture

PLAIN, TREE = FIXTURES / "sh0.ply", FIXTURES / "golden" / "hand-tree-v3.spz"

#: By command, arguments that print an object with little work; {} stands for a new file or folder.
LITTLE = {
    "build-lod": [PLAIN, "-o", "{}.spz"],
    "convert": [PLAIN, "{}.sog"],
    "simplify": [PLAIN, "--to", "50%", "-o", "{}.ply"],
    "inspect": [TREE],
    "traverse": [TREE, "--orbit", "2"],
    "render": [TREE, "--size", "32x24", "-o", "{}.png"],
    "render --compare": [TREE, "--orbit", "1", "--size", "64x48", "--budget", "50%"],
    "view": [TREE, "--export", "{}"],
    "warmup": ["--jobs", "1"],
    "doctor": [],
}


def test_every_command_with_results_is_tried() -> None:
    assert {name.split()[0] for name in LITTLE} == set(COMMANDS) - {"completion", "help"}


@pytest.mark.parametrize("command", LITTLE)
def test_an_object_says_the_version_of_its_fields_first(command: str, tmp_path: Path, capsys: Capture) -> None:
    arguments = [str(each).replace("{}", str(tmp_path / "new")) for each in LITTLE[command]]
    assert run([*command.split(), *arguments, "--json"]) in (0, 1)  # 1 where doctor finds problems
    first, version = next(iter(json.loads(capsys.readouterr().out).items()))
    assert (first, version) == ("schema_version", SCHEMA_VERSION if command == "inspect" else JSON_VERSION)
