"""Runs commands as processes, and checks what must hold however they end."""

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

from sparklod_cli.codecs.rad import rad_header
from sparklod_cli.io.reading import read_scene
from tests.conftest import FIXTURES, ROOT

DEMO = FIXTURES / "demo.ply"
SMALL = FIXTURES / "sh3.ply"
TREE = FIXTURES / "golden" / "tree-v3.spz"
#: Modules in this folder replace packages that take seconds to load.
WITHOUT = Path(__file__).parent / "without"
ENVIRONMENT = {**os.environ, "NO_COLOR": "1", "PYTHONPATH": f"{WITHOUT}{os.pathsep}{ROOT}"}

#: The arguments that write a tree as a header and a file for its chunk.
CHUNKED = ["build-lod", DEMO, "--format", "rad-chunked", "-o"]

#: The arguments of each command, and the name of its output, which is added to them.
WRITERS: dict[str, tuple[Sequence[object], str]] = {
    "build-lod": (["build-lod", DEMO, "-o"], "demo.spz"),
    "traverse": (["traverse", TREE, "--orbit", "300", "--no-timing", "-o"], "table.csv"),
    "render": (["render", TREE, "--size", "320x200", "-o"], "picture.png"),
    "inspect": (["inspect", TREE, "-q", "--html"], "page.html"),
}


def command(*arguments: object) -> list[str]:
    """Returns the command line of a run."""
    return [sys.executable, "-m", "sparklod_cli", *map(str, arguments)]


def sparklod(*arguments: object, **how: object) -> subprocess.CompletedProcess[str]:
    """Runs sparklod to its end."""
    settings = {"capture_output": True, "text": True, "check": False, "env": ENVIRONMENT, "timeout": 300} | how
    return subprocess.run(command(*arguments), **settings)


def shell(script: str, *arguments: object, **how: object) -> subprocess.CompletedProcess[str]:
    """Runs sparklod in a shell; `script` has "$@" in place of the command line."""
    settings = {"capture_output": True, "text": True, "check": False, "env": ENVIRONMENT, "timeout": 300} | how
    return subprocess.run(["bash", "-c", script, "bash", *command(*arguments)], **settings)


def said_one_error(err: str) -> str:
    """Asserts that standard error has one error, apart from messages about compilation; returns its line."""
    lines = [line for line in err.splitlines() if "ompil" not in line]
    assert len(lines) == 1, err
    assert lines[0].lower().startswith("error: "), err
    return lines[0]


def check_whole(path: Path) -> None:
    """Asserts that an output is complete."""
    if path.suffix == ".radc":
        with path.open("rb") as file:
            header = rad_header.read_chunk_header(file)
        assert path.stat().st_size == header.bytes + header.payload_bytes
    elif path.suffix in (".spz", ".rad"):
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
    """Mounts a file system in memory; skips the test if this process may not mount one."""
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
