"""Loads SOG in PlayCanvas and Babylon.js, 3D Tiles in CesiumJS: `python -m benchmarks.bench_engines --help`.

Run it from the repository's root: it imports the tests' program that drives the browser. The engines draw on the
processor here, so seconds compare files, and say little about what a visitor waits for.
"""

from __future__ import annotations

import argparse
import itertools
import os
import re
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from sparklod_cli.codecs.formats import TILESET
from sparklod_cli.codecs.tileset import to_tileset
from sparklod_cli.io.reading import read_scene
from tests.interop.engines import Browser, Shown, like_cesium, likeness, our_picture
from tests.interop.pictures import cameras_around

HEADINGS = ("scene", "engine", "first frame", "last frame", "levels asked for", "files", "MB", "PSNR", "seconds")

#: For Babylon.js: level 0 reaches as far as the scene.
FARTHER = {"lodBaseDistance: 20": "lodBaseDistance: 1000"}


#: How the requests that tell a level begin: for a tile, or the first image of a chunk.
LEVEL = re.compile(r"(?:tiles/(\d+)-\d+\.glb|(\d+)_\d+/means_l\.webp)$")


def levels_of(shown: Shown) -> str:
    """The levels of the chunks or tiles that were asked for, in order, and how many of each follow: "2 x1, 0 x4"."""
    names = [found[1] or found[2] for each in shown.requests if (found := LEVEL.match(each.name))]
    levels = itertools.groupby(names)
    return ", ".join(f"{level} x{len(list(files))}" for level, files in levels)


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", type=Path, nargs="+", help="lod-meta.json, tileset.json and .sog files")
    parser.add_argument("--size", default="320x180", help="width and height in pixels")
    parser.add_argument("--view", type=int, default=1, help="number of the view, 0 to 5")
    arguments = parser.parse_args()
    chromium = shutil.which("chromium")
    if chromium is None or "ENGINES_DIR" not in os.environ:
        raise SystemExit("needs Chromium, and ENGINES_DIR: a folder whose node_modules has the engines")
    print("| " + " | ".join(HEADINGS) + " |")
    print("|---" * len(HEADINGS) + "|")
    with tempfile.TemporaryDirectory() as folder:
        browser = Browser(Path(os.environ["ENGINES_DIR"]), chromium, Path(folder))
        for file in arguments.files:
            scene = read_scene(file)
            camera = cameras_around(scene.splats.center, *map(int, arguments.size.split("x")))[arguments.view]
            tiled = file.name == TILESET
            ours = (like_cesium if tiled else our_picture)(scene.splats, camera)
            for engine in ("CesiumJS",) if tiled else ("PlayCanvas", "Babylon.js"):
                start = time.perf_counter()
                if engine == "CesiumJS":
                    to_tiles = np.eye(4)
                    to_tiles[:3, :3] = to_tileset(scene.up)
                    shown = browser.cesium(file, camera, to_tiles=to_tiles)
                elif engine == "PlayCanvas":
                    shown = browser.playcanvas(file, camera)
                else:
                    shown = browser.babylon(file, camera, FARTHER if file.suffix == ".json" else {})
                seconds = time.perf_counter() - start
                cells = [
                    f"{file.parent.name}/{file.name}",
                    engine,
                    f"{shown.frames[0]:,}",
                    f"{shown.frames[-1]:,}",
                    levels_of(shown),
                    f"{len(shown.requests)}",
                    f"{sum(each.bytes for each in shown.requests) / 1e6:.1f}",
                    f"{likeness(shown.rgba, ours):.1f} dB",
                    f"{seconds:.1f}",
                ]
                print("| " + " | ".join(cells) + " |", flush=True)
        browser.close()


if __name__ == "__main__":
    main()
