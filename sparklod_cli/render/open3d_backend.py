"""The backend `open3d`: fast previews with the material `gaussianSplat` of Open3D 0.20, on any device with Vulkan 1.3.

Differences from the backend `numba`:

- Opacity is at most 1: a merged splat of linear opacity A > 1 becomes an opaque splat that is A ** (1 / 3) larger and
  has the same integral over space. `RasterSettings.profile` has no effect.
- Splats are sorted by depth; `RasterSettings.sort` has no effect.
- Colours are clamped to 1 before blending and have 8 bits, as does the picture. Alpha is computed from a picture on
  black and one on white.
- Quaternions have 8 bits, and the centre of a splat in the picture may be off by 1/16 of a pixel.
- The size of a splat in the picture is not limited; Spark limits it to 512 pixels.

Without merged splats pictures agree with `numba`, sorted by depth, to 50 dB and more; with many, to 20 to 35 dB.
Pictures are drawn in pieces, see `PIECE`, which takes ten times as long or more in software.
"""

from __future__ import annotations

import atexit
import contextlib
import re
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..model.falloff import MAX_STD_DEV, MIN_ALPHA
from ..model.gaussian import linear_opacity
from ..model.sh import SH_C0
from ..system.errors import BackendError
from ..system.python_process import module_command
from .open3d_process import COLUMNS, PACKAGES, PIECE, TILE, Array, receive, send
from .rasterizer import Image, ShadedSplats
from .render_settings import BLUR, CLIP, RasterSettings

#: Left, top and side of a piece of the picture, pixels.
Square = tuple[int, int, int]

#: Largest logit of opacity; its sigmoid is 1 in float16.
MOST_LOGIT = 12.0

#: Largest scale passed to Open3D, which stores float16: at most 65504, and exact to 1/1024 down to 6e-5.
MOST_SCALE = 2.0**12

#: Angle in radians by which the picture is rotated, too small to be visible. Open3D divides by 0 for a splat that is
#: wider than high and exactly axis-aligned, as in synthetic scenes, and draws black tiles.
ASKEW = 1e-5


def draw(shaded: ShadedSplats, camera: Camera, raster: RasterSettings) -> Image:
    """Draw the picture of a camera, see `rasterizer.draw`; `BackendError` if Open3D is missing, fails or crashes."""
    global _child
    image = np.zeros((camera.height, camera.width, 4), np.float32)
    with _LOCK:
        if _child is None or not _child.alive():
            _child = Child()
        for (left, top), request, splats in pieces(shaded, camera, raster, _child.most_entries):
            black, white = _child.ask(request, splats).astype(np.float32) / 255
            piece = image[top : top + request["side"], left : left + request["side"]]
            height, width = piece.shape[:2]
            piece[..., :3] = black[:height, :width]
            piece[..., 3] = np.clip(1 - (white - black).mean(axis=2)[:height, :width], 0, 1)
    return image


def pieces(
    shaded: ShadedSplats, camera: Camera, raster: RasterSettings, most_entries: int
) -> Iterator[tuple[tuple[int, int], dict[str, Any], Array]]:
    """Yield the pieces of a picture: left and top, the request to Open3D, and the splats that touch the piece.

    Splats that Spark would not draw are left out; positions are relative to the camera.
    """
    to_camera = (camera.camera_to_world[:3, :3] @ np.diag([1.0, -1.0, -1.0])).T
    away = shaded.center - camera.position  # float64, however far out the camera is
    at = away @ to_camera.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        from_axis = at[:, :2] / at[:, 2:] * camera.focal
        visible = (at[:, 2] > raster.near) & (at[:, 2] < raster.far) & (shaded.lod_opacity >= MIN_ALPHA)
        visible &= (np.abs(from_axis) <= CLIP / 2 * np.array([camera.width, camera.height])).all(axis=1)
        visible &= np.isfinite(shaded.scale).all(axis=1) & np.isfinite(shaded.rgb).all(axis=1)
    index = np.flatnonzero(visible)
    at, from_axis = at[index], from_axis[index]

    opacity = linear_opacity(shaded.lod_opacity[index])
    scale = shaded.scale[index] * np.cbrt(np.maximum(opacity, 1))[:, None]
    opacity = np.clip(opacity, None, 1 - 1e-7)
    unit = MOST_SCALE / max(float(scale.max(initial=0)), 1e-30)
    quat_wxyz = np.roll(shaded.quat_xyzw[index], 1, axis=1)
    splats = np.empty((len(index), COLUMNS), np.float32)
    splats[:, :3] = away[index] * unit
    splats[:, 3:6] = scale * unit
    # Open3D normalizes quaternions after rounding them to bytes; larger components keep one more bit.
    splats[:, 6:10] = quat_wxyz / np.abs(quat_wxyz).max(axis=1, keepdims=True)
    splats[:, 10] = np.minimum(np.log(opacity / (1 - opacity)), MOST_LOGIT)
    splats[:, 11:] = (shaded.rgb[index] - 0.5) / SH_C0

    # Upper bounds of the radii of splats, in pixels.
    slope = np.einsum("ij,ij->i", at, at) / at[:, 2] ** 2
    variance = (scale.max(axis=1) * max(camera.focal) / at[:, 2]) ** 2 * slope + BLUR
    half = MAX_STD_DEV * np.sqrt(variance)[:, None] + 2
    middle = from_axis + camera.principal
    low, high = middle - half, middle + half

    cos, sin = np.cos(ASKEW), np.sin(ASKEW)
    rotation = (np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ to_camera).tolist()
    (fx, fy), (cx, cy) = camera.focal, camera.principal
    for (left, top, side), touching, entries in _split(camera, low, high, most_entries):
        request = {
            "side": side,
            "intrinsic": [[fx, 0.0, cx - left], [0.0, fy, cy - top], [0.0, 0.0, 1.0]],
            "rotation": rotation,
            "range": [raster.near * unit, raster.far * unit],
            "entries": entries,
        }
        yield (left, top), request, splats[touching]


