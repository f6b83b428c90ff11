"""Pictures of splats, points and lines by pyvista, with title, scale and axes. The only module that imports pyvista."""

from __future__ import annotations

import functools
import io
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from types import ModuleType, TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from ..images.pixels import FAINT, INK, LINE, font, write_scale, write_title
from ..model.splats import FloatArray, Splats
from ..render.color_scales import Coloring, ticks
from ..system.errors import SparklodError
from ..system.optional import optional_import
from ..system.python_process import program_command
from .geometry import Points, Viewpoint, ellipsoids, rotation, sphere

#: Smallest distance between the labels of an axis, in thousandths of the picture's height.
LABEL_DISTANCE = 62


def write_png(
    pixels: NDArray[np.uint8],
    title: str,
    lines: Sequence[str],
    coloring: Coloring,
    eye: Viewpoint,
    low: Points,
    high: Points,
) -> bytes:
    """Return the PNG of a picture with title, colour scale and axes.

    Args:
        pixels: (H, W, 3) of the scene.
        title, lines: texts for the upper left corner, which must fit into the width.
        low, high: (3,) corners of the box along whose edges the axes run, world units.
    """
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image)
    unit = min(image.height / 1000, image.width / 1600)
    write_title(draw, unit, title, [(line, FAINT) for line in lines])
    write_scale(image, draw, unit, coloring)
    _axes(draw, unit, image.size, eye, low, high)
    out = io.BytesIO()
    image.save(out, "PNG", optimize=True)
    return out.getvalue()


def _axes(
    draw: ImageDraw.ImageDraw, unit: float, size: tuple[int, int], eye: Viewpoint, low: Points, high: Points
) -> None:
    """Draws axes along three edges of a box: the two near ones of its floor, and the upright one on the left."""
    upright = int(np.abs(eye.axes[1]).argmax())
    down = bool(eye.axes[1, upright] < 0)
    ends = np.stack([low, high])
    ground = ends[int(down), upright]
    near = np.where(eye.position > (low + high) / 2, high, low)
    near[upright] = ground
    middle = eye.project(((low + high) / 2)[None])[0] * size
    floor = np.array([[x, y, z] for x in ends[:, 0] for y in ends[:, 1] for z in ends[:, 2]])
    floor = floor[floor[:, upright] == ground]
    left = floor[np.argmin(eye.project(floor)[:, 0])]
    for axis in range(3):
        origin = left if axis == upright else near
        edge = np.stack([origin, origin])
        edge[:, axis] = ends[:, axis]
        first, last = eye.project(edge) * size
        length = float(np.linalg.norm(last - first))
        if length < LABEL_DISTANCE * unit:
            continue
        draw.line([tuple(first), tuple(last)], LINE, max(1, round(unit)))
        # Labels lie outside the box: on the side of the edge that faces away from its middle.
        along = (last - first) / length
        out = np.array([-along[1], along[0]])
        out *= -np.sign(out @ (middle - first)) or 1.0
        extent = float(high[axis] - low[axis])
        for value, text in ticks(float(low[axis]), float(high[axis]), extent * LABEL_DISTANCE * unit / length):
            point = origin.copy()
            point[axis] = value
            at = (eye.project(point[None]) * size)[0]
            draw.line([tuple(at), tuple(at + 7 * unit * out)], LINE, max(1, round(1.5 * unit)))
            draw.text(tuple(at + 24 * unit * out), text, FAINT, font(unit, 17), anchor="mm")
        name = "xyz"[axis]
        place = (first + last) / 2 + 62 * unit * out
        if axis == upright:  # the name lies beyond its upper end
            name += ", down" if down else ""
            place = first - 26 * unit * along if down else last + 26 * unit * along
        draw.text(tuple(place), name, INK, font(unit, 20), anchor="mm")


#: Most splats that are drawn as ellipsoids, and most times that their areas may cover the picture: more takes minutes.
#: Beyond either, splats are drawn as points.
MOST_ELLIPSOIDS, MOST_OVERDRAW = 80_000, 150

#: Most triangles of all ellipsoids together: the fewer the ellipsoids, the rounder they are.
MOST_TRIANGLES = 1_700_000

#: Radii of the ellipsoids, in standard deviations.
DEVIATIONS = 1

#: Diameters of points, pixels.
POINT_PIXELS = np.array([2.0, 3.0, 4.0, 6.0])

#: Samples along each side of a pixel, of which it is the mean: smooths edges and keeps lines thinner than a pixel.
OVERSAMPLING = 2

#: Coordinates are clipped to this many times the extent of the scene.
FARTHEST = 1e6

#: Program that draws 8 x 8 pixels, run in its own process, because VTK ends the process where OpenGL is missing.
PROBE = """
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow
window = vtkRenderWindow()
window.SetOffScreenRendering(1)
window.SetSize(8, 8)
window.AddRenderer(vtkRenderer())
window.Render()
"""


