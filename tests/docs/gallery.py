"""Draws the pictures of docs/gallery.md and docs/troubleshooting.md anew, with the commands that these pages show.

`python -m tests.docs.gallery`
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.conftest import FIXTURES, ROOT

#: The pages; the pictures of each are in a folder of its name.
PAGES = [ROOT / "docs" / "gallery.md", ROOT / "docs" / "troubleshooting.md"]

#: The scene that all commands start from.
SCENE = "demo.ply"


def folder_of(page: Path) -> Path:
    """Return the folder of a page's pictures."""
    return ROOT / "docs" / "images" / page.stem


def commands(page: Path) -> list[list[str]]:
    """The arguments of each command on a page, without the program's name."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    lines = [shlex.split(line) for block in blocks for line in block.splitlines()]
    assert all(line[0] == "sparklod" for line in lines)
    return [line[1:] for line in lines]


def pictures(page: Path) -> list[str]:
    """The files that a page shows, relative to docs/."""
    return re.findall(r"!\[[^\]]+\]\(([^)]+)\)", page.read_text(encoding="utf-8"))


def main() -> None:
    """Runs all commands of each page in an empty folder that has the scene, and keeps what the page shows."""
    for page in PAGES:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            shutil.copy(FIXTURES / SCENE, folder)
            for arguments in commands(page):
                subprocess.run([sys.executable, "-m", "sparklod_cli", *arguments], cwd=folder, check=True)
            folder_of(page).mkdir(parents=True, exist_ok=True)
            for picture in pictures(page):
                shutil.copy(folder / Path(picture).name, folder_of(page))


if __name__ == "__main__":
    main()
