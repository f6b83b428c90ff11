"""Engines in headless Chromium: the pages of the documentation, their pictures, and sparklod's likeness of them.

PlayCanvas, SuperSplat's viewer and Babylon.js show SOG, CesiumJS 3D Tiles, Spark trees.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import json
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fixtures import demo_scene
from sparklod_cli.cameras.camera import Camera
from sparklod_cli.codecs import streamed_sog
from sparklod_cli.codecs.formats import WriteOptions
from sparklod_cli.io.reading import read_scene
from sparklod_cli.io.writing import parts_output
from sparklod_cli.lod import parts, quality
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.model.gaussian import rotation_matrices
from sparklod_cli.model.instances import DetailScene
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.rasterizer import ShadedSplats, draw, shade, world_to_camera
from sparklod_cli.render.render_settings import RasterSettings
from tests.conftest import FIXTURES, ROOT
from tests.interop.node import Node
from tests.interop.pictures import cameras_around, psnr
from tests.scenes import write_files

# --- Pages of the documentation ---------------------------------------------------------------------------------------

#: Headings of the engines' sections.
PLAYCANVAS, SUPERSPLAT, BABYLON = "PlayCanvas", "SuperSplat's viewer", "Babylon.js"
#: Headings in docs/cesium.md: of its page.
CESIUM = "A page"
#: Headings in docs/spark.md: of its page, and of the lines that change where a tree is streamed.
SPARK, STREAMED = "A page", "Streamed"
#: Names of the scene in the pages.
MANIFEST, SOG, GLB, TREE, RAD = "lod-meta.json", "scene.sog", "scene.glb", "scene-lod.spz", "scene-lod.rad"


@functools.cache
def blocks(heading: str, language: str, document: str = "playcanvas.md") -> tuple[str, ...]:
    """The blocks of code of a language in a section of a document."""
    text = (ROOT / "docs" / document).read_text(encoding="utf-8")
    (section,) = re.findall(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", text, re.DOTALL | re.MULTILINE)
    return tuple(re.findall(rf"^```{language}\n(.*?)^```", section, re.DOTALL | re.MULTILINE))


def page(heading: str, name: str = MANIFEST) -> str:
    """The page of a section, for a scene of another name."""
    (html,) = blocks(heading, "html")
    return replaced(html, {MANIFEST: name})


def playcanvas_of_glb(name: str = GLB) -> str:
    """The page of PlayCanvas, in which the lines for a GLB take the place of those of a Streamed SOG."""
    html = page(PLAYCANVAS)
    (lines,) = blocks(PLAYCANVAS, "js", "gltf.md")
    start, end = html.index("  const asset ="), html.index("  const camera =")
    return replaced(html[:start] + lines + "\n" + html[end:], {GLB: name})


def babylon_of_one_file(name: str = SOG) -> str:
    """The page of Babylon.js, in which the lines for a plain SOG take the place of those that stream."""
    html = page(BABYLON)
    (lines,) = blocks(BABYLON, "js")
    return replaced(html[: html.index("  const metadata")] + lines + "</script>", {SOG: name})


def spark(*, streamed: bool) -> str:
    """The page of Spark, for a tree that is loaded as a whole or streamed."""
    (html,) = blocks(SPARK, "html", "spark.md")
    if not streamed:
        return html
    (lines,) = blocks(STREAMED, "js", "spark.md")
    first = next(line for line in html.splitlines() if "new SparkRenderer(" in line)
    second = next(line for line in html.splitlines() if "new SplatMesh(" in line)
    return replaced(html, {f"{first}\n{second}\n": lines})


def cesium() -> str:
    """The page of docs/cesium.md, which shows tileset.json."""
    (html,) = blocks(CESIUM, "html", "cesium.md")
    return html


def replaced(html: str, changes: Mapping[str, str]) -> str:
    """A page with some of its text replaced, all of which it must have."""
    for old, new in changes.items():
        assert old in html, f"the page has no {old}"
        html = html.replace(old, new)
    return html


# --- Pictures of the pages --------------------------------------------------------------------------------------------

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
    """A page's request for a file, by its path from the scene's folder, and the time since the first request."""

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
    """One browser, which shows one page at a time."""

    def __init__(self, package_dir: Path, chromium: str, scratch: Path) -> None:
        self._out = scratch / "picture"
        self._node = Node("pages.mjs", package_dir, chromium, scratch=scratch)
        self.close = self._node.close

    def playcanvas(self, file: Path, camera: Camera, settings: Mapping[str, Any] = ALIKE) -> Shown:
        """What PlayCanvas's engine shows; `settings` are those of `app.scene.gsplat`."""
        pose = (TURN @ camera.camera_to_world).T.ravel().tolist()
        view = {"viewToWorld": pose, "fovy": math.degrees(camera.fov_y), "near": NEAR, "far": FAR}
        html = page(PLAYCANVAS, file.name)
        return self._show(html, "playcanvas.js", file, camera, view | {"settings": dict(settings)})

    def playcanvas_glb(self, file: Path, camera: Camera) -> Shown:
        """What PlayCanvas's engine shows of a GLB whose root node turns -y up."""
        pose = (FLIP @ camera.camera_to_world).T.ravel().tolist()
        view = {"viewToWorld": pose, "fovy": math.degrees(camera.fov_y), "near": NEAR, "far": FAR}
        html = playcanvas_of_glb(file.name)
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
        html = replaced(page(SUPERSPLAT, file.name), changes)
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
        html = page(BABYLON) if file.name == MANIFEST else babylon_of_one_file(file.name)
        return self._show(replaced(html, changes or {}), "babylon.js", file, camera, view)

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
        return self._show(replaced(cesium(), changes or {}), "cesium.js", file, camera, view)

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