@functools.cache
def load_pyvista() -> ModuleType:
    """Import pyvista, after a check that it can draw here.

    Raises:
        SparklodError: pyvista is not installed, or OpenGL is missing.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        # Without this VTK warns, and falls back to EGL only where the libraries of X are installed.
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    with optional_import("pictures of trees need pyvista", "render", package="pyvista"):
        import pyvista
    try:
        subprocess.run(program_command(PROBE), check=True, capture_output=True, timeout=60)
    except (OSError, subprocess.SubprocessError):
        libraries = "libegl1 libgl1-mesa-dri"
        raise SparklodError(
            f"pictures cannot be drawn: OpenGL is missing (on Debian and Ubuntu: apt install {libraries})"
        ) from None
    return pyvista


class PyvistaStage:
    """A scene to render, in units of its extent and around its middle, so that float32 suffices wherever it lies.

    A context manager: it frees pyvista's memory at the end.
    """

    def __init__(self, low: Points, high: Points, size: tuple[int, int], background: str) -> None:
        self._pyvista = load_pyvista()
        self._middle, self._unit, self._size = (low + high) / 2, float((high - low).max()), size
        window = [OVERSAMPLING * edge for edge in size]
        self._plotter = self._pyvista.Plotter(off_screen=True, window_size=window, lighting="light kit")
        self._plotter.set_background(background)

    def __enter__(self) -> PyvistaStage:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._plotter.close()

    def splats(self, splats: Splats, rgb: NDArray[np.uint8], eye: Viewpoint) -> str:
        """Add N splats in (N, 3) colours, as ellipsoids or, if they are too many, as points; return a description."""
        away = (splats.center - eye.position) @ eye.axes[2]
        half = math.tan(math.radians(eye.angle) / 2)
        pixels = splats.scale.mean(axis=1) / np.maximum(away, 1e-3 * self._unit) * self._size[1] / half
        overdraw = float(np.square(pixels, dtype=np.float64).sum()) / (self._size[0] * self._size[1])
        if len(splats) > MOST_ELLIPSOIDS or overdraw > MOST_OVERDRAW:
            self._points(splats, rgb, pixels)
            return f"points of the splats' size, {POINT_PIXELS[0]:g} to {POINT_PIXELS[-1]:g} pixels"
        # From front to back, so that hidden surfaces cost little.
        order = np.argsort(away - splats.scale.max(axis=1), kind="stable")
        of = sphere(next(n for n in (3, 2, 1, 0) if n == 0 or len(splats) * 20 * 4**n <= MOST_TRIANGLES))
        shape = ellipsoids(splats.take(order), DEVIATIONS, of, thinnest=0.7 * self._unit / self._size[1])
        mesh = self._pyvista.PolyData.from_regular_faces(self._local(shape.points), shape.triangles)
        colors = np.repeat(rgb[order], len(of.points), axis=0)
        self._add(mesh, shape.normals, colors, ambient=0.45, diffuse=0.65, specular=0.15, culling="back")
        return f"ellipsoids at {DEVIATIONS:g} standard deviation"

    def _points(self, splats: Splats, rgb: NDArray[np.uint8], pixels: FloatArray) -> None:
        # Most splats are flat and lie in the surfaces of the scene, so their thinnest axis serves as the normal.
        flat = rotation(splats.quat_xyzw)[np.arange(len(splats)), :, splats.scale.argmin(axis=1)]
        step = np.searchsorted(POINT_PIXELS[1:], pixels, side="right")
        for number, size in enumerate(POINT_PIXELS):
            here = step == number
            if here.any():
                mesh = self._pyvista.PolyData(self._local(splats.center[here]))
                self._add(mesh, flat[here], rgb[here], point_size=size * OVERSAMPLING, ambient=0.5, diffuse=0.6)

    def _add(self, mesh: Any, normals: FloatArray, rgb: NDArray[np.uint8], **options: Any) -> None:
        mesh.point_data["rgb"] = rgb
        mesh.point_data["Normals"] = normals
        mesh.point_data.active_normals_name = "Normals"
        actor = self._plotter.add_mesh(mesh, scalars="rgb", rgb=True, **options)
        actor.prop.interpolation = "gouraud"

    def dots(self, points: Points, color: str) -> None:
        """Add small points of one colour."""
        mesh = self._pyvista.PolyData(self._local(points))
        self._plotter.add_mesh(mesh, color=color, point_size=1.5 * OVERSAMPLING, lighting=False)

    def lines(self, ends: Points, color: str, opacity: float, *, width: float = 1) -> None:
        """Add lines between pairs of points, `width` pixels wide."""
        if len(ends):
            pairs = np.insert(np.arange(len(ends)).reshape(-1, 2), 0, 2, axis=1)
            mesh = self._pyvista.PolyData(self._local(ends), lines=pairs.ravel())
            self._plotter.add_mesh(mesh, color=color, opacity=opacity, line_width=width * OVERSAMPLING, lighting=False)

    def _local(self, points: Points) -> FloatArray:
        local: FloatArray = np.clip((points - self._middle) / self._unit, -FARTHEST, FARTHEST).astype(np.float32)
        return local

    def photograph(self, eye: Viewpoint) -> NDArray[np.uint8]:
        """(H, W, 3) the picture from a viewpoint."""
        camera = self._plotter.camera
        camera.position, camera.focal_point = self._local(eye.position), self._local(eye.target)
        camera.up, camera.view_angle = eye.axes[1], eye.angle
        camera.SetWindowCenter(*-eye.shift)
        # VTK would choose the range by the farthest splat, and its near plane would then cut the scene.
        distance = float(np.linalg.norm(eye.target - eye.position)) / self._unit
        camera.clipping_range = (0.05 * distance, 20 * distance)
        pixels = self._plotter.screenshot(None, return_img=True)
        width, height = self._size
        fine = pixels[..., :3].reshape(height, OVERSAMPLING, width, OVERSAMPLING, 3)
        mean: NDArray[np.uint8] = fine.mean(axis=(1, 3)).round().astype(np.uint8)
        return mean
