"""sparklod's own CSV: a camera per row, with named columns; docs/cameras.md lists them."""

from __future__ import annotations

import csv
import math
from collections.abc import Collection

from ...system.errors import CameraPathError
from ..frame import Frame, Intrinsics, Settings
from ..generators import frame_looking
from .source import Files, Parsed, finite, posed, side

POSITION, QUAT, TARGET = ("x", "y", "z"), ("qx", "qy", "qz", "qw"), ("target_x", "target_y", "target_z")
UP, SIZE = ("up_x", "up_y", "up_z"), ("width", "height")
COLUMNS = {*POSITION, *QUAT, *TARGET, *UP, *SIZE, "time", "fov", "name"}


def recognises(files: Files) -> bool:
    """Return whether its first line names the columns of a pose."""
    names = set(_names((files.text or "").split("\n", 1)[0]))
    return names >= {*POSITION, *QUAT} or names >= {*POSITION, *TARGET}


def _names(line: str) -> list[str]:
    return [name.strip().lower() for name in line.split(",")]


def resembles(files: Files) -> bool:
    """Return whether it looks like a failed attempt: it is named .csv, or its first line names some of the columns."""
    names = _names((files.text or "").split("\n", 1)[0])
    return files.path.suffix.lower() == ".csv" or len(COLUMNS.intersection(names)) > 1


def lacking(names: Collection[str]) -> str:
    """Return the error about missing columns."""
    missing = min(([name for name in POSITION + way if name not in names] for way in (TARGET, QUAT)), key=len)
    return (
        f"its first line, which names the columns, lacks {', '.join(missing)}; a camera needs {', '.join(POSITION)},"
        f" and {', '.join(TARGET)} or {', '.join(QUAT)}"
    )


def parse(files: Files, settings: Settings) -> Parsed:
    """Return its rows."""
    lines = files.lines() or [""]
    names = _names(lines[0])
    if not recognises(files):
        raise CameraPathError(lacking(names))
    if len(set(names)) < len(names):
        raise CameraPathError("its first line names a column twice")
    frames = []
    try:
        for number, row in enumerate(csv.reader(lines[1:]), 2):
            if row:
                frames.append(_frame(row, names, f"line {number}", settings))
    except csv.Error as error:
        raise CameraPathError(f"it is not CSV: {error}") from None
    unknown = sorted(set(names) - COLUMNS)
    notes = (f"Unknown columns were ignored: {', '.join(unknown)}.",) if unknown else ()
    return Parsed(frames, notes, turned=TARGET[0] not in names)


def _frame(row: list[str], names: list[str], way: str, settings: Settings) -> Frame:
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
