"""Camera files of trainers: nerfstudio's camera paths, transforms.json of datasets, and Inria's cameras.json."""

from __future__ import annotations

import math

import numpy as np

from ...system.errors import CameraPathError
from ..frame import Frame, Intrinsics, Settings
from ..pose import pose
from .source import CameraJson, Files, Parsed

#: The camera types of nerfstudio's paths that are read as pinhole cameras.
PINHOLES = ("perspective", "fisheye")

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

#: Values of these without an effect. Others need not be numbers, as distortion is ignored.
UNDISTORTED = (0, "", "0", "0.0")

#: Beginnings of the names of camera models that a pinhole camera cannot replace.
PANORAMAS = ("EQUIRECTANGULAR", "OMNIDIRECTIONAL", "VR180")


def recognises_nerfstudio(files: Files) -> bool:
    """Return whether it has a camera_path."""
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
        matrix = np.array(item.get("camera_to_world").matrix(4)).reshape(4, 4)
        return Frame(matrix, Intrinsics(size, fov=None if degrees is None else math.radians(degrees)))

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
        matrix = np.array([*item.get("transform_matrix").matrix(3, 4), 0, 0, 0, 1][:16]).reshape(4, 4)
        frames.append(Frame(matrix, _lens(item, root), name=item.label("file_path")))
    return Parsed(frames, tuple(notes))


def _lens(item: CameraJson, root: CameraJson) -> Intrinsics:
    """Return the lens of a frame: each value is that of the frame, or else of the whole file."""

    def number(key: str) -> float | None:
        return (item if item.has(key) else root).optional(key, CameraJson.number)

    def side(key: str) -> int | None:
        return (item if item.has(key) else root).optional(key, CameraJson.side)

    width, height = side("w"), side("h")
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
    """Return whether it is a list of positions and rotations."""
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
