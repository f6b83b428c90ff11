"""Runs the command in processes of their own, and says what must hold of them however they end."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sparklod_cli.io import read_scene
from tests.conftest import FIXTURES, ROOT

DEMO = FIXTURES / "demo.ply"
SMALL = FIXTURES / "sh3.ply"
TREE = FIXTURES / "golden" / "tree-v3.spz"
#: What is in this folder takes the place of packages that take seconds to load.
WITHOUT = Path(__file__).parent / "without"
ENVIRONMENT = {**os.environ, "NO_COLOR": "1", "PYTHONPATH": f"{WITHOUT}{os.pathsep}{ROOT}"}

#: What each command is given, and the name of what it writes.
WRITERS: dict[str, tuple[Sequence[object], str]] = {
    "build-lod": (["build-lod", DEMO, "-o"], "demo.spz"),
    "traverse": (["traverse", TREE, "--orbit", "300", "--no-timing", "-o"], "table.csv"),
    "render": (["render", TREE, "--size", "320x200", "-o"], "picture.png"),
    "inspect": (["inspect", TREE, "-q", "--html"], "page.html"),
}


def command(*arguments: object) -> list[str]:
    """The command line of a run."""
    return [sys.executable, "-m", "sparklod_cli", *map(str, arguments)]


def sparklod(*arguments: object, **how: object) -> subprocess.CompletedProcess[str]:
    """A run to its end."""
    settings = {"capture_output": True, "text": True, "check": False, "env": ENVIRONMENT, "timeout": 300} | how
    return subprocess.run(command(*arguments), **settings)


def shell(script: str, *arguments: object, **how: object) -> subprocess.CompletedProcess[str]:
    """A run in a shell: `script` has "$@" where the command line belongs."""
    settings = {"capture_output": True, "text": True, "check": False, "env": ENVIRONMENT, "timeout": 300} | how
    return subprocess.run(["bash", "-c", script, "bash", *command(*arguments)], **settings)


def said_one_error(err: str) -> str:
    """The one line on standard error, beside what is said of compiling."""
    lines = [line for line in err.splitlines() if "ompil" not in line]
    assert len(lines) == 1, err
    assert lines[0].lower().startswith("error: "), err
    return lines[0]


def check_whole(path: Path) -> None:
    """A file that a command wrote is complete."""
    if path.suffix == ".spz":
        scene = read_scene(path)
        assert scene.tree is not None
        scene.tree.validate()
    elif path.suffix in (".png", ".webp"):
        with Image.open(path) as image:
            image.load()
    elif path.suffix == ".npy":
        assert np.load(path).ndim
    elif path.suffix == ".html":
        assert path.read_text().rstrip().endswith("</html>")
    else:
        text = path.read_text()
        assert text.endswith("\n")
        assert len({line.count(",") for line in text.splitlines()}) == 1


@contextlib.contextmanager
def mounted(folder: Path, options: str) -> Iterator[Path]:
    """A file system in memory, of its own; skips the test where this process may not mount one."""
    folder.mkdir()
    try:
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], capture_output=True, check=False
        )
    except OSError:
        pytest.skip("there is no mount here")
    if done.returncode:
        pytest.skip("this process may not mount a file system")
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)
