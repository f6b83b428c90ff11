"""Open3D's PinholeCameraTrajectory, as .json and .log, which Open3D itself reads.

Open3D accepts broken files: in place of a missing number it uses an earlier one, or whatever is in memory. So the file
is checked first.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np

from ...support.errors import CameraPathError
from ...support.optional import install_hint
from ..frame import NO_LENS, Frame, Intrinsics, Settings
from .source import Files, Parsed, finite, side

CLASS = "PinholeCameraTrajectory"

#: Lines of a pose in a .log file: three whole numbers, and a matrix.
LOG_LINES = 5

#: Open3D's pixel coordinates are whole numbers at the centres of pixels, ours at their corners.
HALF = 0.5


def recognises(files: Files) -> bool:
    """Return whether it is JSON of that class, or begins with three whole numbers and a row of four."""
    if files.json is not None:
        return files.json.has("class_name") and files.json.value["class_name"] == CLASS
    rows = [line.split() for line in (files.text or "").split("\n", 2)[:2]]
    try:
        return len(rows) == 2 and len(list(map(int, rows[0]))) == 3 and len(list(map(float, rows[1]))) == 4
    except ValueError:
        return False


def parse(files: Files, settings: Settings) -> Parsed:
    """Return its cameras; a .log has no lenses."""
    suffix = files.path.suffix.lower()
    if suffix == ".json":
        _check_json(files)
    elif suffix == ".log":
        _check_log(files)
    else:
        raise CameraPathError("Open3D recognizes its files by their suffix; rename it to .json or .log")
    open3d = load_open3d()
    with _quiet(open3d):
        trajectory = open3d.io.read_pinhole_camera_trajectory(str(files.path))
    return Parsed([_frame(camera, suffix == ".json") for camera in trajectory.parameters])


def _frame(camera: Any, has_lens: bool) -> Frame:
    lens = NO_LENS
    if has_lens:
        matrix = np.array(camera.intrinsic.intrinsic_matrix)
        size = side(camera.intrinsic.width, "width"), side(camera.intrinsic.height, "height")
        principal = float(matrix[0, 2]) + HALF, float(matrix[1, 2]) + HALF
        lens = Intrinsics(size, (float(matrix[0, 0]), float(matrix[1, 1])), principal)
    return Frame(np.array(camera.extrinsic), lens)


def _check_json(files: Files) -> None:
    root = files.object()
    if not recognises(files):
        raise CameraPathError(f"it is not a {CLASS}")
    for camera in root.get("parameters").items():
        camera.get("extrinsic").numbers(16)
        intrinsic = camera.get("intrinsic")
        intrinsic.get("intrinsic_matrix").numbers(9)
        intrinsic.get("width").side(), intrinsic.get("height").side()


def _check_log(files: Files) -> None:
    rows = [(number, line.split()) for number, line in enumerate(files.lines(), 1) if not line.startswith("#")]
    for index, (number, words) in enumerate(rows):
        count = 4 if index % LOG_LINES else 3
        if len(words) != count:
            raise CameraPathError(f"line {number} has {len(words)} numbers, not {count}")
        for word in words:
            finite(word, f"line {number}")
    if len(rows) % LOG_LINES:
        raise CameraPathError("it ends inside a pose")


def load_open3d() -> ModuleType:
    """Import Open3D; raise `CameraPathError` if it is not installed, or does not load."""
    try:
        import open3d
    except ModuleNotFoundError as error:
        raise CameraPathError(
            f"reading it takes the package {error.name}, which is not installed: {install_hint('render')}"
        ) from None
    except (ImportError, OSError) as error:
        reason = " ".join(str(error).split())
        raise CameraPathError(f"reading it takes Open3D, which does not load: {reason}") from None
    return open3d


@contextlib.contextmanager
def _quiet(open3d: Any) -> Iterator[None]:
    """Open3D prints warnings on standard output, where data go."""
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        yield
