"""Code blocks of pages, and a shell that runs them with the `sparklod` under test."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.conftest import ROOT

#: Time limit of a script, in seconds: far above what any takes.
TIMEOUT = 300


def blocks(page: str, language: str) -> list[str]:
    """Return the code blocks of a page in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)


class Shell:
    """bash in a folder, with a `sparklod` that is the one under test.

    Args:
        folder: the folder to run in; gets a folder `bin` with the command.
        bash: the program.
    """

    def __init__(self, folder: Path, bash: str) -> None:
        self._folder = folder
        self._bash = bash
        command = folder / "bin" / "sparklod"
        command.parent.mkdir()
        command.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m sparklod_cli "$@"\n')
        command.chmod(0o755)
        extra = {"PATH": f"{command.parent}{os.pathsep}{os.environ['PATH']}", "GITHUB_STEP_SUMMARY": "summary.md"}
        self._environment = os.environ | extra | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}

    def __call__(self, *words: str, errors: int = subprocess.PIPE) -> subprocess.CompletedProcess[str]:
        """Run a script as bash runs the steps of a workflow, or a command of several words.

        Args:
            words: the script, or the words of the command.
            errors: where standard error goes; `subprocess.STDOUT` puts it between the lines of standard output.
        """
        return subprocess.run(
            self._words(*words),
            cwd=self._folder,
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=errors,
            encoding="utf-8",
            timeout=TIMEOUT,
            check=False,
        )

    def start(self, script: str) -> subprocess.Popen[str]:
        """Start a command that ends only when it is stopped; standard error is put into standard output."""
        return subprocess.Popen(
            self._words(f"exec {script}"),
            cwd=self._folder,
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
        )

    def _words(self, *words: str) -> Sequence[str]:
        return words if len(words) > 1 else [self._bash, "-e", "-c", *words]
