"""Draws the pictures of engines in the documentation anew: `python -m tests.docs.engine_pictures`.

ENGINES_DIR names a folder whose node_modules has what `ENGINES` in `tests/interop/node.py` lists. Chromium shows the
demo scene in the pages that the documents give, with an environment but in CesiumJS.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import sparklod_cli
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.model.scene import Scene
from tests.conftest import FIXTURES, ROOT
from tests.interop.engines import GLB, Browser, Shown, detailed, written
from tests.part_files import tiled

FOLDER = ROOT / "docs" / "images" / "engines"

#: Pixels of a picture, and its WebP quality.
SIZE, QUALITY = (480, 270), 80


#: The demo scene takes this many splats a tile where it is to have three levels.
TILES = TileSettings(tile_splats=3_000)

#: World units from the middle of the demo scene within which CesiumJS shows it: beyond are stars, whose tiles would
#: have the camera inside.
WITHIN = 12.0

#: The pages of CesiumJS by their pictures, as changes.
CESIUM = {"cesium": {}, "cesium-coarse": {"maximumScreenSpaceError: 16": "maximumScreenSpaceError: 512"}}


def main() -> None:
    """Draw the scene in all engines."""
    chromium = shutil.which("chromium")
    assert chromium, "Chromium is not installed"
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        shot = written(detailed(with_sky=True), Path(name), SIZE)
        browser = Browser(Path(os.environ["ENGINES_DIR"]), chromium, Path(name))
        for engine, settings in (("playcanvas", {}), ("babylon", None)):
            _save(engine, getattr(browser, engine)(shot.file, shot.camera, settings))
        splats = read_scene(FIXTURES / "demo.ply").splats
        inner = splats.take(np.linalg.norm(splats.center, axis=1) < WITHIN)
        glb = Path(name) / GLB
        sparklod_cli.write(glb, Scene(inner, up="-y"))
        _save("playcanvas-glb", browser.playcanvas_glb(glb, shot.camera))
        tileset = tiled(inner, Path(name), TILES)
        for picture, changes in CESIUM.items():
            _save(picture, browser.cesium(tileset, shot.camera, changes))
        browser.close()


def _save(name: str, shown: Shown) -> None:
    picture = Image.fromarray(np.round(255 * shown.rgba[..., :3]).astype(np.uint8))
    picture.save(FOLDER / f"{name}.webp", quality=QUALITY, method=6)


if __name__ == "__main__":
    main()
