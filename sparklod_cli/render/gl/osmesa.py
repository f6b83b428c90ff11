"""The backend `osmesa`: splats drawn by OpenGL, as the viewers in browsers do it, without a window or a graphics card.

The pipeline is antimatter15's: splats in an integer texture, an instance of one quad for each, the nearest first, and
blending from front to back. What a splat looks like is that of the other backends.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np

from ...cameras.camera import Camera
from ...support.optional import optional_import
from ..backends import BackendError
from ..rasterizer import Image, world_to_camera
from ..settings import RasterSettings
from ..shading import ShadedSplats
from . import context as contexts
from .order import Order
from .shaders import sources
from .texture import data_texture_of

#: A quad as a triangle fan; the splat's ellipse ends at 2.
CORNERS = np.array([[-2, -2], [2, -2], [2, 2], [-2, 2]], np.float32)

_T = TypeVar("_T")


def draw(
    shown: ShadedSplats,
    camera: Camera,
    look: RasterSettings,
    *,
    precision: str = "float",
    sorting: str = "exact",
    throttle: float = 0.0,
) -> Image:
    """What a camera sees: (height, width, 4) float32, red, green, blue, multiplied by alpha, and alpha; 0..1.

    What OpenGL holds is kept from frame to frame.

    Args:
        shown, camera, look: what to draw, from where, and how.
        precision: one of `gl.texture.PRECISIONS`.
        sorting, throttle: see `gl.order.Order`.

    Raises:
        BackendError: there is no OpenGL, or the picture or the scene is larger than it takes.
    """
    return _renderer(precision, sorting, throttle).draw(shown, camera, look)


@functools.lru_cache(maxsize=2)
def _renderer(precision: str, sorting: str, throttle: float) -> Renderer:
    return Renderer(precision=precision, sorting=sorting, throttle=throttle)


class Renderer:
    """Draws frame after frame; compiles once, and uploads only what has changed.

    Attributes:
        uploads: how often the data texture went to OpenGL.
        sorts: how often splats were sorted.
    """

    def __init__(self, *, precision: str = "float", sorting: str = "exact", throttle: float = 0.0) -> None:
        """As `draw`, without anything to draw.

        Raises:
            BackendError: there is no OpenGL.
        """
        self._data, self._order = data_texture_of(precision), Order(sorting, throttle)
        self.uploads = self.sorts = 0
        self._count, self._capacity, self._size = 0, 0, (0, 0)
        self._texture: Any = None
        self._target: Any = None
        self._indices: Any = None
        self._array: Any = None
        on_gl_thread(self._compile, precision)

    def draw(self, shown: ShadedSplats, camera: Camera, look: RasterSettings) -> Image:
        """See the function `draw`."""
        return on_gl_thread(self._draw, shown, camera, look)

    def _compile(self, precision: str) -> None:
        self._context = open_context()
        self._program = self._context.program(**sources(precision))
        self._corners = self._context.buffer(CORNERS.tobytes())

    def _draw(self, shown: ShadedSplats, camera: Camera, look: RasterSettings) -> Image:
        self._context.gc()
        self._hold(shown)
        self._sort(shown, camera, look)
        self._aim_at(camera.width, camera.height)
        self._target.use()
        self._target.clear()
        if self._count:
            self._tell(camera, look)
            self._texture.use(0)
            self._context.enable_only(self._context.BLEND)
            self._context.blend_func = self._context.ONE_MINUS_DST_ALPHA, self._context.ONE
            self._array.render(self._context.TRIANGLE_FAN, vertices=4, instances=self._count)
        image = np.empty((camera.height, camera.width, 4), np.float32)
        self._target.read_into(image, components=4, dtype="f4")
        self._check("drawing")
        return image

    def _hold(self, shown: ShadedSplats) -> None:
        changed, moved = self._data.update(shown)
        if moved:
            self._order.forget()
        if not changed and self._texture is not None:  # which it is after one that was too large
            return
        height, width = self._data.texture.shape[:2]
        if self._texture is None or self._texture.height != height:
            self._texture = None
            self._fits(max(height, width), f"{len(shown):,} splats")
            self._texture = self._context.texture((width, height), 4, dtype="u4")
            self._texture.filter = self._context.NEAREST, self._context.NEAREST
            self._check(f"a texture for {len(shown):,} splats")
        self._texture.write(self._data.texture)
        self.uploads += 1

    def _sort(self, shown: ShadedSplats, camera: Camera, look: RasterSettings) -> None:
        indices = self._order.update(shown, camera, look)
        if indices is None:
            return
        self.sorts += 1
        self._count = len(indices)
        if self._array is None or self._capacity < len(shown):
            self._capacity = max(1, len(shown))
            self._indices = self._context.buffer(reserve=4 * self._capacity, dynamic=True)
            content = [(self._corners, "2f", "corner"), (self._indices, "1u/i", "index")]
            self._array = self._context.vertex_array(self._program, content)
        self._indices.orphan()
        self._indices.write(indices)

    def _aim_at(self, width: int, height: int) -> None:
        if self._size == (width, height):
            return
        self._target, self._size = None, (0, 0)
        self._fits(max(width, height), f"{width} x {height} pixels")
        self._target = self._context.framebuffer([self._context.renderbuffer((width, height), 4, dtype="f4")])
        self._check(f"a picture of {width} x {height} pixels")
        self._size = width, height

    def _tell(self, camera: Camera, look: RasterSettings) -> None:
        uniforms = {
            "world_to_camera": tuple(world_to_camera(camera).T.ravel()),
            "focal": camera.focal,
            "principal": camera.principal,
            "size": (camera.width, camera.height),
            "range": (look.near, look.far),
            "max_radius": look.max_radius,
            "shifted": look.profile == "shifted",
        }
        for name, value in uniforms.items():
            self._program[name] = value

    def _fits(self, edge: int, what: str) -> None:
        most = self._context.info["GL_MAX_TEXTURE_SIZE"]
        if edge > most:
            raise BackendError(
                f"{what} are more than this OpenGL takes, {most} along an edge; the backend numba draws them"
            )

    def _check(self, what: str) -> None:
        error = self._context.error
        if error != "GL_NO_ERROR":
            raise BackendError(f"OpenGL refuses {what}: {error}; the backend numba may draw it")


def on_gl_thread(work: Callable[..., _T], *arguments: Any) -> _T:
    """Does what talks to OpenGL, on the one thread that does.

    A thread has one current context. On one of its own, ours cannot get in the way of VTK's, for one, nor VTK's in
    ours: drivers take it for granted that a context stays current, and draw nothing, or elsewhere, where it does not.
    """
    thread, process = _thread()
    if process != os.getpid():  # Mesa's threads are gone as well, and it would wait for them forever
        raise BackendError("OpenGL does not go on in a process that was forked off: start others by spawn, not by fork")
    return thread.submit(_worded, work, *arguments).result()


@functools.cache
def _thread() -> tuple[ThreadPoolExecutor, int]:
    """The thread, and the process that has it."""
    return ThreadPoolExecutor(1, "sparklod-gl"), os.getpid()


def _worded(work: Callable[..., _T], *arguments: Any) -> _T:
    try:
        return work(*arguments)
    except Exception as error:
        if type(error).__module__.lstrip("_") == "moderngl":  # which may not be installed
            said = str(error).split("\n")[0]
            raise BackendError(f"OpenGL refuses to draw this ({said}); the backend numba may draw it") from error
        raise


@functools.cache
def open_context() -> Any:
    """The moderngl.Context of this process, made when first asked for; to be asked for, and used, `on_gl_thread`.

    Raises:
        BackendError: there is none; it names the packages that bring one.
    """
    with optional_import("the backend osmesa draws by moderngl", "sparklod[render]", BackendError):
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
