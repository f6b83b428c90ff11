"""The backend `osmesa`: draws splats with OpenGL, as viewers in browsers do, without a window or a graphics card.

The pipeline is antimatter15's: splats in an integer texture, an instance of one quad for each, the nearest first, and
blending from front to back. Splats look as in the other backends.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...cameras.camera import Camera
from ...model.falloff import MIN_ALPHA
from ...model.splats import FloatArray
from ...system.errors import BackendError
from ...system.optional import optional_import
from ..rasterizer import Image, ShadedSplats, world_to_camera
from ..settings import CLIP, RasterSettings
from . import context as contexts
from .texture import data_texture_of, sources

Indices = NDArray[np.uint32]


class Order:
    """Finds the splats to draw, from near to far, for a moving camera.

    Args:
        sorting: one of `settings.SORTINGS`.
        throttle: splats are sorted again only when the cosine between the camera's direction at the last sort and its
            current direction is at most 1 - throttle; antimatter15's viewer uses 0.01, an angle of 8.1 degrees. 0 sorts
            for each camera. With `RasterSettings.sort` "radial", which depends on the camera's position, they are also
            sorted when it has moved so far that the splat of median distance appears rotated by that angle.
    """

    def __init__(self, sorting: str, throttle: float = 0.0) -> None:
        self.sorting, self.throttle = sorting, throttle
        self._sorted: tuple[Camera, RasterSettings, float] | None = None

    def forget(self) -> None:
        """Discard the last order, because the splats have changed."""
        self._sorted = None

    def update(self, splats: ShadedSplats, camera: Camera, raster: RasterSettings) -> Indices | None:
        """Return indices of the splats that may be visible, in order; None while the last order is still valid."""
        if self._sorted is not None and self._close(camera, raster, *self._sorted):
            return None
        with np.errstate(over="ignore", invalid="ignore"):  # splats that far away are not drawn
            u, v, depth = _into_camera(splats.center, camera)
            key = np.sqrt(u * u + v * v + depth * depth) if raster.sort == "radial" else depth
            if self.throttle:
                # Splats that are invisible now may be visible when this order is reused.
                seen = np.flatnonzero(np.isfinite(key)).astype(np.uint32)
            else:
                seen = _in_sight(splats, u, v, depth, camera, raster)
        key = key[seen]
        self._sorted = camera, raster, float(np.median(np.abs(key))) if len(key) else 0.0
        return seen[SORT[self.sorting](key)]

    def _close(
        self, camera: Camera, raster: RasterSettings, old: Camera, old_raster: RasterSettings, middle: float
    ) -> bool:
        if not self.throttle or raster.sort != old_raster.sort:
            return False
        if 1 - float(camera.forward @ old.forward) >= self.throttle:
            return False
        if raster.sort != "radial":
            return True  # moving the camera adds the same to all depths
        return float(np.linalg.norm(camera.position - old.position)) < np.sqrt(2 * self.throttle) * middle


def _into_camera(center: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return camera coordinates right, down and forward, (N,) float32 each, rounded as in the rasterizer's kernel."""
    m = world_to_camera(camera)
    x, y, z = center.T
    u, v, w = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in m)
    return u, v, w


def _in_sight(
    splats: ShadedSplats, u: FloatArray, v: FloatArray, depth: FloatArray, camera: Camera, raster: RasterSettings
) -> Indices:
    """Return indices of the splats whose centres the vertex shader does not cull, with a small margin."""
    seen = (depth > raster.near) & (depth < raster.far) & (splats.lod_opacity >= np.float32(MIN_ALPHA))
    for across, focal, principal, pixels in zip(
        (u, v), camera.focal, camera.principal, (camera.width, camera.height), strict=True
    ):
        # Times the depth, from the middle of the picture.
        off = np.abs(np.float32(focal) * across + np.float32(principal - pixels / 2) * depth)
        seen &= off <= np.float32(1.0001 * CLIP * pixels / 2) * depth
    return np.flatnonzero(seen).astype(np.uint32)


