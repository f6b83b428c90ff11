"""Draws pictures with the real Spark in headless Chromium."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.render.render_settings import RasterSettings
from tests.interop.node import Node

PROGRAM = Path(__file__).with_name("spark_page.mjs")


@dataclass(frozen=True)
class Picture:
    """A picture that Spark drew.

    Attributes:
        rounded: (height, width, 4) float64 RGBA, 0..1, of a canvas of 8 bits, which rounds after every splat.
        exact: the same of a float32 canvas, without rounding; may be above 1.
        drawn: number of splats that Spark sorted.
        nodes: (S,) nodes of the tree that Spark drew, ascending; None if the file has no tree.
    """

    rounded: NDArray[np.float64]
    exact: NDArray[np.float32]
    drawn: int
    nodes: NDArray[np.uint32] | None


@dataclass(frozen=True)
class Request:
    """A request of Spark's for a file of a scene.

    Attributes:
        name: of the file.
        bytes: that were sent.
        start: of the range of bytes that it asked for; None for the whole file.
    """

    name: str
    bytes: int
    start: int | None


class Page:
    """One browser with Spark, which shows one file at a time.

    Args:
        package_dir: the folder with node_modules.
        chromium: path of the browser.
        scratch: an empty folder for files.
    """

    def __init__(self, package_dir: Path, chromium: str, scratch: Path) -> None:
        self._out = scratch / "picture"
        self._node = Node([str(PROGRAM), str(package_dir), chromium], scratch / "stderr.txt")
        self.close = self._node.close

    def open(self, file: Path, camera: Camera, settings: RasterSettings, *, layout: str = "Ext", pages: int = 0) -> int:
        """Loads a file, for the size of `camera` and the planes of `settings`; returns its splats or nodes.

        Args:
            layout: "Packed" or "Ext", in which Spark keeps the splats.
            pages: of 65,536 nodes, into which Spark fetches chunks of a RAD file as it needs them; 0 for all at once.
        """
        size = {"width": camera.width, "height": camera.height, "near": settings.near, "far": settings.far}
        how = {"layout": layout, "paged": pages > 0, "pages": pages}
        answer = self._node.ask({"do": "open", "path": str(file.resolve()), **size, **how})
        return int(answer["lod"] or answer["numSplats"])

    def requests(self) -> list[Request]:
        """Returns what Spark asked for of the file and those beside it since it was opened, in order."""
        found = self._node.ask({"do": "requests"})["requests"]
        return [Request(each["name"], each["bytes"], each["range"] and each["range"][0]) for each in found]

    def draw(self, camera: Camera, settings: RasterSettings, *, budget: int | None = None) -> Picture:
        """Draws the picture of a camera.

        Args:
            camera: has the size that the page was opened with, a centred principal point and square pixels.
            settings: only its `sort` is used.
            budget: number of nodes of a tree at most.
        """
        answer = self._node.ask(
            {
                "do": "draw",
                "viewToWorld": camera.camera_to_world.T.ravel().tolist(),
                "fovy": float(np.degrees(camera.fov_y)),
                "budget": budget,
                "radial": settings.sort == "radial",
                "out": str(self._out),
            }
        )
        files, shape = answer["files"], (camera.height, camera.width, 4)
        return Picture(
            rounded=np.fromfile(files["rounded"], "u1").reshape(shape)[::-1] / 255,
            exact=np.fromfile(files["exact"], "<f4").reshape(shape)[::-1],
            drawn=answer["drawn"],
            nodes=np.sort(np.fromfile(files["indices"], "<u4")) if "indices" in files else None,
        )
