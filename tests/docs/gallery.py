"""Draws the pictures of docs/gallery.md anew, with the commands that the page shows: `python -m tests.docs.gallery`."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.conftest import FIXTURES, ROOT

PAGE = ROOT / "docs" / "gallery.md"
FOLDER = ROOT / "docs" / "images" / "gallery"

#: The scene that all commands start from.
SCENE = "demo.ply"


def commands() -> list[list[str]]:
    """The arguments of each command on the page, without the program's name."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    lines = [shlex.split(line) for block in blocks for line in block.splitlines()]
    assert all(line[0] == "sparklod" for line in lines)
    return [line[1:] for line in lines]


def pictures() -> list[str]:
    """The files that the page shows, relative to docs/."""
    return re.findall(r"!\[[^\]]+\]\(([^)]+)\)", PAGE.read_text(encoding="utf-8"))


def main() -> None:
    """Runs all commands in an empty folder that has the scene, and keeps what the page shows."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(FIXTURES / SCENE, folder)
        for arguments in commands():
            subprocess.run([sys.executable, "-m", "sparklod_cli", *arguments], cwd=folder, check=True)
        FOLDER.mkdir(parents=True, exist_ok=True)
        for picture in pictures():
            shutil.copy(folder / Path(picture).name, FOLDER)


if __name__ == "__main__":
    main()
