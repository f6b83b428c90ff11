"""sparklod's own files: JSON of cameras or keyframes, and CSV of a camera per row; docs/cameras.md describes both."""

from __future__ import annotations

import csv
import dataclasses
import math

import numpy as np

from ..system.errors import CameraPathError
from ..system.untrusted import quoted_value
from .camera import NO_LENS, Frame, Intrinsics, Settings, frame_looking
from .camera_files import CameraJson, Files, Parsed, finite, posed, side
from .camera_formats import Axes
from .sources import Key, between

FORMAT, VERSION = "sparklod-camera-path", 1

POSITION, QUAT, TARGET = ("x", "y", "z"), ("qx", "qy", "qz", "qw"), ("target_x", "target_y", "target_z")
UP, SIZE = ("up_x", "up_y", "up_z"), ("width", "height")
COLUMNS = {*POSITION, *QUAT, *TARGET, *UP, *SIZE, "time", "fov", "name"}


def recognises_sparklod(files: Files) -> bool:
    """Return whether its field format says so."""
    return files.json is not None and files.json.has("format") and files.json.value["format"] == FORMAT


def parse_sparklod(files: Files, settings: Settings) -> Parsed:
    """Return its frames, or those between its keyframes."""
    root = files.object()
    if root.has("version") and root.value["version"] != VERSION:
        raise CameraPathError(f"version {quoted_value(root.value['version'])} is unknown, only {VERSION} is read")
    lens = _lens(root, NO_LENS)
    fps = root.optional("fps", CameraJson.positive)
    if root.has("keyframes", "frames"):
        raise CameraPathError("it has frames and keyframes; give one of them")
    if root.has("keyframes"):
        keys = [_key(item) for item in root.items("keyframes")]
        frames, count = between(keys, settings.fps or fps, settings.up_axis, lens)
        return Parsed(frames, fps=fps, turned=all(key.up for key in keys), count=count)
    name = root.optional("axes", CameraJson.text, Axes.OPENGL_C2W.value)
    try:
        axes = Axes(name)
    except ValueError:
        known = ", ".join(axes.value for axes in Axes)
        raise CameraPathError(f"axes {name[:20]!r} are unknown; use one of {known}") from None
    items = list(root.items("frames"))
    turned = all(item.has("up") or not item.has("eye") for item in items)
    return Parsed([_frame(item, lens, axes, settings) for item in items], fps=fps, turned=turned)


def _frame(item: CameraJson, default: Intrinsics, axes: Axes, settings: Settings) -> Frame:
    lens = _lens(item, default)
    time, name = item.optional("time", CameraJson.number), item.label("name")
    if item.has("eye"):
        up = item.get("up").numbers(3) if item.has("up") else settings.up_axis
        return frame_looking(item.get("eye").numbers(3), item.get("target").numbers(3), up, lens, time, name)
    if item.has("matrix"):
        matrix = np.array(item.get("matrix").matrix(4)).reshape(4, 4)
    else:
        x, y, z, w = item.get("quat_xyzw").numbers(4)
        matrix = posed([w, x, y, z], item.get("position").numbers(3), item.place or "it")
    return Frame(matrix, lens, time, name, None if settings.axes else axes)


def _key(item: CameraJson) -> Key:
    return Key(
        tuple(item.get("eye").numbers(3)),
        tuple(item.get("target").numbers(3)),
        item.optional("up", lambda up: tuple(up.numbers(3))),
        item.optional("fov", lambda fov: math.radians(fov.number())),
        item.optional("time", CameraJson.number),
    )


def _lens(item: CameraJson, default: Intrinsics) -> Intrinsics:
    """Return the lens of an object, whose fields override those of the whole file."""
    if item.has("size"):
        item.get("size").pair()
        width, height = (each.side() for each in item.items("size"))
        default = dataclasses.replace(default, size=(width, height))
    if item.has("fov"):
        default = dataclasses.replace(default, fov=math.radians(item.number("fov")), focal=None)
    if item.has("focal"):
        default = dataclasses.replace(default, focal=item.get("focal").pair())
    if item.has("principal"):
        default = dataclasses.replace(default, principal=item.get("principal").pair())
    if (default.focal or default.principal) and not default.size:
        raise item.error("a focal length or a principal point in pixels needs a size")
    return default


def recognises_csv(files: Files) -> bool:
    """Return whether its first line names the columns of a pose."""
    names = set(_names((files.text or "").split("\n", 1)[0]))
    return names >= {*POSITION, *QUAT} or names >= {*POSITION, *TARGET}


def _names(line: str) -> list[str]:
    return [name.strip().lower() for name in line.split(",")]


def resembles_csv(files: Files) -> bool:
    """Return whether it looks like a failed attempt: it is named .csv, or its first line names some of the columns."""
    names = _names((files.text or "").split("\n", 1)[0])
    return files.path.suffix.lower() == ".csv" or len(COLUMNS.intersection(names)) > 1


def parse_csv(files: Files, settings: Settings) -> Parsed:
    """Parse a camera per row, with named columns."""
    lines = files.lines() or [""]
    names = _names(lines[0])
    if not recognises_csv(files):
        missing = min(([name for name in POSITION + way if name not in names] for way in (TARGET, QUAT)), key=len)
        raise CameraPathError(
            f"its first line, which names the columns, lacks {', '.join(missing)}; a camera needs"
            f" {', '.join(POSITION)}, and {', '.join(TARGET)} or {', '.join(QUAT)}"
        )
    if len(set(names)) < len(names):
        raise CameraPathError("its first line names a column twice")
    frames = []
    try:
        for number, row in enumerate(csv.reader(lines[1:]), 2):
            if row:
                frames.append(_row_frame(row, names, f"line {number}", settings))
    except csv.Error as error:
        raise CameraPathError(f"it is not CSV: {error}") from None
    unknown = sorted(set(names) - COLUMNS)
    notes = (f"Unknown columns were ignored: {', '.join(unknown)}.",) if unknown else ()
    return Parsed(frames, notes, turned=TARGET[0] not in names)


def _row_frame(row: list[str], names: list[str], way: str, settings: Settings) -> Frame:
    if len(row) != len(names):
        raise CameraPathError(f"{way} has {len(row)} values, not {len(names)}")
    values = {name: value.strip() for name, value in zip(names, row, strict=True) if value.strip()}

    def numbers(columns: tuple[str, ...]) -> list[float]:
        return [finite(values.get(column, ""), f"{column} of {way}") for column in columns]

    def maybe(column: str) -> float | None:
        return numbers((column,))[0] if column in values else None

    fov, time = maybe("fov"), maybe("time")
    width, height = (side(number, way) for number in numbers(SIZE)) if "width" in values else (None, None)
    size = (width, height) if width and height else None
    lens = Intrinsics(size, fov=None if fov is None else math.radians(fov))
    name = values.get("name", "")
    if QUAT[0] not in values:
        up = numbers(UP) if UP[0] in values else settings.up_axis
        return frame_looking(numbers(POSITION), numbers(TARGET), up, lens, time, name)
    x, y, z, w = numbers(QUAT)
    return Frame(posed([w, x, y, z], numbers(POSITION), way), lens, time, name)
