"""Draws the pictures of docs/playcanvas.md anew: `ENGINES_DIR=folder python -m tests.docs.engine_pictures`.

Chromium shows the demo scene with an environment in the pages that the document gives; the folder's node_modules has
what `tests/interop/engines/__init__.py` lists.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from tests.conftest import ROOT
from tests.interop.engines.browser import Browser
from tests.interop.engines.conftest import detailed, sky, written

FOLDER = ROOT / "docs" / "images" / "engines"

#: Pixels of a picture, and its WebP quality.
SIZE, QUALITY = (480, 270), 80


def main() -> None:
    """Draw the scene in both engines."""
    chromium = shutil.which("chromium")
    assert chromium, "Chromium is not installed"
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        shot = written(dataclasses.replace(detailed(), environment=sky()), Path(name), SIZE)
        browser = Browser(Path(os.environ["ENGINES_DIR"]), chromium, Path(name))
        for engine, settings in (("playcanvas", {}), ("babylon", None)):
            rgba = getattr(browser, engine)(shot.file, shot.camera, settings).rgba
            picture = Image.fromarray(np.round(255 * rgba[..., :3]).astype(np.uint8))
            picture.save(FOLDER / f"{engine}.webp", quality=QUALITY, method=6)
        browser.close()


if __name__ == "__main__":
    main()
