"""Pictures of splats, points and lines by pyvista, with title, scale and axes. Only this module imports pyvista."""

from __future__ import annotations

import contextlib
import functools
import io
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from ..lod.tree_settings import DEFAULT_BASE
from ..model.gaussian import rotation_matrix
from ..model.splats import FloatArray, Splats
from ..render.color_scales import Coloring, ticks
from ..system.errors import SparklodError, optional_import
from ..system.python_process import program_command
from .pixels import FAINT, INK, LINE, font, write_scale, write_title

#: (N, 3) points, or pairs of ends of lines; (3,) for a single point.
Points = NDArray[np.floating[Any]]

#: (T, 3) indices of the points of triangles.
Triangles = NDArray[np.int64]

#: Corners of the unit cube, and pairs of them that its twelve edges join.
CORNERS = np.array(list(product((0, 1), repeat=3)), np.float64)
EDGES = np.array([(a, b) for a, b in combinations(range(8), 2) if (a ^ b) in (1, 2, 4)])


def sphere(rounds: int) -> tuple[FloatArray, Triangles]:
    """Return (P, 3) points and triangles of a unit sphere: an icosahedron, `rounds` times split into fourths."""
    golden = (1 + math.sqrt(5)) / 2
    one = np.array([[-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0]])
    points = np.concatenate([one, np.roll(one, 1, axis=1), np.roll(one, 2, axis=1)])
    near = np.linalg.norm(points[:, None] - points[None], axis=2) < 2.1  # the edges are 2 long
    triangles = np.array([(a, b, c) for a, b, c in combinations(range(12), 3) if near[a, b] & near[b, c] & near[a, c]])
    for _ in range(rounds):
        sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        pairs, at = np.unique(sides, axis=0, return_inverse=True)
        middle = at.reshape(-1, 3) + len(points)
        points = np.concatenate([points, points[pairs].mean(axis=1)])
        (a, b, c), (ab, bc, ca) = triangles.T, middle.T
        triangles = np.concatenate(
            [np.stack(corner, 1) for corner in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    p, q, r = unit[triangles].transpose(1, 0, 2)
    inward = np.einsum("ij,ij->i", np.cross(q - p, r - p), p) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return unit.astype(np.float32), triangles


def rotation(quat_xyzw: FloatArray) -> FloatArray:
    """Convert (N, 4) unit quaternions to (N, 3, 3) float32 rotations: splat, world axis, local axis."""
    return np.stack(rotation_matrix(*quat_xyzw.T), axis=1).reshape(-1, 3, 3)


def ellipsoids(
    splats: Splats, deviations: float, ball: tuple[FloatArray, Triangles], thinnest: float
) -> tuple[FloatArray, FloatArray, Triangles]:
    """Return points, unit normals and triangles of the surfaces of splats at a number of standard deviations.

    Points of the unit sphere `ball` are multiplied by the radii, its normals divided by them. No radius is below
    `thinnest`, in world units, so that no splat falls between pixels.
    """
    unit, faces = ball
    axes = rotation(splats.quat_xyzw)
    radii = np.maximum(splats.scale * np.float32(deviations), np.float32(thinnest))
    points = unit @ (axes * radii[:, None]).transpose(0, 2, 1) + splats.center[:, None]
    normals = unit @ (axes * (radii.min(axis=1, keepdims=True) / radii)[:, None]).transpose(0, 2, 1)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    triangles = faces + len(unit) * np.arange(len(splats))[:, None, None]
    return points.reshape(-1, 3), normals.reshape(-1, 3), triangles.reshape(-1, 3)


def evenly(count: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` evenly spaced indices below `count`."""
    return np.arange(count) if count <= most else np.arange(most) * count // most


def level_of_step(size: float) -> int:
    """Return the voxel level of Quick-LoD for a design size, 2 * max(scale); cells are DEFAULT_BASE ** level wide."""
    return math.ceil(math.log(size, DEFAULT_BASE) - 1e-9)


def cells(center: FloatArray, step: float) -> Points:
    """Return the (C, 3) lowest corners of the occupied cells of a grid with edges of `step`."""
    return np.unique(np.floor(center.astype(np.float64) / step), axis=0) * step


def box_lines(low: Points, high: Points) -> Points:
    """Return the (24 B, 3) ends of the edges of B boxes with the corners (B, 3) `low` and `high`."""
    corners = low[:, None] + CORNERS * (high - low)[:, None]
    return corners[:, EDGES].reshape(-1, 3)


def wall_lines(low: Points, high: Points, far: Points, spacing: float) -> Points:
    """Return the ends of lines at multiples of `spacing` on the three walls of a box that meet in its corner `far`."""
    lines: list[Points] = []
    for axis in range(3):
        at = spacing * np.arange(math.ceil(low[axis] / spacing - 1e-9), math.floor(high[axis] / spacing + 1e-9) + 1)
        for wall in {0, 1, 2} - {axis}:
            along = 3 - axis - wall
            ends = np.empty((len(at), 2, 3))
            ends[:, :, axis], ends[:, :, wall] = at[:, None], far[wall]
            ends[:, :, along] = low[along], high[along]
            lines.append(ends.reshape(-1, 3))
    return np.concatenate(lines)


#: Outliers are shown, too, if they lie within this share of the extent of the other splats.
NEAR = 0.35


@dataclass(frozen=True)
class Viewpoint:
    """A perspective viewpoint of a figure, as opposed to a `camera.Camera` of a path.

    Attributes:
        axes: (3, 3), in rows: right, up, and into the picture.
        angle: vertical field of view, degrees.
        aspect: width over height.
        shift: (2,) position of `target` in the picture: -1 left or bottom, 0 middle, 1 right or top.
    """

    position: Points
    target: Points
    axes: Points
    angle: float
    aspect: float
    shift: Points

    def project(self, points: Points) -> Points:
        """Project (N, 3) points to (N, 2) positions in the picture, 0..1 from the left and from the top."""
        local = (np.asarray(points, np.float64) - self.position) @ self.axes.T
        return (1 + (_seen(local, self.angle, self.aspect) + self.shift) * (1, -1)) / 2


def viewpoint(
    points: Points, direction: Points, up: Points, *, aspect: float, frame: tuple[float, float, float, float]
) -> Viewpoint:
    """Return the viewpoint along a direction whose picture just fits all points into a frame.

    `frame` is left, top, right and bottom in the picture, 0..1 from the left and from the top.
    """
    angle = 25.0
    forward = direction / np.linalg.norm(direction)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, forward), forward])
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    local = (points - target) @ axes.T
    left, top, end, bottom = frame
    room = 2 * np.array([end - left, bottom - top])
    radius = float(np.linalg.norm(local, axis=1).max()) or 1.0
    near, far = 1.01 * radius, 1e3 * radius
    for _ in range(60):  # bisects the distance: the picture shrinks as it grows
        distance = (near + far) / 2
        seen = _seen(local + np.array([0, 0, distance]), angle, aspect)
        near, far = (near, distance) if (np.ptp(seen, axis=0) <= room).all() else (distance, far)
    seen = _seen(local + np.array([0, 0, far]), angle, aspect)
    shift = np.array([left + end - 1, 1 - top - bottom]) - (seen.min(axis=0) + seen.max(axis=0)) / 2
    return Viewpoint(target - far * forward, target, axes, angle, aspect, shift)


def _seen(local: Points, angle: float, aspect: float) -> Points:
    """Project (N, 3) points in the axes of a viewpoint to (N, 2) positions, -1..1 from the left and the bottom."""
    half = math.tan(math.radians(angle) / 2)
    return local[:, :2] / (local[:, 2:] * (half * aspect, half))


def is_drawable(splats: Splats) -> NDArray[np.bool_]:
    """Return an (N,) mask of the splats that are valid and have a size."""
    drawable: NDArray[np.bool_] = splats.is_valid() & (splats.scale.max(axis=1) > 0)
    return drawable


def bounds(splats: Splats) -> tuple[Points, Points]:
    """Return the lowest and highest corner, (3,) each, of the visible box around drawable splats, at least one.

    Along each axis it spans the 1 % to the 99 % quantile, or all splats if the rest are within `NEAR`.
    """
    reach = splats.scale.max(axis=1).astype(np.float64)
    ends = np.empty((4, 3))
    for axis in range(3):
        center = splats.center[:, axis].astype(np.float64)
        low, high = np.percentile(center - reach, 1), np.percentile(center + reach, 99)
        ends[:, axis] = min(low, center.min()), low, high, max(high, center.max())
    least, low, high, most = ends
    near = NEAR * float((high - low).max())
    low, high = np.where(low - least < near, least, low), np.where(most - high < near, most, high)
    # A tiny scene far from the origin may be smaller than the steps of float32 there.
    margin = max(0.02 * float((high - low).max()), 1e-6 * float(np.abs([low, high]).max()))
    return low - margin, high + margin


#: Least distance between the labels of an axis, in thousandths of the picture's height.
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
    """Add a title, a colour scale, and axes along the edges of a box to a picture, (H, W, 3); return the PNG."""
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
    """Draw axes along three edges of a box: the two near ones of its floor, and the upright one on the left."""
    upright = int(np.abs(eye.axes[1]).argmax())
    down = bool(eye.axes[1, upright] < 0)
    ends = np.stack([low, high])
    ground = ends[int(down), upright]
    near = np.where(eye.position > (low + high) / 2, high, low)
    near[upright] = ground
    middle = eye.project(((low + high) / 2)[None])[0] * size
    floor = np.array(list(product(*ends.T)))
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
        if axis == upright:  # with its name beyond its upper end
            name += ", down" if down else ""
            place = first - 26 * unit * along if down else last + 26 * unit * along
        draw.text(tuple(place), name, INK, font(unit, 20), anchor="mm")


#: Most splats that are drawn as ellipsoids, and most times that these may cover the picture: more takes minutes.
#: Beyond either, splats are drawn as points.
MOST_ELLIPSOIDS, MOST_OVERDRAW = 80_000, 150

#: Most triangles of all ellipsoids together: fewer ellipsoids are rounder.
MOST_TRIANGLES = 1_700_000

#: Radii of the ellipsoids, in standard deviations.
DEVIATIONS = 1

#: Diameters of points, pixels.
POINT_PIXELS = np.array([2.0, 3.0, 4.0, 6.0])

#: Samples along each side of a pixel: smooths edges and keeps lines thinner than a pixel.
OVERSAMPLING = 2

#: Coordinates are clipped to this many times the extent of the scene.
FARTHEST = 1e6

#: Program that draws 8 x 8 pixels, in its own process because VTK ends the process if OpenGL is missing.
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
    """Import pyvista and check that it can draw here; `SparklodError` if pyvista or OpenGL is missing."""
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


class PyvistaStage(contextlib.AbstractContextManager["PyvistaStage"]):
    """A scene to render, with its centre and extent as origin and unit, so that float32 suffices far from the origin.

    Leaving the context frees pyvista's memory.
    """

    def __init__(self, low: Points, high: Points, size: tuple[int, int], background: str) -> None:
        self._pyvista = load_pyvista()
        self._middle, self._unit, self._size = (low + high) / 2, float((high - low).max()), size
        window = [OVERSAMPLING * edge for edge in size]
        self._plotter = self._pyvista.Plotter(off_screen=True, window_size=window, lighting="light kit")
        self._plotter.set_background(background)

    def __exit__(self, *error: object) -> None:
        self._plotter.close()

    def splats(self, splats: Splats, rgb: NDArray[np.uint8], eye: Viewpoint) -> str:
        """Add splats in (N, 3) colours, as ellipsoids or, if there are too many, as points; return a description."""
        away = (splats.center - eye.position) @ eye.axes[2]
        half = math.tan(math.radians(eye.angle) / 2)
        pixels = splats.scale.mean(axis=1) / np.maximum(away, 1e-3 * self._unit) * self._size[1] / half
        overdraw = float(np.square(pixels, dtype=np.float64).sum()) / (self._size[0] * self._size[1])
        if len(splats) > MOST_ELLIPSOIDS or overdraw > MOST_OVERDRAW:
            self._points(splats, rgb, pixels)
            return f"points of the splats' size, {POINT_PIXELS[0]:g} to {POINT_PIXELS[-1]:g} pixels"
        # From front to back, so that hidden surfaces cost little.
        order = np.argsort(away - splats.scale.max(axis=1), kind="stable")
        ball = sphere(next(n for n in (3, 2, 1, 0) if n == 0 or len(splats) * 20 * 4**n <= MOST_TRIANGLES))
        thinnest = 0.7 * self._unit / self._size[1]
        points, normals, triangles = ellipsoids(splats.take(order), DEVIATIONS, ball, thinnest)
        mesh = self._pyvista.PolyData.from_regular_faces(self._local(points), triangles)
        colors = np.repeat(rgb[order], len(ball[0]), axis=0)
        self._add(mesh, normals, colors, ambient=0.45, diffuse=0.65, specular=0.15, culling="back")
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
        camera = self._plotter.camera
        camera.position, camera.focal_point = self._local(eye.position), self._local(eye.target)
        camera.up, camera.view_angle = eye.axes[1], eye.angle
        camera.SetWindowCenter(*-eye.shift)
        # VTK would choose the range by the farthest splat; its near plane would then cut the scene.
        distance = float(np.linalg.norm(eye.target - eye.position)) / self._unit
        camera.clipping_range = (0.05 * distance, 20 * distance)
        pixels = self._plotter.screenshot(None, return_img=True)
        width, height = self._size
        fine = pixels[..., :3].reshape(height, OVERSAMPLING, width, OVERSAMPLING, 3)
        mean: NDArray[np.uint8] = fine.mean(axis=(1, 3)).round().astype(np.uint8)
        return mean
