"""The backend `open3d`: fast previews with the material `gaussianSplat` of Open3D 0.20, on any device with Vulkan 1.3.

Differences from the backend `numba`:

- Opacity is at most 1: a merged splat of linear opacity A > 1 becomes an opaque splat that is A ** (1 / 3) larger and
  has the same integral over space. `RasterSettings.profile` has no effect.
- Splats are sorted by depth; `RasterSettings.sort` has no effect.
- Colours are clamped to 1 before blending and have 8 bits, as does the picture. Alpha is computed from a picture on
  black and one on white.
- Quaternions have 8 bits, and the centre of a splat in the picture may be off by 1/16 of a pixel.
- The size of a splat in the picture is not limited; Spark limits it to 512 pixels.

Open3D draws in a separate process, because it ends its process when it fails. The process sends a message when it has
started, and an answer to each request on its standard input; it exits when that is closed. A message is a line of JSON
and, if its "array" is not null, the bytes of an array.

Splats of Open3D 0.20, from its sources (`GaussianSplatDataPacking.cpp`, and the shaders `gaussian_*.comp` in its
package), have linear scales, quaternions w x y z, opacity as a logit, and colour as the first spherical harmonic. It
stores scales and colours as float16, and quaternions as bytes. Its camera is OpenCV's, with the upper left corner of
the picture at 0, 0. It blends splats over the background without tone mapping.

Without merged splats pictures agree with `numba`, sorted by depth, to 50 dB and more; with many, to 20 to 35 dB.
Pictures are drawn in pieces, see `PIECE`, which takes ten times as long or more in software.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..model.falloff import MAX_STD_DEV, MIN_ALPHA
from ..model.gaussian import linear_opacity
from ..model.sh import SH_C0
from ..system.errors import BackendError
from ..system.machine import pip_install
from ..system.python_process import module_command
from .rasterizer import Image, ShadedSplats
from .render_settings import BLUR, CLIP, RasterSettings

Array = NDArray[Any]

#: Columns of the splats of a request: centre, scale, quaternion w x y z, logit of opacity, first spherical harmonics.
COLUMNS = 14

#: Sides in pixels of a tile, by which Open3D bins splats, and of the largest picture, which is small because Open3D
#: stores screen positions as float16. Pictures are squares of 2 ** n tiles, because Open3D lacks a barrier otherwise,
#: and of at most 256 tiles, because it drops splats that touch more.
TILE, PIECE = 16, 256

#: Tiles that Open3D allocates per splat; it drops further ones. Version 0.20 ignores the setting of its material.
TILES_A_SPLAT = 32

#: An invisible splat, at the position of the camera.
NOWHERE = np.array([0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 9, 0, 0, 0], np.float32)

#: First version of Open3D that draws splats.
VERSION = "0.20"

#: Words in Open3D's warning, printed once, that it has dropped splats.
LEFT_OUT = "dropped", "culled"

#: Debian and Ubuntu packages of the libraries that Open3D loads; the last one renders in software.
PACKAGES = "libegl1 libgl1 libusb-1.0-0 libvulkan1 mesa-vulkan-drivers"

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


def _split(
    camera: Camera, low: Array, high: Array, most: int
) -> Iterator[tuple[tuple[int, int, int], NDArray[np.intp], int]]:
    """Yield squares that cover the splats of a picture: left, top and side; their splats; pairs of splat and tile.

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
    """Return the command line of the process that runs `main`."""
    return module_command(__name__)


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


# The process in which Open3D draws


def send(file: IO[bytes], message: dict[str, Any], array: Array | None = None) -> None:
    """Write a message and an optional array."""
    # .npy would need a seekable file.
    about = None if array is None else {"type": array.dtype.str, "shape": array.shape}
    file.write(json.dumps({**message, "array": about}).encode() + b"\n")
    if array is not None:
        file.write(np.ascontiguousarray(array).data.cast("B"))
    file.flush()


def receive(file: IO[bytes]) -> tuple[dict[str, Any], Array | None]:
    """Read a message and its array; raise `EOFError` if the other process has ended."""
    line = file.readline()
    if not line.endswith(b"\n"):
        raise EOFError
    message = json.loads(line)
    if message["array"] is None:
        return message, None
    array = np.empty(message["array"]["shape"], message["array"]["type"])
    if cast(io.BufferedReader, file).readinto(array.data.cast("B")) != array.nbytes:
        raise EOFError
    return message, array


class _Log(io.TextIOBase):
    """Standard output of Python in this process, with Open3D's messages."""

    text = ""

    def write(self, text: str) -> int:
        self.text += text
        sys.stderr.write(text)
        return len(text)


