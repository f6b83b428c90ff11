"""transforms.json: datasets of nerfstudio, Instant NGP and the original NeRF."""

from __future__ import annotations

import numpy as np

from ...system.errors import CameraPathError
from ..frame import Frame, Intrinsics, Settings
from .source import Files, Json, Parsed

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

#: Values of these without an effect. Others need not be numbers, as distortion is ignored.
UNDISTORTED = (0, "", "0", "0.0")

#: Beginnings of the names of camera models that a pinhole camera cannot replace.
PANORAMAS = ("EQUIRECTANGULAR", "OMNIDIRECTIONAL", "VR180")


def recognises(files: Files) -> bool:
    """Return whether its frames have a transform_matrix."""
    frames = files.json.first("frames") if files.json else None
    items = frames.value if frames else None
    return isinstance(items, list) and bool(items) and Json(items[0]).has("transform_matrix")


def parse(files: Files, settings: Settings) -> Parsed:
    """Return its frames, in the order of the file."""
    root = files.object()
    items = list(root.get("frames").items())
    notes = []
    model = root.label("camera_model")
    if model.startswith(PANORAMAS):
        raise CameraPathError(f"its camera_model {model[:24]!r} is not that of a pinhole camera")
    if any(place.has(key) and place.value[key] not in UNDISTORTED for place in (root, *items) for key in DISTORTION):
        notes.append("Its lens distortion was ignored.")
    if root.has("applied_transform"):
        notes.append("Its applied_transform was not undone.")
    return Parsed([_frame(item, root) for item in items], tuple(notes))


def _frame(item: Json, root: Json) -> Frame:
    matrix = np.array([*item.get("transform_matrix").matrix(3, 4), 0, 0, 0, 1][:16]).reshape(4, 4)
    return Frame(matrix, _lens(item, root), name=item.label("file_path"))


def _lens(item: Json, root: Json) -> Intrinsics:
    """Return the lens of a frame: each value is that of the frame, or else of the whole file."""

    def number(key: str) -> float | None:
        place = item if item.has(key) else root
        return place.get(key).number() if place.has(key) else None

    def side(key: str) -> int | None:
        place = item if item.has(key) else root
        return place.get(key).side() if place.has(key) else None

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
