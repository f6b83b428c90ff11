"""Kernels that Python runs itself, as NUMBA_DISABLE_JIT=1 asks for: every command makes the same files, slowly."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import sparklod_cli as sparklod
from sparklod_cli.cli import run
from sparklod_cli.model.scene import Scene
from tests.conftest import ROOT
from tests.scenes import random_splats

#: A command a line; each reads files of those before it.
COMMANDS = """
build-lod scene.ply -o quick.spz
build-lod scene.ply -o quick.rad
build-lod scene.ply --method quality -o quality.spz
inspect quick.rad --json
traverse quick.spz --orbit 2 --size 32x32 --budget 12 -o whole.csv
traverse quick.rad --orbit 2 --size 32x32 --bandwidth 1Mbit -o streamed.csv
render quick.spz --budget 12 --size 16x16 -o cut.png
simplify scene.ply --to 12 -o few.ply
"""

#: Runs the lines of standard input; a warning of numpy is a failure.
SCRIPT = """
import sys
from sparklod_cli.cli import run
for line in sys.stdin:
    assert run(line.split()) == 0, line
"""


def test_commands_make_the_same_files_without_compilation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = [tmp_path / name for name in ("compiled", "interpreted")]
    for folder in folders:
        folder.mkdir()
        sparklod.write(folder / "scene.ply", Scene(random_splats(24, sh_degree=1)))
    lines = COMMANDS.strip()
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "error::RuntimeWarning", "-c", SCRIPT]
    subprocess.run(command, cwd=folders[1], env=environment, input=lines, text=True, check=True)
    monkeypatch.chdir(folders[0])
    assert [run(line.split()) for line in lines.splitlines()] == [0] * len(lines.splitlines())
    made, expected = ({path.name: contents(path) for path in folder.iterdir()} for folder in folders)
    assert made == expected
    assert len(made) == 8


def contents(path: Path) -> object:
    """Return the bytes of a file; of a table, its cells but for times that the machine needs."""
    if path.suffix != ".csv":
        return path.read_bytes()
    header, *rows = (line.split(",") for line in path.read_text("utf-8").splitlines())
    at = header.index("traverse_ms")
    return [row[:at] + row[at + 1 :] for row in rows]
