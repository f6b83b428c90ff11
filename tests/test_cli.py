"""The command line: version, help and completion, and that they load nothing heavy."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from sparklod_cli import __version__
from sparklod_cli.cli import BLAS_THREADS, COMMANDS, one_thread_of_blas
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
def test_numpy_starts_no_threads_unless_a_person_asks_for_them(
    given: str | None, found: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in BLAS_THREADS:
        monkeypatch.delenv(name, raising=False)
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    one_thread_of_blas()
    assert os.environ.pop("OPENBLAS_NUM_THREADS", None) == found
    assert os.environ.get("OMP_NUM_THREADS") == given
