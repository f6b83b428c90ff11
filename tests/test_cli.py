"""The command line: version, help and completion, and that they load nothing heavy."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from sparklod_cli import __version__
from sparklod_cli.cli import BLAS_THREADS, COMMANDS
from tests.commands.build_lod.runs import sparklod
from tests.conftest import ROOT


def test_every_command_has_version_and_help() -> None:
    for arguments in (["--version"], ["build-lod", "--version"]):
        assert sparklod(*arguments).stdout.decode() == f"sparklod, version {__version__}\n"
    for arguments in (["--help"], *([command, "--help"] for command in COMMANDS)):
        assert b"Usage: sparklod" in sparklod(*arguments).stdout
    assert b"Examples:" in sparklod("build-lod", "--help").stdout


def test_completion_knows_the_options() -> None:
    words = {"COMP_WORDS": "sparklod build-lod --over", "COMP_CWORD": "2", "_SPARKLOD_COMPLETE": "bash_complete"}
    code = "from sparklod_cli.cli import cli; cli(prog_name='sparklod')"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT, env={**os.environ, **words}
    )
    assert "--overwrite" in result.stdout


@pytest.mark.parametrize(("given", "found"), [(None, "1"), ("3", None)])
def test_numpy_starts_no_threads_unless_a_person_asks_for_them(given: str | None, found: str | None) -> None:
    code = """
import atexit, os, sys
from sparklod_cli.cli import main
atexit.register(lambda: print(os.environ.get("OPENBLAS_NUM_THREADS"), os.environ.get("OMP_NUM_THREADS")))
sys.argv = ["sparklod", "--version"]
main()
"""
    environment = {name: value for name, value in os.environ.items() if name not in BLAS_THREADS}
    if given is not None:
        environment["OMP_NUM_THREADS"] = given
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, env=environment)
    assert result.stdout.splitlines()[-1] == f"{found} {given}", result.stderr
