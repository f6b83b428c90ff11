"""Pictures of Spark in headless Chromium, and their differences from sparklod's pictures of the same views."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.cameras.framing import framing
from sparklod_cli.codecs import layouts
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.rasterizer import draw, shade
from sparklod_cli.render.render_settings import RasterSettings
from sparklod_cli.viewers.loaded_scene import Forest, TreeInstance
from sparklod_cli.viewers.spark import SparkViewer
from sparklod_cli.viewers.viewer_settings import pixel_limit
from tests.interop.node import Node
from tests.lod.trees import CutView


@dataclass(frozen=True)
class Picture:
    """A picture of Spark.

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
    """Spark's request for a file of a scene, or for a range of its bytes that begins at `start`."""

    name: str
    bytes: int
    start: int | None


class Page:
    """One browser with Spark, which shows one file at a time."""

    def __init__(self, package_dir: Path, chromium: str, scratch: Path) -> None:
        self._out = scratch / "picture"
        self._node = Node("spark_page.mjs", package_dir, chromium, scratch=scratch)
        self.close = self._node.close

    def open(self, file: Path, camera: Camera, settings: RasterSettings, *, layout: str = "Ext", pages: int = 0) -> int:
        """Load a file, for the size of `camera` and the planes of `settings`, and count its splats or nodes.

        Args:
            layout: "Packed" or "Ext", in which Spark keeps the splats.
            pages: of 65,536 nodes, into which Spark fetches chunks of a RAD file as it needs them; 0 for all at once.
        """
        size = {"width": camera.width, "height": camera.height, "near": settings.near, "far": settings.far}
        how = {"layout": layout, "paged": pages > 0, "pages": pages}
        answer = self._node.ask({"do": "open", "path": str(file.resolve()), **size, **how})
        return int(answer["lod"] or answer["numSplats"])

    def requests(self) -> list[Request]:
        """Return Spark's requests for the file and those beside it since it was opened, in order."""
        found = self._node.ask({"do": "requests"})["requests"]
        return [Request(each["name"], each["bytes"], each["range"] and each["range"][0]) for each in found]

    def draw(self, camera: Camera, settings: RasterSettings, *, budget: int | None = None) -> Picture:
        """Draw the picture of a camera.

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


FOV_Y = math.radians(50)

#: The views: azimuth and elevation in degrees, and distance in radii of the scene.
AROUND = ((0, 15, 3.0), (60, 10, 1.6), (120, 40, 2.0), (180, -5, 1.2), (240, 70, 2.5), (300, 5, 0.7))


@dataclass(frozen=True)
class Difference:
    """The difference of sparklod's picture of a view, in 8 bits, from Spark's.

    Attributes:
        drawn: number of splats that Spark sorted.
        psnr: PSNR in dB of red, green and blue of all pixels.
        covered: PSNR in dB of the pixels where alpha is 0.1 or more.
        share: share of these pixels, 0..1.
        most: largest difference, of 255.
        unrounded: PSNR in dB from a picture that Spark does not round to 8 bits after every splat.
        held: the same of a picture that sparklod draws from splats in Spark's coding.
        held_most: largest difference of that picture, of 255.
        same_cut: whether both draw the same nodes of the tree; None without a tree.
    """

    drawn: int
    psnr: float
    covered: float
    share: float
    most: int
    unrounded: float
    held: float
    held_most: float
    same_cut: bool | None


def cameras_around(center: NDArray[np.floating], width: int, height: int) -> list[Camera]:
    """Return a camera for each view of `AROUND`, looking at the centre of a scene whose up is -y."""
    middle, radius = framing(center)
    focal = height / 2 / math.tan(FOV_Y / 2)
    cameras = []
    for around, up, away in AROUND:
        turn, lift = math.radians(around), math.radians(up)
        direction = (math.sin(turn) * math.cos(lift), -math.sin(lift), math.cos(turn) * math.cos(lift))
        pose = look_at(middle + away * radius * np.array(direction), middle, (0, -1, 0))
        cameras.append(Camera(pose, width, height, (focal, focal), (width / 2, height / 2)))
    return cameras


def cut_of(held: Scene, camera: Camera, budget: int) -> NDArray[np.uint32]:
    """Return the nodes of sparklod's cut without foveation, ascending."""
    assert held.tree is not None
    nodes = layouts.unpack_nodes(layouts.pack_nodes(held.splats, held.tree))
    view = CutView(camera.camera_to_world, camera.fov_x, camera.fov_y)
    smallest = pixel_limit(camera.fov_y, camera.height)
    return SparkViewer(Forest([nodes]), [TreeInstance()]).cut(view, budget=budget, smallest=smallest).indices()[0]


def compare(
    page: Page, file: Path, cameras: Sequence[Camera], settings: RasterSettings, budget: int = 0
) -> Iterator[Difference]:
    """Draw a file with each camera in both programs, and yield the differences.

    Args:
        budget: most nodes of the tree; 0 for a plain splat file.
    """
    scene = read_scene(file)
    count = page.open(file, cameras[0], settings)
    assert count == len(scene.splats), f"Spark has {count:,} splats of {file.name}, not {len(scene.splats):,}"
    held = Scene(layouts.unpack_ext(layouts.pack_ext(scene.splats)), scene.tree)
    for camera in cameras:
        yield _difference(page, scene.splats, held, camera, settings, budget)


def _difference(
    page: Page, splats: Splats, held: Scene, camera: Camera, settings: RasterSettings, budget: int
) -> Difference:
    theirs = page.draw(camera, settings, budget=budget or None)
    nodes = cut_of(held, camera, budget) if budget else None
    rows = slice(None) if nodes is None else nodes
    image, again = (
        np.clip(draw(shade([(some.take(rows), np.eye(4))], camera), camera, settings), 0, 1)
        for some in (splats, held.splats)
    )
    off = (np.rint(255 * image) / 255 - theirs.rounded)[..., :3]
    exact = np.clip(theirs.exact, 0, 1)
    held_off = (again - exact)[..., :3]
    covered = image[..., 3] >= 0.1
    return Difference(
        drawn=theirs.drawn,
        psnr=psnr(off),
        covered=psnr(off[covered]),
        share=float(covered.mean()),
        most=round(255 * float(np.abs(off).max())),
        unrounded=psnr((image - exact)[..., :3]),
        held=psnr(held_off),
        held_most=255 * float(np.abs(held_off).max()),
        same_cut=None if nodes is None else np.array_equal(nodes, theirs.nodes),
    )


def psnr(difference: NDArray[np.floating]) -> float:
    """Return the PSNR, in dB, of differences of numbers of 0..1."""
    square = float(np.mean(np.square(difference, dtype=np.float64))) if difference.size else 0.0
    return 10 * math.log10(1 / square) if square else math.inf
