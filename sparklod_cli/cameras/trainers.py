"""Camera files of trainers and trackers.

They are nerfstudio's camera paths, transforms.json of datasets, Inria's cameras.json, Open3D's
PinholeCameraTrajectory, as .json and .log, and trajectories of the TUM benchmark and evo.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from ..system.errors import CameraPathError
from ..system.untrusted import Origin
from .camera import NO_LENS, Frame, Intrinsics, Settings, pose
from .camera_files import CameraJson, Files, Parsed

#: The camera types of nerfstudio's paths that are read as pinhole cameras.
PINHOLES = ("perspective", "fisheye")

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

#: Values of these without an effect. Others need not be numbers, as distortion is ignored.
UNDISTORTED = (0, "", "0", "0.0")

#: Beginnings of the names of camera models that a pinhole camera cannot replace.
PANORAMAS = ("EQUIRECTANGULAR", "OMNIDIRECTIONAL", "VR180")


def recognises_nerfstudio(files: Files) -> bool:
    """Return whether the file has a camera_path."""
    return files.json is not None and files.json.has("camera_path")


def parse_nerfstudio(files: Files, settings: Settings) -> Parsed:
    """Parse a path that nerfstudio's viewer saved. Keyframes are ignored: the frames are interpolated from them."""
    root = files.object()
    kind = root.optional("camera_type", CameraJson.text, PINHOLES[0])
    if kind not in PINHOLES:
        raise CameraPathError(f"its camera_type {kind[:20]!r} is not that of a pinhole camera")
    size = None
    if root.has("render_width", "render_height"):
        size = root.get("render_width").side(), root.get("render_height").side()

    def frame(item: CameraJson) -> Frame:
        degrees = item.optional("fov", CameraJson.number)  # vertical, as in three.js; the aspect is that of the size
        fov = None if degrees is None else math.radians(degrees)
        return Frame(item.get("camera_to_world").matrix_4x4(), Intrinsics(size, fov=fov))

    frames = list(map(frame, root.items("camera_path")))
    fps = root.optional("fps", CameraJson.number, 0.0)
    notes = ("Its fisheye cameras are read as pinhole cameras.",) if kind == "fisheye" else ()
    return Parsed(frames, notes, fps if fps > 0 else None)


def recognises_transforms(files: Files) -> bool:
    """Return whether its frames have a transform_matrix."""
    root = files.json
    return root is not None and root.has("frames") and root.get("frames").first_has("transform_matrix")


def parse_transforms(files: Files, settings: Settings) -> Parsed:
    """Parse a dataset of nerfstudio, Instant NGP or the original NeRF; frames are in the order of the file."""
    root = files.object()
    items = list(root.items("frames"))
    notes = []
    model = root.label("camera_model")
    if model.startswith(PANORAMAS):
        raise CameraPathError(f"its camera_model {model[:24]!r} is not that of a pinhole camera")
    if any(place.has(key) and place.value[key] not in UNDISTORTED for place in (root, *items) for key in DISTORTION):
        notes.append("Its lens distortion was ignored.")
    if root.has("applied_transform"):
        notes.append("Its applied_transform was not undone.")
    frames = []
    for item in items:
        matrix = item.get("transform_matrix").matrix_4x4(3, 4)
        frames.append(Frame(matrix, _lens(item, root), name=item.label("file_path")))
    return Parsed(frames, tuple(notes))


def _lens(item: CameraJson, root: CameraJson) -> Intrinsics:
    """Return the lens of a frame: each value is that of the frame, or else of the whole file."""

    def number(key: str) -> float | None:
        return (item if item.has(key) else root).optional(key, CameraJson.number)

    width, height = ((item if item.has(key) else root).optional(key, CameraJson.side) for key in ("w", "h"))
    angle_x, angle_y = number("camera_angle_x"), number("camera_angle_y")
    fov, along = (angle_x, "x") if angle_x is not None else (angle_y, "y")
    if width is None or height is None:
        return Intrinsics(fov=fov, fov_along=along)
    fx, fy = number("fl_x"), number("fl_y")
    fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
    focal = (fx, fy) if fx is not None and fy is not None else None
    cx, cy = number("cx"), number("cy")
    principal = (cx, cy) if cx is not None and cy is not None else None
    return Intrinsics((width, height), focal, principal, fov, along)


def recognises_inria(files: Files) -> bool:
    """Return whether the file is a list of positions and rotations."""
    return files.json is not None and files.json.first_has("position", "rotation")


def parse_inria(files: Files, settings: Settings) -> Parsed:
    """Parse the cameras.json beside the splats; cameras are in the order of the file, test cameras first."""
    frames = []
    for item in files.object().items():
        rotation = np.array(item.get("rotation").matrix(3, columns=3)).reshape(3, 3)
        lens = Intrinsics()
        if item.has("width", "height"):
            size = item.get("width").side(), item.get("height").side()
            lens = Intrinsics(size, (item.number("fx"), item.number("fy")) if item.has("fx", "fy") else None)
        frames.append(Frame(pose(rotation, item.get("position").numbers(3)), lens, name=item.label("img_name")))
    return Parsed(frames)


CLASS = "PinholeCameraTrajectory"

#: Lines of a pose in a .log file: three whole numbers, and a camera-to-world matrix.
LOG_LINES = 5

#: Open3D's pixel coordinates are whole numbers at the centres of pixels, ours at their corners.
HALF = 0.5

#: Numbers of a line of a TUM trajectory.
COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


def recognises_open3d(files: Files) -> bool:
    """Return whether the file is JSON of that class, or begins with three whole numbers and a row of four."""
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
    for number, words in _rows(lines):
        row = CameraJson(words, Origin(f"line {number}", CameraPathError))
        rows.append(row.numbers(4 if len(rows) % LOG_LINES else 3))
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
        row = CameraJson.of_row(COLUMNS, words, f"line {line}")
        time, *position, x, y, z, w = map(row.number, COLUMNS)
        frames.append(Frame(row.pose([w, x, y, z], position), time=time))
    return Parsed(frames)


def _rows(lines: list[str]) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(lines, 1):
        words = line.replace(",", " ").split()
        if words and not words[0].startswith("#"):
            yield number, words
