"""Loads SOG and Streamed SOG in PlayCanvas and Babylon.js: `python -m benchmarks.bench_engines --help`.

Run it from the repository's root: it imports the tests' program that drives the browser. The engines draw on the
processor here, so seconds compare files, and say little about what a visitor waits for.
"""

from __future__ import annotations

import argparse
import itertools
import os
import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from sparklod_cli.io import read_scene
from sparklod_cli.support import jit
from sparklod_cli.support.parallel import processors
from tests.interop.engines.browser import Browser, Shown
from tests.interop.engines.likeness import likeness, our_picture
from tests.interop.pictures import cameras_around

HEADINGS = ("scene", "engine", "first frame", "last frame", "levels asked for", "files", "MB", "PSNR", "seconds")

#: For Babylon.js: level 0 reaches as far as the scene.
FARTHER = {"lodBaseDistance: 20": "lodBaseDistance: 1000"}


def levels_of(shown: Shown) -> str:
    """The levels of the chunks whose images were asked for, in order, and how many of each follow: "2 x1, 0 x4"."""
    names = [each.name for each in shown.requests if each.name.endswith("/means_l.webp") and each.name[0].isdigit()]
    levels = itertools.groupby(name.split("_")[0] for name in names)
    return ", ".join(f"{level} x{len(list(files))}" for level, files in levels)


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", type=Path, nargs="+", help="lod-meta.json of Streamed SOG, and .sog files")
    parser.add_argument("--size", default="320x180", help="width and height in pixels")
    parser.add_argument("--view", type=int, default=1, help="number of the view, 0 to 5")
    arguments = parser.parse_args()
    chromium = shutil.which("chromium")
    if chromium is None or "ENGINES_DIR" not in os.environ:
        raise SystemExit("needs Chromium, and ENGINES_DIR: a folder whose node_modules has the engines")
    jit.use_threads(processors())
    print("| " + " | ".join(HEADINGS) + " |")
    print("|---" * len(HEADINGS) + "|")
    with tempfile.TemporaryDirectory() as folder:
        browser = Browser(Path(os.environ["ENGINES_DIR"]), chromium, Path(folder))
        for file in arguments.files:
            splats = read_scene(file).splats
            camera = cameras_around(splats.center, *map(int, arguments.size.split("x")))[arguments.view]
            ours = our_picture(splats, camera)
            changes: Mapping[str, str] = FARTHER if file.suffix == ".json" else {}
            for engine in ("PlayCanvas", "Babylon.js"):
                start = time.perf_counter()
                if engine == "PlayCanvas":
                    shown = browser.playcanvas(file, camera)
                else:
                    shown = browser.babylon(file, camera, changes)
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