class Painter:
    """Open3D's renderer; `RuntimeError`, with the reason, if it cannot draw splats here."""

    def __init__(self, log: _Log) -> None:
        self._log = log
        self._renderers: dict[int, Any] = {}
        try:
            import open3d
        except ModuleNotFoundError as error:
            raise RuntimeError(
                f"it needs the package {error.name}, which is not installed: {pip_install(f'open3d>={VERSION}')}"
            ) from None
        except (ImportError, OSError) as error:
            reason = " ".join(str(error).split())
            advice = f"on Debian and Ubuntu: apt install {PACKAGES}"
            raise RuntimeError(f"Open3D does not load: {reason} ({advice})") from None
        self._open3d = open3d
        self._material = open3d.visualization.rendering.MaterialRecord()
        if not hasattr(self._material, "gaussian_splat_antialias"):
            upgrade = pip_install(f"open3d>={VERSION}", options=["--upgrade"])
            raise RuntimeError(f"Open3D {open3d.__version__} cannot draw splats: {upgrade}")
        self._material.shader = "gaussianSplat"
        self._material.gaussian_splat_sh_degree = 0
        self._material.gaussian_splat_antialias = True

    def probe(self) -> None:
        """Draw a splat; raise `RuntimeError` if nothing is drawn, as Open3D does without a Vulkan device."""
        splat = np.array([[0.0, 0.0, 1.0, 0.2, 0.2, 0.2, 1.0, 0.0, 0.0, 0.0, 9.0, -1.7, 1.7, -1.7]], np.float32)
        request = {
            "side": 32,
            "intrinsic": [[16.0, 0.0, 16.5], [0.0, 16.0, 16.5], [0.0, 0.0, 1.0]],
            "rotation": np.eye(3).tolist(),
            "range": [0.1, 10.0],
            "entries": 4,
        }
        on_black, on_white = self.draw(request, splat)
        red, green, blue = on_black[16, 16]
        if green < 200 or red > 50 or blue > 50 or on_white[0, 0].min() < 250:
            raise RuntimeError(
                f"Open3D draws no splats here without Vulkan 1.3 (on Debian and Ubuntu: apt install {PACKAGES})"
            )

    def draw(self, request: dict[str, Any], splats: Array) -> Array:
        """Return (2, side, side, 3) uint8, the picture on black and on white; `RuntimeError` if Open3D drops splats.

        Args:
            request: "side" of the picture; "intrinsic", (3, 3); "rotation", (3, 3) world to camera, with y down,
                looking along z from the origin; "range", near and far distance; "entries", an upper bound of the number
                of pairs of a splat and a tile that it touches.
            splats: (N, COLUMNS) float32.
        """
        side = request["side"]
        renderer = self._renderer(side)
        scene = renderer.scene
        missing = -(-request["entries"] // TILES_A_SPLAT) - len(splats)
        if missing > 0:
            splats = np.concatenate([splats, np.tile(NOWHERE, (missing, 1))])
        scene.clear_geometry()
        scene.add_geometry("splats", self._cloud(splats), self._material, False)
        intrinsic, extrinsic = np.array(request["intrinsic"]), np.eye(4)
        extrinsic[:3, :3] = request["rotation"]
        renderer.setup_camera(intrinsic, extrinsic, side, side)
        # Repeated, because setup_camera chooses near and far from the bounding boxes in the scene.
        scene.camera.set_projection(intrinsic, *request["range"], side, side)
        pictures = []
        for background in (0.0, 1.0):
            scene.set_background(np.array([background, background, background, 1], np.float32))
            pictures.append(np.array(renderer.render_to_image()))
        if any(word in self._log.text for word in LEFT_OUT):
            raise RuntimeError("Open3D has dropped splats, because too many overlap on the picture")
        return np.stack(pictures)

    def _renderer(self, side: int) -> Any:
        if side not in self._renderers:
            renderer = self._open3d.visualization.rendering.OffscreenRenderer(side, side)
            # Disables tone mapping and dithering, which would change the background.
            renderer.scene.view.set_post_processing(False)
            self._renderers[side] = renderer
        return self._renderers[side]

    def _cloud(self, splats: Array) -> Any:
        places = {"scale": (3, 6), "rot": (6, 10), "opacity": (10, 11), "f_dc": (11, 14)}
        cloud = self._open3d.t.geometry.PointCloud(self._open3d.core.Tensor(splats[:, :3].copy()))
        for name, (first, end) in places.items():
            cloud.point[name] = self._open3d.core.Tensor(splats[:, first:end].copy())
        return cloud


def main() -> None:
    """Answer requests until standard input is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles it and closes the input
    answers, requests = os.fdopen(os.dup(1), "wb"), sys.stdin.buffer
    os.dup2(2, 1)  # libraries print to descriptor 1
    sys.stdout = log = _Log()
    try:
        painter = Painter(log)
        painter.probe()
    except RuntimeError as error:
        send(answers, {"error": str(error)})
    else:
        send(answers, {})
        while True:
            try:
                request, splats = receive(requests)
            except EOFError:
                break
            try:
                assert splats is not None
                pictures = painter.draw(request, splats)
            except Exception as error:
                send(answers, {"error": " ".join(str(error).split())})
            else:
                send(answers, {}, pictures)
    os._exit(0)  # without Open3D's destructors, which may crash


if __name__ == "__main__":
    main()
