"""The one place that talks to pyvista: a scene is put on a stage and photographed, off screen."""

from __future__ import annotations

import functools
import math
import os
import subprocess
import sys
from types import ModuleType, TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray, Splats
from ..support.errors import SparklodError
from .ellipsoids import Points, ellipsoids, rotation, sphere
from .viewpoint import Viewpoint

#: More splats than this are drawn as points, and those that would cover the picture more often than this, which takes
#: minutes.
MOST_ELLIPSOIDS, MOST_OVERDRAW = 80_000, 150

#: So many triangles of ellipsoids are drawn at most: fewer ellipsoids are rounder.
MOST_TRIANGLES = 1_700_000

#: How far out the ellipsoids go.
DEVIATIONS = 1

#: The sizes that points are drawn at.
POINT_PIXELS = np.array([2.0, 3.0, 4.0, 6.0])

#: Each pixel is the mean of so many, squared: what is thinner than a pixel stays visible, and edges are smooth.
OVERSAMPLING = 2

#: Nothing is drawn farther out than so many times the extent of the scene.
FARTHEST = 1e6

#: Draws 8 x 8 pixels. Run by itself, because VTK ends the process where there is no OpenGL.
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
    """Imports pyvista where it can draw.

    Raises:
        SparklodError: it is not installed, or there is no OpenGL.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        # VTK would find out by itself, but with a warning, and only where the libraries of X are installed.
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    try:
        import pyvista
    except ImportError as error:
        raise SparklodError(f"pictures are drawn by pyvista: pip install 'sparklod[render]' ({error})") from None
    try:
        subprocess.run([sys.executable, "-c", PROBE], check=True, capture_output=True, timeout=60)
    except (OSError, subprocess.SubprocessError):
        libraries = "libegl1 libgl1-mesa-dri"
        raise SparklodError(
            f"pictures cannot be drawn: there is no OpenGL here (on Debian and Ubuntu: apt install {libraries})"
        ) from None
    return pyvista


class Stage:
    """What is drawn, in units of the scene's extent: float32 has the scene near 0, however far out it is.

    A context manager, which frees the memory of the pictures.
    """

    def __init__(self, low: Points, high: Points, size: tuple[int, int], background: str) -> None:
        self._pyvista = load_pyvista()
        self._middle, self._unit, self._size = (low + high) / 2, float((high - low).max()), size
        window = [OVERSAMPLING * edge for edge in size]
        self._plotter = self._pyvista.Plotter(off_screen=True, window_size=window, lighting="light kit")
        self._plotter.set_background(background)

    def __enter__(self) -> Stage:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._plotter.close()

    def splats(self, splats: Splats, rgb: NDArray[np.uint8], eye: Viewpoint) -> str:
        """Puts splats there in (N, 3) colours: as ellipsoids or, if they are many, as points. Says as which."""
        away = (splats.center - eye.position) @ eye.axes[2]
        half = math.tan(math.radians(eye.angle) / 2)
        pixels = splats.scale.mean(axis=1) / np.maximum(away, 1e-3 * self._unit) * self._size[1] / half
        overdraw = float(np.square(pixels, dtype=np.float64).sum()) / (self._size[0] * self._size[1])
        if len(splats) > MOST_ELLIPSOIDS or overdraw > MOST_OVERDRAW:
            self._points(splats, rgb, pixels)
            return f"points as large as they are, {POINT_PIXELS[0]:g} to {POINT_PIXELS[-1]:g} pixels"
        # From front to back, so that what is hidden costs little.
        order = np.argsort(away - splats.scale.max(axis=1), kind="stable")
        of = sphere(next(n for n in (3, 2, 1, 0) if n == 0 or len(splats) * 20 * 4**n <= MOST_TRIANGLES))
        shape = ellipsoids(splats.take(order), DEVIATIONS, of, thinnest=0.7 * self._unit / self._size[1])
        mesh = self._pyvista.PolyData.from_regular_faces(self._local(shape.points), shape.triangles)
        colors = np.repeat(rgb[order], len(of.points), axis=0)
        self._add(mesh, shape.normals, colors, ambient=0.45, diffuse=0.65, specular=0.15, culling="back")
        return f"ellipsoids of {DEVIATIONS:g} standard deviation"

    def _points(self, splats: Splats, rgb: NDArray[np.uint8], pixels: FloatArray) -> None:
        # Most splats of a scene are flat and lie in its surfaces, so their thinnest axis can stand for a normal.
        flat = rotation(splats.quat_xyzw)[np.arange(len(splats)), :, splats.scale.argmin(axis=1)]
        step = np.searchsorted(POINT_PIXELS[1:], pixels, side="right")
        for number, size in enumerate(POINT_PIXELS):
            here = step == number
            if here.any():
                mesh = self._pyvista.PolyData(self._local(splats.center[here]))
                self._add(mesh, flat[here], rgb[here], point_size=size * OVERSAMPLING, ambient=0.5, diffuse=0.6)

    def _add(self, mesh: Any, normals: FloatArray, rgb: NDArray[np.uint8], **how: Any) -> None:
        mesh.point_data["rgb"] = rgb
        mesh.point_data["Normals"] = normals
        mesh.point_data.active_normals_name = "Normals"
        actor = self._plotter.add_mesh(mesh, scalars="rgb", rgb=True, **how)
        actor.prop.interpolation = "gouraud"

    def dots(self, points: Points, color: str) -> None:
        """Puts small points there."""
        mesh = self._pyvista.PolyData(self._local(points))
        self._plotter.add_mesh(mesh, color=color, point_size=1.5 * OVERSAMPLING, lighting=False)

    def lines(self, ends: Points, color: str, opacity: float, *, width: float = 1) -> None:
        """Puts lines there, between points by twos, so many pixels wide."""
        if len(ends):
            pairs = np.insert(np.arange(len(ends)).reshape(-1, 2), 0, 2, axis=1)
            mesh = self._pyvista.PolyData(self._local(ends), lines=pairs.ravel())
            self._plotter.add_mesh(mesh, color=color, opacity=opacity, line_width=width * OVERSAMPLING, lighting=False)

    def _local(self, points: Points) -> FloatArray:
        local: FloatArray = np.clip((points - self._middle) / self._unit, -FARTHEST, FARTHEST).astype(np.float32)
        return local

    def photograph(self, eye: Viewpoint) -> NDArray[np.uint8]:
        """(H, W, 3) what is seen from a viewpoint."""
        camera = self._plotter.camera
        camera.position, camera.focal_point = self._local(eye.position), self._local(eye.target)
        camera.up, camera.view_angle = eye.axes[1], eye.angle
        camera.SetWindowCenter(*-eye.shift)
        # VTK would choose a range by the farthest of all splats, in which the scene itself is cut off.
        distance = float(np.linalg.norm(eye.target - eye.position)) / self._unit
        camera.clipping_range = (0.05 * distance, 20 * distance)
        pixels = self._plotter.screenshot(None, return_img=True)
        width, height = self._size
        fine = pixels[..., :3].reshape(height, OVERSAMPLING, width, OVERSAMPLING, 3)
        mean: NDArray[np.uint8] = fine.mean(axis=(1, 3)).round().astype(np.uint8)
        return mean
