"""Draws the picture of docs/traverse-table.md anew, with the instances file and the command that the page shows.

`SPARKLOD_SCENES=folder python -m tests.docs.traverse_picture`; the folder has biker.spz, playbot.sog and meadow.sog.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from tests.conftest import ROOT

PAGE = ROOT / "docs" / "traverse-table.md"
PICTURE = ROOT / "docs" / "images" / "traverse.webp"

#: What its trees are baked from, with the quality builder.
SCENES = ("biker.spz", "playbot.sog", "meadow.sog")

#: Pixels that the picture is made narrower to, and its WebP quality, so that the repository stays small.
WIDTH, QUALITY = 1100, 85


def example() -> tuple[str, list[str]]:
    """The instances file, and the arguments of the command that draws it."""
    plot = PAGE.read_text(encoding="utf-8").partition("\n## Plot\n")[2]
    (command,) = re.findall(r"```sh\nsparklod (.*)\n```", plot)
    (instances,) = re.findall(r"```json\n(.*?)```", plot, re.DOTALL)
    return instances, shlex.split(command)


def main() -> None:
    """Bakes, draws and shrinks."""
    scenes = Path(os.environ["SPARKLOD_SCENES"]).resolve()
    instances, arguments = example()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "city.json").write_text(instances, encoding="utf-8")
        bake = ["build-lod", *(str(scenes / scene) for scene in SCENES), "--method", "quality", "--output-dir", "."]
        for each in (bake, arguments):
            subprocess.run([sys.executable, "-m", "sparklod_cli", *each], cwd=folder, check=True)
        picture = Image.open(folder / arguments[arguments.index("--plot") + 1]).convert("RGB")
    size = (WIDTH, round(picture.height * WIDTH / picture.width))
    picture.resize(size, Image.Resampling.LANCZOS).save(PICTURE, quality=QUALITY, method=6)


if __name__ == "__main__":
    main()
