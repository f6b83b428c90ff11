"""sparklod's own JSON of cameras or of keyframes; docs/cameras.md describes it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from ...system.errors import CameraPathError
from ..camera import Matrix
from ..frame import NO_LENS, Frame, Intrinsics, Settings
from ..generators import Key, between, frame_looking
from .source import Files, Json, Parsed, brief, posed, side
from .table import Axes

FORMAT, VERSION = "sparklod-camera-path", 1


def recognises(files: Files) -> bool:
    """Return whether its field format says so."""
    return files.json is not None and files.json.has("format") and files.json.value["format"] == FORMAT


def parse(files: Files, settings: Settings) -> Parsed:
    """Return its frames, or those between its keyframes."""
    root = files.object()
    if root.has("version") and root.get("version").value != VERSION:
        raise CameraPathError(f"version {brief(root.value['version'])} is unknown, only {VERSION} is read")
    lens = _lens(root, NO_LENS)
    fps = root.get("fps").number() if root.has("fps") else None
    if fps is not None and not fps > 0:
        raise CameraPathError("fps is not positive")
    if root.has("keyframes", "frames"):
        raise CameraPathError("it has frames and keyframes; give one of them")
    if root.has("keyframes"):
        keys = [_key(item) for item in root.get("keyframes").items()]
        frames = between(keys, settings.fps or fps, settings.up_axis, lens)
        return Parsed(frames, fps=fps, turned=all(key.up for key in keys))
    axes, items = _axes(root), list(root.get("frames").items())
    turned = all(item.has("up") or not item.has("eye") for item in items)
    return Parsed([_frame(item, lens, axes, settings) for item in items], fps=fps, turned=turned)


def _axes(root: Json) -> Axes:
    name = root.get("axes").text() if root.has("axes") else Axes.OPENGL_C2W.value
    try:
        return Axes(name)
    except ValueError:
        known = ", ".join(axes.value for axes in Axes)
        raise CameraPathError(f"axes {name[:20]!r} are unknown; use one of {known}") from None


def _frame(item: Json, default: Intrinsics, axes: Axes, settings: Settings) -> Frame:
    lens = _lens(item, default)
    time = item.get("time").number() if item.has("time") else None
    name = item.label("name")
    if item.has("eye"):
        up = item.get("up").numbers(3) if item.has("up") else settings.up_axis
        return frame_looking(item.get("eye").numbers(3), item.get("target").numbers(3), up, lens, time, name)
    return Frame(_matrix(item), lens, time, name, None if settings.axes else axes)


def _matrix(item: Json) -> Matrix:
    if item.has("matrix"):
        return np.array(item.get("matrix").matrix(4)).reshape(4, 4)
    x, y, z, w = item.get("quat_xyzw").numbers(4)
    return posed([w, x, y, z], item.get("position").numbers(3), item.way)


def _key(item: Json) -> Key:
    return Key(
        tuple(item.get("eye").numbers(3)),
        tuple(item.get("target").numbers(3)),
        tuple(item.get("up").numbers(3)) if item.has("up") else None,
        math.radians(item.get("fov").number()) if item.has("fov") else None,
        item.get("time").number() if item.has("time") else None,
    )


def _lens(item: Json, default: Intrinsics) -> Intrinsics:
    """Return the lens of an object, whose fields override those of the whole file."""
    size, focal, principal, fov = (item.first(key) for key in ("size", "focal", "principal", "fov"))
    if size is not None:
        width, height = (side(number, size.way) for number in size.numbers(2))
        default = dataclasses.replace(default, size=(width, height))
    if fov is not None:
        default = dataclasses.replace(default, fov=math.radians(fov.number()), focal=None)
    if focal is not None:
        default = dataclasses.replace(default, focal=focal.pair())
    if principal is not None:
        default = dataclasses.replace(default, principal=principal.pair())
    if (default.focal or default.principal) and not default.size:
        raise CameraPathError(f"{item.way or 'it'} has a focal length or a principal point in pixels, but no size")
    return default
