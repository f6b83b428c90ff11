"""Trajectories: Open3D's PinholeCameraTrajectory, as .json and .log, and those of the TUM benchmark and evo."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...system.errors import CameraPathError
from ..frame import NO_LENS, Frame, Intrinsics, Settings
from .source import Files, Parsed, finite, posed

CLASS = "PinholeCameraTrajectory"

#: Lines of a pose in a .log file: three whole numbers, and a camera-to-world matrix.
LOG_LINES = 5

#: Open3D's pixel coordinates are whole numbers at the centres of pixels, ours at their corners.
HALF = 0.5

#: Numbers of a line of a TUM trajectory.
COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


def recognises_open3d(files: Files) -> bool:
    """Return whether it is JSON of that class, or begins with three whole numbers and a row of four."""
    if files.json is not None:
        return files.json.has("class_name") and files.json.value["class_name"] == CLASS
    rows = [line.split() for line in (files.text or "").split("\n", 2)[:2]]
    try:
        return len(rows) == 2 and len(list(map(int, rows[0]))) == 3 and len(list(map(float, rows[1]))) == 4
    except ValueError:
        return False


def parse_open3d(files: Files, settings: Settings) -> Parsed:
    """Parse a trajectory; a .log has no lenses."""
    if files.json is None and files.path.suffix.lower() != ".json":
        return Parsed(_frames_of_log(files.lines()))
    root, frames = files.object(), []
    if not recognises_open3d(files):
        raise CameraPathError(f"it is not a {CLASS}")
    for camera in root.items("parameters"):
        extrinsic, intrinsic = camera.get("extrinsic").numbers(16), camera.get("intrinsic")  # column by column
        fx, _, _, _, fy, _, x, y, _ = intrinsic.get("intrinsic_matrix").numbers(9)
        size = intrinsic.get("width").side(), intrinsic.get("height").side()
        lens = Intrinsics(size, (fx, fy), (x + HALF, y + HALF))
        frames.append(Frame(np.array(extrinsic).reshape(4, 4).T, lens))
    return Parsed(frames)


def _frames_of_log(lines: list[str]) -> list[Frame]:
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split()
        count = 4 if len(rows) % LOG_LINES else 3
        if len(words) != count:
            raise CameraPathError(f"line {number} has {len(words)} numbers, not {count}")
        rows.append([finite(word, f"line {number}") for word in words])
    if len(rows) % LOG_LINES:
        raise CameraPathError("it ends inside a pose")
    poses = [np.array(rows[at + 1 : at + LOG_LINES]) for at in range(0, len(rows), LOG_LINES)]
    try:
        with np.errstate(all="ignore"):
            return [Frame(np.linalg.inv(pose), NO_LENS) for pose in poses]  # extrinsics, as in a .json
    except np.linalg.LinAlgError:
        raise CameraPathError("it has a matrix that cannot be inverted") from None


def recognises_tum(files: Files) -> bool:
    """Return whether its first line that is not a comment has eight numbers."""
    words = next(_rows((files.text or "").splitlines()), (0, []))[1]
    try:
        return len([float(word) for word in words]) == len(COLUMNS)
    except ValueError:
        return False


def parse_tum(files: Files, settings: Settings) -> Parsed:
    """Parse a pose per line: `timestamp tx ty tz qx qy qz qw`."""
    frames = []
    for line, words in _rows(files.lines()):
        way = f"line {line}"
        if len(words) != len(COLUMNS):
            raise CameraPathError(f"{way} has {len(words)} values, not {' '.join(COLUMNS)}")
        time, *position, x, y, z, w = (
            finite(each, f"{name} of {way}") for name, each in zip(COLUMNS, words, strict=True)
        )
        frames.append(Frame(posed([w, x, y, z], position, way), time=time))
    return Parsed(frames)


def _rows(lines: list[str]) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(lines, 1):
        words = line.replace(",", " ").split()
        if words and not words[0].startswith("#"):
            yield number, words
