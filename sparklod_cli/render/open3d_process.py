"""Draws splats with Open3D in a separate process, because Open3D ends its process when it fails.

The process sends a message when it has started, and an answer to each request on its standard input; it exits when that
is closed. A message is a line of JSON and, if its "array" is not null, the bytes of an array.

Splats of Open3D 0.20, from its sources (`GaussianSplatDataPacking.cpp`, and the shaders `gaussian_*.comp` in its
package), have linear scales, quaternions w x y z, opacity as a logit, and colour as the first spherical harmonic. It
stores scales and colours as float16, and quaternions as bytes. Its camera is OpenCV's, with the upper left corner of
the picture at 0, 0. It blends splats over the background without tone mapping.
"""

from __future__ import annotations

import io
import json
import os
import signal
import sys
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from ..system.machine import pip_install

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

Array = NDArray[Any]


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
        """Draw a splat, because Open3D silently draws nothing without a Vulkan device; then raise `RuntimeError`."""
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