def sort_exact(key: FloatArray) -> NDArray[np.int64]:
    """Return (N,) indices sorted by (N,) float32 keys, equal keys by descending index, as in Spark.

    Sorts 64-bit numbers of key and index, which is several times faster than sorting indices.
    """
    bits = (key + np.float32(0)).view(np.uint32)  # -0 equals 0
    # Flips the bits that make negative floats sort in reverse.
    ordered = bits ^ np.where(bits >> 31, np.uint32(0xFFFFFFFF), np.uint32(0x80000000))
    both = (ordered.astype(np.uint64) << np.uint64(32)) | np.arange(len(key), dtype=np.uint64)[::-1]
    both.sort()
    return len(key) - 1 - (both & np.uint64(0xFFFFFFFF)).astype(np.int64)


def sort_counting16(key: FloatArray) -> NDArray[np.int64]:
    """Return (N,) indices sorted by (N,) float32 keys quantized to 65,536 steps; within a step by descending index."""
    if not len(key):
        return np.zeros(0, np.int64)
    above = key.astype(np.float64) - float(key.min())
    step = (above * (65535 / (above.max() or 1))).astype(np.uint16)
    return len(key) - 1 - np.argsort(step[::-1], kind="stable")  # numpy sorts uint16 by radix


SORT = {"exact": sort_exact, "counting16": sort_counting16}


#: A quad as a triangle fan; the splat's ellipse ends at 2.
CORNERS = np.array([[-2, -2], [2, -2], [2, 2], [-2, 2]], np.float32)

_T = TypeVar("_T")


def draw(
    splats: ShadedSplats,
    camera: Camera,
    raster: RasterSettings,
    *,
    precision: str = "float",
    sorting: str = "exact",
    throttle: float = 0.0,
) -> Image:
    """Draw the picture of a camera: (height, width, 4) float32 red, green, blue (premultiplied) and alpha, 0..1.

    OpenGL objects are reused from frame to frame. `precision` is one of `gl.texture.PRECISIONS`; `sorting` and
    `throttle` are those of `Order`.

    Raises:
        BackendError: OpenGL is not available, or the picture or the scene exceeds its limits.
    """
    return _renderer(precision, sorting, throttle).draw(splats, camera, raster)


@functools.lru_cache(maxsize=2)
def _renderer(precision: str, sorting: str, throttle: float) -> OpenGLRenderer:
    return OpenGLRenderer(precision=precision, sorting=sorting, throttle=throttle)


