"""Takes the picture of `sparklod view` in docs/tutorials/web-page.md: `python -m tests.docs.browser_picture`.

SPARK_DIR names a folder whose node_modules has what `PAGE` in `tests/interop/node.py` lists.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

from PIL import Image

from sparklod_cli.cli import run
from tests.conftest import FIXTURES
from tests.interop.node import Node
from tests.interop.test_view import Served, Tab

from .gallery import DOCS, folder_of

PAGE = DOCS / "tutorials" / "web-page.md"

#: Pixels of the picture, and its WebP quality.
SIZE, QUALITY = (880, 495), 80


def main() -> None:
    """Bake the scene as the page does, and take a picture of it in Chromium."""
    chromium = shutil.which("chromium")
    assert chromium, "Chromium is not installed"
    spark = Path(os.environ["SPARK_DIR"])
    with tempfile.TemporaryDirectory() as name:
        tree, picture = Path(name) / "demo-lod.rad", Path(name) / "page.png"
        scene = str(FIXTURES / "demo.ply")
        assert run(["build-lod", scene, "--up", "-y", "--method", "quality", "-o", str(tree), "-q"]) == 0
        tab = Tab(Node("view_page.mjs", spark, chromium, scratch=Path(name)))
        with Served(spark, tree, "--look-at", "0,3.4,9:0,1.1,0", "--fov", "50", "--budget", "10k") as url:
            tab.open(url, size=SIZE)
            tab.settled()
            tab.ask("screenshot", out=str(picture))
        tab.node.close()
        folder_of(PAGE).mkdir(parents=True, exist_ok=True)
        Image.open(picture).convert("RGB").save(folder_of(PAGE) / "browser.webp", quality=QUALITY, method=6)


if __name__ == "__main__":
    main()
