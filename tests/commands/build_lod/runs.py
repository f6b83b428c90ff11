"""Runs of `sparklod build-lod` and what it reads."""

from __future__ import annotations

import subprocess
import sys

from sparklod_cli.cli import run
from tests.conftest import FIXTURES, ROOT

ONE, SMALL = FIXTURES / "one.ply", FIXTURES / "sh2.ply"


def build(*arguments: object) -> int:
    return run(["build-lod", *map(str, arguments)])


def convert(*arguments: object) -> int:
    """Run `convert`, and return its exit status."""
    return run(["convert", *map(str, arguments)])


def sparklod(*arguments: object, **how: object) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "sparklod_cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, check=False, cwd=ROOT, **how)
