"""Draw pictures of the documentation again: `python -m tests.docs.pictures browser|engines|traverse`.

- browser: `sparklod view` in docs/tutorials/web-page.md. SPARK_DIR names a folder whose node_modules has what `PAGE` in
  `tests/interop/node.py` lists.
- engines: the demo scene in the pages that the documents give, in Chromium, with an environment except in CesiumJS.
  ENGINES_DIR names a folder whose node_modules has what `ENGINES` in `tests/interop/node.py` lists.
- traverse: the chart of docs/traverse-table.md, with the instances file and the command on that page. SPARKLOD_SCENES
  names a folder with biker.spz, playbot.sog and meadow.sog.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import sparklod_cli
from sparklod_cli.cli import run
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.model.scene import Scene
from tests.conftest import FIXTURES
from tests.interop.engines import GLB, Browser, detailed, written
from tests.interop.node import Node
from tests.interop.test_view import Served, Tab
from tests.part_files import tiled

from .gallery import DOCS, folder_of

#: The demo scene has three levels with this many splats a tile.
TILES = TileSettings(tile_splats=3_000)

#: Radius of the part of the demo scene that CesiumJS shows, world units: tiles of stars would contain the camera.
WITHIN = 12.0

#: Pages of CesiumJS by their pictures, as changes.
CESIUM = {"cesium": {}, "cesium-coarse": {"maximumScreenSpaceError: 16": "maximumScreenSpaceError: 512"}}


def save(picture: Image.Image, path: Path, quality: int = 80) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.convert("RGB").save(path, quality=quality, method=6)


def chromium() -> str:
    found = shutil.which("chromium")
    assert found, "Chromium is not installed"
    return found


def browser(folder: Path) -> None:
    """Bake the scene as the tutorial does, and take a picture of it in Chromium."""
    spark, tree, picture = Path(os.environ["SPARK_DIR"]), folder / "demo-lod.rad", folder / "page.png"
    scene = str(FIXTURES / "demo.ply")
    assert run(["build-lod", scene, "--up", "-y", "--method", "quality", "-o", str(tree), "-q"]) == 0
    tab = Tab(Node("view_page.mjs", spark, chromium(), scratch=folder))
    with Served(spark, tree, "--look-at", "0,3.4,9:0,1.1,0", "--fov", "50", "--budget", "10k") as url:
        tab.open(url, size=(880, 495))
        tab.settled()
        tab.ask("screenshot", out=str(picture))
    tab.node.close()
    save(Image.open(picture), folder_of(DOCS / "tutorials" / "web-page.md") / "browser.webp")


def engines(folder: Path) -> None:
    """Draw the scene in all engines."""
    shot = written(detailed(with_sky=True), folder, (480, 270))
    pages = Browser(Path(os.environ["ENGINES_DIR"]), chromium(), folder)
    shown = {"playcanvas": pages.playcanvas(shot.file, shot.camera, {})}
    shown["babylon"] = pages.babylon(shot.file, shot.camera, None)
    splats = read_scene(FIXTURES / "demo.ply").splats
    inner = splats.take(np.linalg.norm(splats.center, axis=1) < WITHIN)
    sparklod_cli.write(folder / GLB, Scene(inner, up="-y"))
    shown["playcanvas-glb"] = pages.playcanvas_glb(folder / GLB, shot.camera)
    tileset = tiled(inner, folder, TILES)
    shown |= {name: pages.cesium(tileset, shot.camera, changes) for name, changes in CESIUM.items()}
    pages.close()
    for name, each in shown.items():
        picture = Image.fromarray(np.round(255 * each.rgba[..., :3]).astype(np.uint8))
        save(picture, DOCS / "images" / "engines" / f"{name}.webp")


def traverse(folder: Path) -> None:
    """Bake trees with the quality builder, draw the chart of the page, and make it 1,100 pixels wide."""
    plot = (DOCS / "traverse-table.md").read_text(encoding="utf-8").partition("\n## Plot\n")[2]
    (command,) = re.findall(r"```sh\nsparklod (.*)\n```", plot)
    (instances,) = re.findall(r"```json\n(.*?)```", plot, re.DOTALL)
    (folder / "city.json").write_text(instances, encoding="utf-8")
    scenes, arguments = Path(os.environ["SPARKLOD_SCENES"]).resolve(), shlex.split(command)
    names = (str(scenes / scene) for scene in ("biker.spz", "playbot.sog", "meadow.sog"))
    for each in (["build-lod", *names, "--method", "quality", "--output-dir", "."], arguments):
        subprocess.run([sys.executable, "-m", "sparklod_cli", *each], cwd=folder, check=True)
    picture = Image.open(folder / arguments[arguments.index("--plot") + 1]).convert("RGB")
    picture = picture.resize((1100, round(picture.height * 1100 / picture.width)), Image.Resampling.LANCZOS)
    save(picture, DOCS / "images" / "traverse.webp", quality=85)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        {"browser": browser, "engines": engines, "traverse": traverse}[sys.argv[1]](Path(name))
