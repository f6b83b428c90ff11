"""How bright PlayCanvas and Babylon.js draw each detail level beside level 0: a table of docs/engines-measured.md.

`ENGINES_DIR=folder python -m benchmarks.bench_level_brightness scene.ply`; the folder's node_modules has the engines.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

import sparklod_cli as sparklod
from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cameras.framing import framing
from sparklod_cli.lod import parts, quality
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.model.scene import Scene
from tests.interop.engines import Browser, Shown
from tests.interop.pictures import cameras_around

#: Shares of the levels below level 0, and distances as multiples of the second view of `cameras_around`.
LEVELS, DISTANCES = (0.25, 0.06), (1, 3, 9)
SIZE = 640, 360

#: How the engines are set: PlayCanvas's settings, or what is replaced in the page of Babylon.js. All splats are drawn.
OFF = {"antiAlias": False, "minPixelSize": 0}
ON = {"antiAlias": True, "minPixelSize": 0}
BABYLON_OFF = {"Compensation = true": "Compensation = false"}


def levels_of(path: Path, folder: Path) -> tuple[list[Path], Camera]:
    """Write each detail level of a scene as a SOG, and return the files with a camera that sees the scene."""
    splats = sparklod.read(path).splats.with_max_sh(0)
    scene = parts.make_levels(*quality.build(splats, 2.0), DetailSettings(LEVELS))
    files = [folder / f"{path.stem}-{level}.sog" for level in range(scene.levels)]
    for level, file in enumerate(files):
        sparklod.write(file, Scene(scene.splats.take(scene.level(level))))
    return files, cameras_around(scene.splats.center[scene.level(0)], *SIZE)[1]


def farther(camera: Camera, middle: np.ndarray, times: float) -> Camera:
    """Return the camera moved away from a point."""
    pose = camera.camera_to_world.copy()
    pose[:3, 3] = middle + times * (pose[:3, 3] - middle)
    return dataclasses.replace(camera, camera_to_world=pose)


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", type=Path, nargs="+", help="splat files without a tree")
    arguments = parser.parse_args()
    chromium = shutil.which("chromium")
    if chromium is None or "ENGINES_DIR" not in os.environ:
        raise SystemExit("needs Chromium, and ENGINES_DIR: a folder whose node_modules has the engines")
    print("| scene | distance | PlayCanvas as it is | with `antiAlias` | Babylon.js as it is |\n" + "| --- " * 5 + "|")
    with tempfile.TemporaryDirectory() as name:
        browser = Browser(Path(os.environ["ENGINES_DIR"]), chromium, Path(name))
        engines: list[Callable[[Path, Camera], Shown]] = [
            lambda file, camera: browser.playcanvas(file, camera, OFF),
            lambda file, camera: browser.playcanvas(file, camera, ON),
            lambda file, camera: browser.babylon(file, camera, BABYLON_OFF),
        ]
        for path in arguments.files:
            files, camera = levels_of(path, Path(name))
            middle, _ = framing(sparklod.read(files[0]).splats.center)
            for times in DISTANCES:
                cells = [path.stem, str(times)]
                for draw in engines:
                    means = [draw(file, farther(camera, middle, times)).rgba[..., :3].mean() for file in files]
                    cells.append(", ".join(f"{mean / means[0]:.3f}" for mean in means[1:]))
                print("| " + " | ".join(cells) + " |", flush=True)
        browser.close()


if __name__ == "__main__":
    main()
