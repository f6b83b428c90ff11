"""nerfstudio's camera paths, which its viewer saves in camera_paths/ and `ns-render camera-path` renders."""

from __future__ import annotations

import math

import numpy as np

from ...system.errors import CameraPathError
from ..frame import Frame, Intrinsics, Settings
from .source import Files, Json, Parsed

#: The camera types that are read as pinhole cameras.
PINHOLES = ("perspective", "fisheye")


def recognises(files: Files) -> bool:
    """Return whether it has a camera_path."""
    return files.json is not None and files.json.has("camera_path")


def parse(files: Files, settings: Settings) -> Parsed:
    """Return its frames. Keyframes are ignored, since the frames are interpolated from them already."""
    root = files.object()
    kind = root.get("camera_type").text() if root.has("camera_type") else PINHOLES[0]
    if kind not in PINHOLES:
        raise CameraPathError(f"its camera_type {kind[:20]!r} is not that of a pinhole camera")
    size = None
    if root.has("render_width", "render_height"):
        size = root.get("render_width").side(), root.get("render_height").side()
    frames = [_frame(item, size) for item in root.get("camera_path").items()]
    fps = root.get("fps").number() if root.has("fps") else 0
    notes = ("Its fisheye cameras are read as pinhole cameras.",) if kind == "fisheye" else ()
    return Parsed(frames, notes, fps if fps > 0 else None)


def _frame(item: Json, size: tuple[int, int] | None) -> Frame:
    """Return a frame, whose field of view is vertical, in degrees, as in three.js; its aspect is that of the size."""
    fov = math.radians(item.get("fov").number()) if item.has("fov") else None
    matrix = np.array(item.get("camera_to_world").matrix(4)).reshape(4, 4)
    return Frame(matrix, Intrinsics(size, fov=fov))