def _split(camera: Camera, low: Array, high: Array, most: int) -> Iterator[tuple[Square, NDArray[np.intp], int]]:
    """Yield squares that cover the splats of a picture, with their splats and numbers of pairs of splat and tile.

    `low` and `high`, (N, 2), are corners of boxes around splats, pixels. Squares with more than `most` pairs are
    divided, down to a tile.
    """
    squares = [(x, y, PIECE) for y in range(0, camera.height, PIECE) for x in range(0, camera.width, PIECE)]
    waiting = [(square, np.arange(len(low))) for square in reversed(squares)]
    while waiting:
        (left, top, side), index = waiting.pop()
        corner = np.array([left, top])
        index = index[(high[index] > corner).all(axis=1) & (low[index] < corner + side).all(axis=1)]
        if not index.size or left >= camera.width or top >= camera.height:
            continue
        first, last = (np.clip(edge[index] - corner, 0, side - 1) // TILE for edge in (low, high))
        entries = int((last - first + 1).prod(axis=1).sum())
        half = side // 2
        if entries > most and half >= TILE:
            waiting += [((left + x, top + y, half), index) for y in (half, 0) for x in (half, 0)]
        else:
            yield (left, top, side), index, entries


_LOCK = threading.Lock()
_child: Child | None = None

#: Time limits in seconds for starting the process, and for drawing a piece.
START_LIMIT, DRAW_LIMIT = 180.0, 300.0

#: Most pairs of splat and tile per request: the capacity of Open3D, and a limit for software rendering by an old Mesa.
#: Version 22.3.6 of Debian 12 sorts more than about 100,000 incorrectly, so that tiles are missing; 25.0.7 does not.
MOST_ENTRIES, MOST_ENTRIES_OF_OLD_MESA, NEW_MESA = 1 << 25, 1 << 15, 25


def command() -> list[str]:
    """Return the command line of the process in which Open3D draws."""
    return module_command(f"{__package__}.open3d_process")


class Child:
    """A process in which Open3D draws until this process ends; `BackendError` if it cannot draw here.

    `most_entries` is the maximum number of pairs of splat and tile per request.
    """

    def __init__(self) -> None:
        # A pipe would have to be read while the child writes.
        self._folder = tempfile.TemporaryDirectory(prefix="sparklod-", ignore_cleanup_errors=True)
        self._log = Path(self._folder.name, "log")
        try:
            with self._log.open("wb") as log:
                self._process = subprocess.Popen(command(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log)
        except OSError as error:
            self._folder.cleanup()
            raise BackendError(f"the process for Open3D does not start: {error}") from None
        atexit.register(self.close)
        self._answer(START_LIMIT, hint=f" (on Debian and Ubuntu: apt install {PACKAGES})")
        mesa = re.search(r"llvmpipe Mesa (\d+)", self._messages())
        self.most_entries = MOST_ENTRIES_OF_OLD_MESA if mesa and int(mesa[1]) < NEW_MESA else MOST_ENTRIES

    def alive(self) -> bool:
        return self._process.poll() is None

    def ask(self, request: dict[str, Any], splats: Array) -> Array:
        """Draw pictures, see `Painter.draw`; `BackendError` if Open3D crashes, takes too long or fails."""
        pictures = self._answer(DRAW_LIMIT, request, splats)
        assert pictures is not None
        return pictures

    def _answer(
        self, limit: float, request: dict[str, Any] | None = None, splats: Array | None = None, hint: str = ""
    ) -> Array | None:
        assert self._process.stdin is not None and self._process.stdout is not None
        too_late = threading.Event()

        def stop() -> None:  # which ends the wait below on every system
            too_late.set()
            self._process.kill()

        timer = threading.Timer(limit, stop)
        timer.daemon = True
        timer.start()
        try:
            if request is not None:
                send(self._process.stdin, request, splats)
            answer, array = receive(self._process.stdout)
        except (EOFError, OSError):
            if too_late.is_set():
                raise self._error(f"Open3D has not answered for {limit:g} seconds") from None
            raise self._error(f"Open3D has crashed: {self._last_message()}{hint}") from None
        except BaseException:  # the rest of this answer must not be read as the next one
            self.close()
            raise
        finally:
            timer.cancel()
        if "error" in answer:
            raise self._error(answer["error"])
        return array

    def _error(self, text: str) -> BackendError:
        self.close()
        return BackendError(text)

    def _messages(self) -> str:
        return re.sub(r"\x1b\[[0-9;]*m", "", self._log.read_text("utf-8", "replace"))

    def _last_message(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(10)
        lines = [line.strip() for line in self._messages().splitlines() if line.strip()]
        return lines[-1] if lines else f"exit code {self._process.returncode}"

    def close(self) -> None:
        """End the process, which exits when its input is closed."""
        atexit.unregister(self.close)
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(2)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._folder.cleanup()
