"""Runs command lines in this process, in a folder of their own, with fixtures by their names."""

from __future__ import annotations

import csv
import io
import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import pytest

import sparklod_cli
from sparklod_cli.cli import run
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from tests.conftest import FIXTURES

#: Files and folders that a command line can name: all scenes, trees, faulty files and camera paths of the fixtures.
NAMED = {
    path.name: path
    for pattern in ("faults/*", "*.ply", "golden/*", "traverse/*", "cameras/*")
    for path in FIXTURES.glob(pattern)
}


class Done(NamedTuple):
    """Exit status and output of a command."""

    status: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)

    @property
    def records(self) -> list[Any]:
        """The JSON objects on standard output, a line each."""
        return [json.loads(line) for line in self.out.splitlines()]

    @property
    def rows(self) -> list[dict[str, str]]:
        """The rows of a CSV table on standard output."""
        return list(csv.DictReader(io.StringIO(self.out)))

    @property
    def words(self) -> str:
        """Standard error as one line."""
        return " ".join(self.err.split())


class Cli:
    """Runs command lines in a folder, to which the fixtures that they name are copied."""

    def __init__(self, folder: Path, capture: pytest.CaptureFixture[bytes]) -> None:
        self.folder = folder
        self.inputs: set[str] = set()
        self._capture = capture

    def __call__(self, line: str, *more: object, status: int | None = 0, stdin: bytes | None = None) -> Done:
        """Run a command line, and compare its exit status.

        Args:
            line: words after `sparklod`, quoted as in a shell.
            more: words that are appended.
            status: expected exit status; None for any.
            stdin: content of standard input.
        """
        words = [*shlex.split(line), *map(str, more)]
        for word in words:
            self.copy(word)
        self._capture.readouterr()
        stream = sys.stdin if stdin is None else io.TextIOWrapper(io.BytesIO(stdin))
        with mock.patch("sys.stdin", stream):
            code = run(words)
        out, err = (text.decode(errors="replace") for text in self._capture.readouterr())
        assert status in (code, None), f"{shlex.join(words)}\nexit status {code}\n{err[-2000:]}"
        return Done(code, out, err)

    def copy(self, word: str) -> None:
        """Copy the fixture that a word names, if it names one that is not in the folder yet."""
        name = word.split("/")[0]
        source, target = NAMED.get(name), self.folder / name
        if source is not None and not target.exists():
            self.inputs.add(name)
            (shutil.copytree if source.is_dir() else shutil.copy)(source, target)

    def put(self, name: str, content: bytes | str | Splats | Scene) -> Path:
        """Write an input; splats and scenes in the format of the name."""
        path = self.folder / name
        self.inputs.add(Path(name).parts[0])
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, bytes | str):
            path.write_bytes(content.encode() if isinstance(content, str) else content)
        else:
            sparklod_cli.write(path, content if isinstance(content, Scene) else Scene(content), overwrite=True)
        return path

    def made(self) -> list[str]:
        """Names of all files that are no inputs, sorted."""
        found = (path.relative_to(self.folder) for path in self.folder.rglob("*") if not path.is_dir())
        return sorted(path.as_posix() for path in found if path.parts[0] not in self.inputs)


def process(line: str, *more: object, **how: Any) -> subprocess.CompletedProcess[Any]:
    """Run a command line as a process, by default with fixtures as the current folder's."""
    command = [sys.executable, "-m", "sparklod_cli", *shlex.split(line), *map(str, more)]
    return subprocess.run(command, **{"capture_output": True, "check": False, "timeout": 300} | how)