# --- The scene that they show -----------------------------------------------------------------------------------------

SIZE = 320, 180


@dataclass(frozen=True)
class Shot:
    """A scene as Streamed SOG and how it is looked at.

    Attributes:
        file: lod-meta.json of three levels in several chunks and regions.
        splats: of level 0 and the environment.
        camera: sees all of them from the side, upright where -y of the file is up.
    """

    file: Path
    splats: Splats
    camera: Camera


def counts_of(file: Path) -> list[int]:
    """The splats of each detail level, as lod-meta.json says."""
    counts: list[int] = json.loads(file.read_text(encoding="utf-8"))["counts"]
    return counts


#: How the demo scene is divided into levels, regions and chunks.
DIVISION = 8_000, 4.0, 2_000
DETAIL = DetailSettings((0.25, 0.05), *DIVISION)


@functools.cache
def detailed(*, with_sky: bool = False) -> DetailScene:
    """Return the demo scene at several detail levels, with the up axis noted, and its far sky as environment."""
    scene = parts.make_levels(*quality.build(read_scene(FIXTURES / "demo.ply").splats, 2.0), DETAIL)
    return dataclasses.replace(scene, up="-y", environment=sky() if with_sky else None)


def sky() -> Splats:
    """Return the far sky of the demo scene."""
    made = demo_scene.sky()
    quat_xyzw = made["quat_wxyz"][:, [1, 2, 3, 0]]
    no_sh = np.empty((len(quat_xyzw), 0, 3))
    columns = made["center"], np.exp(made["log_scale"]), quat_xyzw, made["opacity"], made["rgb"], no_sh
    return Splats(*(np.array(column, np.float32, order="C") for column in columns))


def written(scene: DetailScene, folder: Path, size: tuple[int, int] = SIZE) -> Shot:
    """Write a scene as Streamed SOG, and return it with a camera that sees the demo scene."""
    file = folder / MANIFEST
    write_files(parts_output(file, overwrite=False), streamed_sog.encode_files(scene, WriteOptions(), *DIVISION))
    level = slice(0, int(scene.counts[:, 0].sum()))
    return Shot(file, read_scene(file).splats, cameras_around(scene.splats.center[level], *size)[1])


