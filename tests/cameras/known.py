"""The cameras of fixtures/camera_files.py as they are in the world, worked out by hand; and what reads them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera, Settings
from sparklod_cli.cameras.camera_files import Files, read
from sparklod_cli.cameras.camera_formats import NAMES
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.io.files import read_together
from tests.conftest import FIXTURES

FOLDER = FIXTURES / "cameras"

#: x, y, z in the world.
Vector = tuple[float, float, float]


class Known(NamedTuple):
    """A camera: where it is, and what is to its right, below, and ahead, unit vectors."""

    position: Vector
    right: Vector
    down: Vector
    ahead: Vector
    landmark: tuple[float, float]


#: A point of the world; each camera has the pixel at which it sees it.
LANDMARK = (0.5, -0.25, 1.0)

KNOWN = (
    Known((0, 0, -5), (1, 0, 0), (0, 1, 0), (0, 0, 1), (370.0, 215.0)),
    Known((3, -0.5, -3), (0.8, 0, 0.6), (0, 1, 0), (-0.6, 0, 0.8), (371.0638298, 271.9148936)),
    Known((2.5, 3, -2), (0.8, 0, 0.6), (-0.36, 0.8, 0.48), (-0.48, -0.6, 0.64), (344.8447205, 185.3416149)),
    Known((-3, -2, -1), (-0.6, 0.64, 0.48), (0, -0.6, 0.8), (0.8, 0.48, 0.36), (317.2477064, 315.6880734)),
)

SIZE, FOCAL = (640, 480), 600.0
FOV_Y = 2 * math.atan(240 / 600)

#: From OpenCV's axes to OpenGL's.
HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])

#: Out of the world of SuperSplat and splat-transform: half a turn about z.
OUT_OF_PLAYCANVAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def files_at(path: Path) -> Files:
    """A camera path's files, as the command line reads them."""
    return Files(path, read_together(path, NAMES, 1 << 20))


def read_fixture(name: str, settings: Settings | None = None, *, format: str | None = None) -> CameraPath:
    """A file, or folder, of fixtures/cameras."""
    return read(files_at(FOLDER / name), format=format, settings=settings)


def text_file(text: str | bytes, name: str = "path.json") -> Files:
    """A file that is on no disk."""
    return Files(Path(name), {name: text.encode() if isinstance(text, str) else text})


def read_json(root: Any, settings: Settings | None = None) -> CameraPath:
    """The cameras of a JSON file."""
    return read(text_file(json.dumps(root)), settings=settings)


def pixel(camera: Camera, point: Vector) -> NDArray[np.float64]:
    """(2,) where a camera sees a point: that of OpenGL's axes, by the textbook."""
    x, y, z, _ = np.linalg.inv(camera.camera_to_world) @ [*point, 1.0]
    assert z < 0, "the point is behind the camera"
    fx, fy = camera.focal
    cx, cy = camera.principal
    return np.array([cx + fx * x / -z, cy - fy * y / -z])


def check_pose(camera: Camera, known: Known, tolerance: float = 1e-6) -> None:
    """A camera is where it should be, and looks where it should."""
    right, up, back, position = camera.camera_to_world[:3].T
    assert np.allclose(position, known.position, atol=tolerance)
    assert np.allclose(right, known.right, atol=tolerance)
    assert np.allclose(-up, known.down, atol=tolerance)
    assert np.allclose(-back, known.ahead, atol=tolerance)
    assert camera.camera_to_world[3].tolist() == [0, 0, 0, 1]
