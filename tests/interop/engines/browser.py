"""Shows scenes in the pages of docs/playcanvas.md and docs/spark.md, in headless Chromium."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sparklod_cli.cameras.camera import Camera
from tests.interop.engines import recipes
from tests.interop.node import Node

HERE = Path(__file__).parent

#: From the axes of PLY files, y down, to those of the pages of PlayCanvas, y up: half a turn about z.
TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
#: To those of glTF: half a turn about x.
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
#: To those of 3D Tiles, z up: a quarter turn about x from those of glTF.
TO_TILES = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]) @ FLIP
#: To those of Babylon.js, whose axes are left-handed with y up.
MIRROR = np.diag([1.0, -1.0, 1.0])
#: Planes between which splats are drawn, world units.
NEAR, FAR = 0.01, 1000.0

#: What makes PlayCanvas draw nearly as our renderer: opacity makes up for the blur, splats are sorted by distance,
#: small ones are drawn, and so is what adds half a step of 8 bits, and colours and rotations have enough bits.
ALIKE = {
    "antiAlias": True,
    "radialSorting": True,
    "minPixelSize": 0,
    "alphaClipForward": 0.5 / 255,
    "dataFormat": "large",
}


@dataclass(frozen=True)
class Request:
    """A file that a page asked for.

    Attributes:
        name: its path from the scene's folder.
        bytes: its size.
        milliseconds: since the first request.
    """

    name: str
    bytes: int
    milliseconds: float


@dataclass(frozen=True)
class Shown:
    """What a page showed.

    Attributes:
        rgba: (height, width, 4) float64, 0..1, when all was loaded.
        frames: the number of splats in the first frame that drew any, and in each that drew another number.
        requests: for files of the scene, in order.
        tiles: of 3D Tiles, names of those that the picture shows, in order.
    """

    rgba: NDArray[np.float64]
    frames: list[int]
    requests: list[Request]
    tiles: list[str]


class Browser:
    """One browser, which shows one page at a time.

    Args:
        package_dir: the folder with node_modules.
        chromium: path of the browser.
        scratch: an empty folder for files.
    """

    def __init__(self, package_dir: Path, chromium: str, scratch: Path) -> None:
        self._out = scratch / "picture"
        self._node = Node([str(HERE / "pages.mjs"), str(package_dir), chromium], scratch / "stderr.txt")
        self.close = self._node.close

    def playcanvas(self, file: Path, camera: Camera, settings: Mapping[str, Any] = ALIKE) -> Shown:
        """What PlayCanvas's engine shows; `settings` are those of `app.scene.gsplat`."""
        pose = (TURN @ camera.camera_to_world).T.ravel().tolist()
        view = {"viewToWorld": pose, "fovy": math.degrees(camera.fov_y), "near": NEAR, "far": FAR}
        html = recipes.page(recipes.PLAYCANVAS, file.name)
        return self._show(html, "playcanvas.js", file, camera, view | {"settings": dict(settings)})

    def playcanvas_glb(self, file: Path, camera: Camera) -> Shown:
        """What PlayCanvas's engine shows of a GLB whose root node turns -y up."""
        pose = (FLIP @ camera.camera_to_world).T.ravel().tolist()
        view = {"viewToWorld": pose, "fovy": math.degrees(camera.fov_y), "near": NEAR, "far": FAR}
        html = recipes.playcanvas_of_glb(file.name)
        return self._show(html, "playcanvas.js", file, camera, view | {"settings": dict(ALIKE)})

    def supersplat(self, file: Path, camera: Camera) -> Shown:
        """What SuperSplat's viewer shows; its field of view is that of the picture's longer side."""
        turn = TURN[:3, :3]
        pose = {
            "position": (turn @ camera.position).tolist(),
            "target": (turn @ (camera.position + camera.forward)).tolist(),
            "fov": math.degrees(max(camera.fov_x, camera.fov_y)),
        }
        changes = {"{ position: [0, 1, 4], target: [0, 1, 0], fov: 60 }": json.dumps(pose)}
        html = recipes.replaced(recipes.page(recipes.SUPERSPLAT, file.name), changes)
        return self._show(html, "playcanvas.js", file, camera, {})

    def babylon(self, file: Path, camera: Camera, changes: Mapping[str, str] | None = None) -> Shown:
        """What Babylon.js shows; `changes` replace text of its page."""
        view = {
            "position": (MIRROR @ camera.position).tolist(),
            "ahead": (MIRROR @ camera.forward).tolist(),
            "up": (MIRROR @ camera.camera_to_world[:3, 1]).tolist(),
            "fovy": camera.fov_y,
            "near": NEAR,
            "far": FAR,
        }
        if file.name == recipes.MANIFEST:
            html = recipes.page(recipes.BABYLON)
        else:
            html = recipes.babylon_of_one_file(file.name)
        return self._show(recipes.replaced(html, changes or {}), "babylon.js", file, camera, view)

    def cesium(
        self,
        file: Path,
        camera: Camera,
        changes: Mapping[str, str] | None = None,
        to_tiles: NDArray[np.float64] = TO_TILES,
    ) -> Shown:
        """What CesiumJS shows of a tileset.

        Args:
            changes: replace text of its page.
            to_tiles: (4, 4) from the axes of the splats to those of the tileset.
        """
        pose = to_tiles @ camera.camera_to_world
        view = {
            "position": pose[:3, 3].tolist(),
            "right": pose[:3, 0].tolist(),
            "up": pose[:3, 1].tolist(),
            "ahead": (-pose[:3, 2]).tolist(),
            "fov": max(camera.fov_x, camera.fov_y),
            "near": NEAR,
            "far": FAR,
        }
        return self._show(recipes.replaced(recipes.cesium(), changes or {}), "cesium.js", file, camera, view)

    def still(self, html: str, folder: Path, size: tuple[int, int]) -> NDArray[np.float64]:
        """(height, width, 3) what a page shows by itself of the files of a folder, 0..1."""
        width, height = size
        self._node.ask({"do": "open", "html": html, "folder": str(folder), "width": width, "height": height})
        self._node.ask({"do": "still", "out": f"{self._out}.png"})
        with Image.open(f"{self._out}.png") as image:
            return np.asarray(image.convert("RGB"), np.float64) / 255

    def _show(self, html: str, driver: str, file: Path, camera: Camera, view: dict[str, Any]) -> Shown:
        size = {"width": camera.width, "height": camera.height}
        self._node.ask({"do": "open", "html": html, "driver": driver, "folder": str(file.parent), **size})
        answer = self._node.ask({"do": "draw", "camera": view, "out": str(self._out)})
        requests = self._node.ask({"do": "requests"})["requests"]
        rgba = np.fromfile(self._out, "u1").reshape(camera.height, camera.width, 4)[::-1] / 255
        tiles = sorted(answer.get("tiles", ()))
        return Shown(rgba, answer["frames"], [Request(**each) for each in requests], tiles)
