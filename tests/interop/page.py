"""The real Spark in headless Chromium, and its pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.render.settings import RasterSettings
from tests.interop.node import Node

PROGRAM = Path(__file__).with_name("spark_page.mjs")


@dataclass(frozen=True)
class Picture:
    """What Spark drew.

    Attributes:
        rounded: (height, width, 4) float64 RGBA, 0..1, of 8 bits, to which it was rounded after every splat.
        exact: the same in float32, which was not rounded; may be above 1.
        drawn: how many splats it sorted.
        nodes: (S,) those of the tree that it drew, ascending; None if the file is no tree.
    """

    rounded: NDArray[np.float64]
    exact: NDArray[np.float32]
    drawn: int
    nodes: NDArray[np.uint32] | None


class Page:
    """One browser with Spark in it; has one file at a time.

    Args:
        package_dir: has node_modules.
        chromium: the browser's program.
        scratch: an empty folder.
    """

    def __init__(self, package_dir: Path, chromium: str, scratch: Path) -> None:
        self._out = scratch / "picture"
        self._node = Node([str(PROGRAM), str(package_dir), chromium], scratch / "stderr.txt")
        self.close = self._node.close

    def open(self, file: Path, camera: Camera, look: RasterSettings) -> int:
        """Loads a file, for pictures of this size and these planes; tells how many splats or nodes it has."""
        size = {"width": camera.width, "height": camera.height, "near": look.near, "far": look.far}
        answer = self._node.ask({"do": "open", "path": str(file.resolve()), **size})
        return int(answer["lod"] or answer["numSplats"])

    def draw(self, camera: Camera, look: RasterSettings, *, budget: int | None = None) -> Picture:
        """What a camera sees; its principal point is in the middle and its pixels are square.

        Args:
            camera: of the size that the page was opened with.
            look: its `sort` only.
            budget: the most nodes of a tree.
        """
        answer = self._node.ask(
            {
                "do": "draw",
                "viewToWorld": camera.camera_to_world.T.ravel().tolist(),
                "fovy": float(np.degrees(camera.fov_y)),
                "budget": budget,
                "radial": look.sort == "radial",
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
