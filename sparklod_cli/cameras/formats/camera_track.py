"""The plain camera track of splat-transform: `{frameRate, frames: [{position, target, fov, up}]}`."""

from __future__ import annotations

import math

from ...system.errors import CameraPathError
from ..frame import Frame, Intrinsics, Settings
from ..generators import frame_looking
from .source import Files, Json, Parsed

UP = (0.0, 1.0, 0.0)


def recognises(files: Files) -> bool:
    """Return whether its frames have a position and a target."""
    frames = files.json.first("frames") if files.json else None
    items = frames.value if frames else None
    return isinstance(items, list) and bool(items) and Json(items[0]).has("position", "target")


def parse(files: Files, settings: Settings) -> Parsed:
    """Return its frames. The field of view is vertical, in degrees."""
    root = files.object()
    fps = root.get("frameRate").number() if root.has("frameRate") else None
    if fps is not None and not fps > 0:
        raise CameraPathError("frameRate is not positive")
    items = list(root.get("frames").items())
    turned = all(item.has("up") for item in items)
    return Parsed([_frame(item, settings.up or UP) for item in items], fps=fps, turned=turned)


def _frame(item: Json, up: tuple[float, ...]) -> Frame:
    lens = Intrinsics(fov=math.radians(item.get("fov").number())) if item.has("fov") else Intrinsics()
    up_axis = item.get("up").numbers(3) if item.has("up") else up
    return frame_looking(item.get("position").numbers(3), item.get("target").numbers(3), up_axis, lens)