# --- Likeness of sparklod's pictures ----------------------------------------------------------------------------------

#: The blur of PlayCanvas's engine and of Babylon.js, pixels squared: they add 0.3 to the covariance in half pixels.
BLUR = 0.3 / 4

#: That of CesiumJS: it adds 0.3 to four times the covariance in half pixels.
CESIUM_BLUR = 0.3 / 16

#: CesiumJS leaves out splats whose larger variance on the screen, after the blur, is below this, pixels squared.
CESIUM_LEAST = 2 / 16

#: ... and those whose centre is beyond this multiple of the picture's half width and height.
CESIUM_CLIP = 1.2


@contextmanager
def their_blur(**settings: float) -> Iterator[None]:
    """Has our renderer draw with the engines' blur, or other values of what is no setting of it."""
    with mock.patch.multiple(importlib.import_module(draw.__module__), **({"BLUR": BLUR} | settings)):
        yield


def our_picture(splats: Splats, camera: Camera) -> NDArray[np.float32]:
    """Our picture of splats, with the engines' blur: (height, width, 4), 0..1."""
    with their_blur():
        shaded = shade([(splats, np.eye(4))], camera)
        return np.clip(draw(shaded, camera, RasterSettings(near=NEAR, far=FAR)), 0, 1)


def like_cesium(splats: Splats, camera: Camera) -> NDArray[np.float32]:
    """Our picture of splats, drawn as CesiumJS's shaders do: (height, width, 4), 0..1.

    Splats are sorted by depth, opacity does not make up for the blur, small splats are left out, and colours are
    clamped before reflections are added to them.
    """
    shaded = shade([(dataclasses.replace(splats, rgb=np.clip(splats.rgb, 0, 1)), np.eye(4))], camera)
    on_screen = _variances(shaded, camera)
    blurred = on_screen + CESIUM_BLUR * np.eye(2)
    # What the renderer divides opacity by.
    opacity = shaded.lod_opacity * np.sqrt(np.linalg.det(blurred) / np.maximum(np.linalg.det(on_screen), 1e-12))
    seen = np.linalg.eigvalsh(blurred)[:, 1] >= CESIUM_LEAST
    columns = {each.name: getattr(shaded, each.name)[seen] for each in dataclasses.fields(shaded)}
    columns["lod_opacity"] = opacity[seen].astype(np.float32)
    with their_blur(BLUR=CESIUM_BLUR, CLIP=CESIUM_CLIP):
        settings = RasterSettings(near=NEAR, far=FAR, sort="z")
        return np.clip(draw(ShadedSplats(**columns), camera, settings), 0, 1)


def _variances(shaded: ShadedSplats, camera: Camera) -> NDArray[np.float64]:
    """Covariances of splats on the screen before the blur, (N, 2, 2), pixels squared."""
    matrix = world_to_camera(camera).astype(np.float64)
    x, y, z = (shaded.center @ matrix[:, :3].T + matrix[:, 3]).T
    zero = np.zeros_like(z)
    across = np.stack([1 / z, zero, -x / z**2], axis=-1) * camera.focal[0]
    down = np.stack([zero, 1 / z, -y / z**2], axis=-1) * camera.focal[1]
    axes = np.moveaxis(rotation_matrices(shaded.quat_xyzw.astype(np.float64)), -1, 0) * shaded.scale[:, None]
    drawn: NDArray[np.float64] = np.stack([across, down], axis=1) @ matrix[:, :3] @ axes
    return drawn @ drawn.transpose(0, 2, 1)


def likeness(theirs: NDArray[np.float64], ours: NDArray[np.float32]) -> float:
    """PSNR in dB of red, green and blue of all pixels."""
    return psnr((theirs - ours)[..., :3])