class OpenGLRenderer:
    """Draws a sequence of frames; compiles once, and uploads only what has changed."""

    def __init__(self, *, precision: str = "float", sorting: str = "exact", throttle: float = 0.0) -> None:
        self._data, self._order = data_texture_of(precision), Order(sorting, throttle)
        self.uploads = self.sorts = 0
        self._count, self._capacity, self._size = 0, 0, (0, 0)
        self._texture: Any = None
        self._target: Any = None
        self._indices: Any = None
        self._array: Any = None
        on_gl_thread(self._compile, precision)

    def draw(self, splats: ShadedSplats, camera: Camera, raster: RasterSettings) -> Image:
        return on_gl_thread(self._draw, splats, camera, raster)

    def _compile(self, precision: str) -> None:
        self._context = open_context()
        self._program = self._context.program(**sources(precision))
        self._corners = self._context.buffer(CORNERS.tobytes())

    def _draw(self, splats: ShadedSplats, camera: Camera, raster: RasterSettings) -> Image:
        self._context.gc()
        self._upload(splats)
        self._sort(splats, camera, raster)
        self._resize(camera.width, camera.height)
        self._target.use()
        self._target.clear()
        if self._count:
            self._set_uniforms(camera, raster)
            self._texture.use(0)
            self._context.enable_only(self._context.BLEND)
            self._context.blend_func = self._context.ONE_MINUS_DST_ALPHA, self._context.ONE
            self._array.render(self._context.TRIANGLE_FAN, vertices=4, instances=self._count)
        image = np.empty((camera.height, camera.width, 4), np.float32)
        self._target.read_into(image, components=4, dtype="f4")
        self._check("drawing")
        return image

    def _upload(self, splats: ShadedSplats) -> None:
        changed, moved = self._data.update(splats)
        if moved:
            self._order.forget()
        if not changed and self._texture is not None:  # it is None after a scene that was too large
            return
        height, width = self._data.texture.shape[:2]
        if self._texture is None or self._texture.height != height:
            self._texture = None
            self._check_edge(max(height, width), f"{len(splats):,} splats")
            self._texture = self._context.texture((width, height), 4, dtype="u4")
            self._texture.filter = self._context.NEAREST, self._context.NEAREST
            self._check(f"a texture for {len(splats):,} splats")
        self._texture.write(self._data.texture)
        self.uploads += 1

    def _sort(self, splats: ShadedSplats, camera: Camera, raster: RasterSettings) -> None:
        indices = self._order.update(splats, camera, raster)
        if indices is None:
            return
        self.sorts += 1
        self._count = len(indices)
        if self._array is None or self._capacity < len(splats):
            self._capacity = max(1, len(splats))
            self._indices = self._context.buffer(reserve=4 * self._capacity, dynamic=True)
            content = [(self._corners, "2f", "corner"), (self._indices, "1u/i", "index")]
            self._array = self._context.vertex_array(self._program, content)
        self._indices.orphan()
        self._indices.write(indices)

    def _resize(self, width: int, height: int) -> None:
        if self._size == (width, height):
            return
        self._target, self._size = None, (0, 0)
        self._check_edge(max(width, height), f"{width} x {height} pixels")
        self._target = self._context.framebuffer([self._context.renderbuffer((width, height), 4, dtype="f4")])
        self._check(f"a picture of {width} x {height} pixels")
        self._size = width, height

    def _set_uniforms(self, camera: Camera, raster: RasterSettings) -> None:
        uniforms = {
            "world_to_camera": tuple(world_to_camera(camera).T.ravel()),
            "focal": camera.focal,
            "principal": camera.principal,
            "size": (camera.width, camera.height),
            "range": (raster.near, raster.far),
            "max_radius": raster.max_radius,
            "shifted": raster.profile == "shifted",
        }
        for name, value in uniforms.items():
            self._program[name] = value

    def _check_edge(self, edge: int, what: str) -> None:
        most = self._context.info["GL_MAX_TEXTURE_SIZE"]
        if edge > most:
            raise BackendError(f"{what} exceed the limit of this OpenGL, {most} along an edge; use the backend numba")

    def _check(self, what: str) -> None:
        error = self._context.error
        if error != "GL_NO_ERROR":
            raise BackendError(f"OpenGL failed at {what}: {error}; try the backend numba")


def on_gl_thread(work: Callable[..., _T], *arguments: Any) -> _T:
    """Run a function on the thread that makes all calls to OpenGL.

    A thread has one current context. On its own thread, our context cannot interfere with that of VTK, for example:
    drivers rely on a context staying current, and otherwise draw nothing, or into another context.
    """
    thread, process = _thread()
    if process != os.getpid():  # Mesa's threads do not survive a fork, and it would wait for them forever
        raise BackendError("OpenGL cannot be used in a forked process; start processes with spawn instead of fork")
    return thread.submit(_translated, work, *arguments).result()


@functools.cache
def _thread() -> tuple[ThreadPoolExecutor, int]:
    return ThreadPoolExecutor(1, "sparklod-gl"), os.getpid()


def _translated(work: Callable[..., _T], *arguments: Any) -> _T:
    try:
        return work(*arguments)
    except Exception as error:
        if type(error).__module__.lstrip("_") == "moderngl":  # which may not be installed
            message = str(error).split("\n")[0]
            raise BackendError(f"OpenGL failed to draw ({message}); try the backend numba") from error
        raise


@functools.cache
def open_context() -> Any:
    """Return the moderngl.Context of this process, created on the first call; call and use it `on_gl_thread` only.

    Where OpenGL is not available, BackendError names the packages to install.
    """
    with optional_import("the backend osmesa needs moderngl", "render", BackendError, package="moderngl"):
        import moderngl  # noqa: F401
    reasons = []
    for kind in contexts.PACKAGES:
        reason = contexts.probe(kind)
        if not reason:
            try:
                return contexts.create(kind)
            except contexts.NoContextError as error:
                reason = str(error)
        reasons.append(f"{kind}: {reason}")
    packages = " or ".join(contexts.PACKAGES.values())
    raise BackendError(
        f"the backend osmesa finds no OpenGL (on Debian and Ubuntu: apt install {packages}; {'; '.join(reasons)})"
    )
