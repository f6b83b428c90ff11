"""Draws the pictures of the gallery, of Troubleshooting and of the tutorials anew, with the commands on these pages.

`python -m tests.docs.gallery [PAGE...]`, where a page is a path such as docs/gallery.md; all pages if none is given.
"""

from __future__ import annotations

import re
import shlex
import shutil
import sys
import tempfile
from pathlib import Path

from PIL import Image

from tests.conftest import FIXTURES, ROOT

from .shell import Shell, blocks

DOCS = ROOT / "docs"

#: Pages of which each line of code is a command of sparklod; the pictures of a page are in a folder of its name.
PAGES = [DOCS / "gallery.md", DOCS / "troubleshooting.md"]

#: Pages whose code is scripts, which run one after the other.
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))

#: The scene that all commands start from.
SCENE = "demo.ply"

#: Pictures of a browser, which `python -m tests.docs.pictures browser` takes.
OF_A_BROWSER = {"browser.webp"}

#: WebP quality of the pictures of tutorials.
QUALITY = 85

#: Scripts that end only when they are stopped: servers.
SERVERS = re.compile(r"^sparklod view (?!.*--export)|http\.server", re.MULTILINE)


def folder_of(page: Path) -> Path:
    """Return the folder of a page's pictures."""
    return (DOCS / "images" / page.relative_to(DOCS)).with_suffix("")


def commands(page: Path) -> list[list[str]]:
    """Return the arguments of each command on a page, without the program's name."""
    scripts = blocks(page.read_text(encoding="utf-8"), "sh")
    lines = [shlex.split(line) for script in scripts for line in script.splitlines()]
    assert all(line[0] == "sparklod" for line in lines)
    return [line[1:] for line in lines]


def pictures(page: Path) -> list[str]:
    """Return the files that a page shows, relative to the folder of the page."""
    return re.findall(r"!\[[^\]]+\]\(([^)]+)\)", page.read_text(encoding="utf-8"))


def drawn(page: Path) -> set[str]:
    """Return the names of the pictures that the commands of a page draw."""
    return {Path(picture).name for picture in pictures(page)} - OF_A_BROWSER


def draw(page: Path) -> None:
    """Run all commands of a page in an empty folder that has the scene, and keep what the page shows."""
    bash = shutil.which("bash")
    assert bash, "bash is not installed"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(FIXTURES / SCENE, folder)
        shell = Shell(folder, bash)
        for script in blocks(page.read_text(encoding="utf-8"), "sh"):
            if not SERVERS.search(script):
                done = shell(script)
                assert done.returncode == 0, (script, done.stderr)
        folder_of(page).mkdir(parents=True, exist_ok=True)
        for picture in drawn(page):
            if page in TUTORIALS:
                Image.open(folder / picture).convert("RGB").save(folder / picture, quality=QUALITY, method=6)
            shutil.copy(folder / picture, folder_of(page))


def main() -> None:
    """Draw the pictures of the pages that the command line names, or of all."""
    for page in [Path(name).resolve() for name in sys.argv[1:]] or [*PAGES, *TUTORIALS]:
        draw(page)


if __name__ == "__main__":
    main()
