"""Files of cameras: their formats are recognized and parsed, among them sparklod's own; and matrices.

A parser reads `Files`, as text or as `CameraJson`, which checks values where they are used. It returns `Parsed` frames:
poses in the axes of their format, and lenses as the file has them.
"""

from __future__ import annotations

import csv
import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ..io.files import read_text, read_together
from ..system import untrusted
from ..system.errors import CameraPathError, SparklodError
from ..system.untrusted import LARGEST as LARGEST_NUMBER
from ..system.untrusted import Origin, decoded_text, parse_json, quoted_value
from .camera import NO_LENS, Frame, Intrinsics, Matrix, Numbers, Settings, frame_looking, pose, rigid, rotation_of
from .camera_formats import FORMATS, NAMES, Axes, PathFormat
from .sources import CameraPath, Key, between, cameras_of

#: Most pixels along a side of an image.
MAX_SIDE = 1 << 16

#: Errors are prefixed with the name of the file where it is known.
ORIGIN = Origin("", CameraPathError)


@dataclass(frozen=True)
class Files:
    """The file of a camera path and its companions.

    Attributes:
        contents: bytes of each file by name; the requested one comes first.
    """

    path: Path
    contents: Mapping[str, bytes]

    @property
    def data(self) -> bytes:
        return next(iter(self.contents.values()), b"")

    @cached_property
    def text(self) -> str | None:
        """Text of the first file; None if it is not text."""
        return decoded(self.data)

    @cached_property
    def json(self) -> CameraJson | None:
        try:
            return CameraJson.parse(self.text or "", ORIGIN)
        except CameraPathError:
            return None

    def lines(self) -> list[str]:
        if self.text is None:
            raise CameraPathError("it is not a text file")
        return self.text.splitlines()

    def object(self) -> CameraJson:
        if self.json is None:
            raise CameraPathError("it is not JSON, or cut short")
        return self.json


@dataclass(frozen=True)
class Parsed:
    """Frames of a file, from a parser.

    Attributes:
        frames: in order; or a function that computes frames between keys from their numbers.
        notes: ignored parts and assumptions, one sentence each, for display.
        turned: every camera has its own up axis.
        count: number of frames that the function computes, rounded up and at least one.
    """

    frames: Sequence[Frame] | Callable[[Numbers], list[Frame]]
    notes: tuple[str, ...] = ()
    fps: float | None = None
    turned: bool = False
    count: float = 0


class CameraJson(untrusted.Json):
    """A value of a camera file, whose numbers may be written as texts; its errors are `CameraPathError`."""

    __slots__ = ()

    def __init__(self, value: Any, above: untrusted.Json | Origin = ORIGIN, key: str | int = "") -> None:
        super().__init__(value, above, key)

    @classmethod
    def of_row(cls, names: Sequence[str], values: Sequence[Any], place: str) -> CameraJson:
        """Return a row of a table as an object with a key for each column."""
        if len(values) != len(names):
            raise CameraPathError(f"{place} has {len(values)} values, not {len(names)}: {', '.join(names)}")
        return cls(dict(zip(names, values, strict=True)), Origin(place, CameraPathError))

    def _number(self, value: Any) -> float | None:
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            return None
        return None if isinstance(value, bool) or not abs(number) < LARGEST_NUMBER else number

    def first_has(self, *keys: str) -> bool:
        return isinstance(self.value, list) and bool(self.value) and self.get(0).has(*keys)

    def pair(self) -> tuple[float, float]:
        first, second = self.numbers(2)
        return first, second

    def positive(self) -> float:
        if not (number := self.number()) > 0:
            raise self.unexpected("a number above 0")
        return number

    def side(self) -> int:
        """Return the number of pixels along a side of an image."""
        number = self.number()
        if not (1 <= number <= MAX_SIDE and number.is_integer()):
            raise self.unexpected("a number of pixels")
        return int(number)

    def identifier(self) -> int:
        number = self.number()
        if not number.is_integer():
            raise self.unexpected("a whole number")
        return int(number)

    def label(self, key: str) -> str:
        """Return the text of a key that only names its object: of a number its digits, empty without the key."""
        value = self.value.get(key) if isinstance(self.value, dict) else None
        return value if isinstance(value, str) else "" if value is None else quoted_value(value)

    def matrix_4x4(self, *rows: int) -> Matrix:
        """Return a (4, 4) matrix of 4 rows, or of any number in `rows`; 3 rows lack the last one, 0 0 0 1."""
        return np.array([*self.matrix(*(rows or (4,))), 0, 0, 0, 1][:16]).reshape(4, 4)

    def pose(self, quat_wxyz: Sequence[float], position: Sequence[float]) -> Matrix:
        """Return the (4, 4) pose of a quaternion and a position, or raise an error for a quaternion of length 0."""
        try:
            return pose(rotation_of(quat_wxyz), position)
        except ValueError as error:
            raise self.error(f"it {error}") from None


def decoded(data: bytes) -> str | None:
    """Return the text of a file, see `decoded_text`; None if it is not text."""
    try:
        text = decoded_text(data)
    except UnicodeDecodeError:
        return None
    return None if "\0" in text else text


#: Bytes of a camera path's file. COLMAP's images.txt has all points that its images see.
LARGEST = 1 << 31


def read(files: Files, *, format: str | None = None, settings: Settings | None = None) -> CameraPath:
    """Return the cameras of a file; `format` is the name of a row of `FORMATS`, None to recognize it by the content.

    `CameraPathError` if the file has no known format or is broken, or a camera is impossible.
    """
    settings = settings or Settings()
    if not any(files.contents.values()):
        raise CameraPathError("it is empty")
    form = _known(files) if format is None else next(form for form in FORMATS if form.name == format)
    if settings.axes and form.axes is None:
        raise CameraPathError(f"{form.title} has targets instead of axes, so --camera-axes cannot be used with it")
    parsed: Parsed = _function(form, "parse")(files, settings)
    if settings.up is not None and (parsed.turned or not form.looking):
        raise CameraPathError("its cameras have their own up axes, so --up cannot be used with them")
    notes = parsed.notes + ((form.world,) if form.world and settings.world is None else ())
    return cameras_of(parsed.frames, settings, form.title, form.axes, count=parsed.count, fps=parsed.fps, notes=notes)


def _known(files: Files) -> PathFormat:
    form = next((form for form in FORMATS if _function(form, "recognises")(files)), None)
    csv = next(form for form in FORMATS if form.name == "csv")
    if form is None and _function(csv, "resembles")(files):
        form = csv  # its error names the missing columns
    if form is None:
        names = ", ".join(form.name for form in FORMATS)
        raise CameraPathError(f"its content is of no known format; name the format with --camera-format ({names})")
    return form


def _function(form: PathFormat, verb: str) -> Any:
    module = import_module(f".{form.module}", __package__)
    return getattr(module, f"{verb}_{form.name.replace('-', '_')}")


def read_path(path: Path, format: str | None = None, settings: Settings | None = None) -> CameraPath:
    """Return the cameras of a file, or of a folder that COLMAP wrote; see `read`.

    A `CameraPathError`, also where it cannot be read, names the file.
    """
    try:
        contents = read_together(path, NAMES, LARGEST)
    except SparklodError as error:
        raise CameraPathError(str(error)) from None
    try:
        return read(Files(path, contents), format=format, settings=settings)
    except CameraPathError as error:
        raise CameraPathError(f"{path}: {error}") from None


def similarity(text: str) -> Matrix:
    """Return a (4, 4) matrix of a rotation, a uniform scale and a translation from 16 numbers, row by row.

    The numbers are separated by commas or white space, or JSON: a list of them or of rows. The text of a
    `CameraPathError` continues a sentence about them.
    """
    try:
        value = parse_json(text) if text.lstrip().startswith("[") else re.split(r"[\s,;]+", text.strip())
    except ValueError:
        raise CameraPathError("is not JSON") from None
    if len(value) not in (4, 16):
        raise CameraPathError(f"has {len(value)} numbers, not 16")
    matrix = CameraJson(value, Origin("matrix", CameraPathError)).matrix_4x4()
    try:
        rigid(matrix)
    except ValueError as error:
        raise CameraPathError(f"{error}") from None
    return matrix


def read_world_transform(path: Path) -> Matrix:
    """Return the `similarity` in a file; a `CameraPathError` names the file."""
    try:
        return similarity(read_text(path))
    except CameraPathError as error:
        raise CameraPathError(f"{path}: --world-transform {error}") from None
    except SparklodError as error:
        raise CameraPathError(str(error)) from None


#: sparklod's own files: JSON of cameras or keyframes, and CSV of a camera per row; docs/cameras.md describes both.
FORMAT, VERSION = "sparklod-camera-path", 1

POSITION, QUAT, TARGET = ("x", "y", "z"), ("qx", "qy", "qz", "qw"), ("target_x", "target_y", "target_z")

#: Keys of a frame in JSON by the columns of CSV that they have the numbers of.
KEYS = {
    POSITION: "eye",
    TARGET: "target",
    QUAT: "quat_xyzw",
    ("up_x", "up_y", "up_z"): "up",
    ("width", "height"): "size",
    ("time",): "time",
    ("fov",): "fov",
}
COLUMNS = {"name", *itertools.chain.from_iterable(KEYS)}


def recognises_sparklod(files: Files) -> bool:
    """Return whether the file names the format."""
    return files.json is not None and files.json.has("format") and files.json.value["format"] == FORMAT


def parse_sparklod(files: Files, settings: Settings) -> Parsed:
    """Parse frames, or keyframes with the frames between them."""
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
        matrix = item.get("matrix").matrix_4x4()
    else:
        x, y, z, w = item.get("quat_xyzw").numbers(4)
        matrix = item.pose([w, x, y, z], item.get("position").numbers(3))
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
    """Return whether the first line names the columns of a pose."""
    names = {*_names(files)}
    return names >= {*POSITION, *QUAT} or names >= {*POSITION, *TARGET}


def _names(files: Files) -> list[str]:
    return [name.strip().lower() for name in (files.text or "").split("\n", 1)[0].split(",")]


def resembles_csv(files: Files) -> bool:
    """Return whether the file is meant as CSV: it is named .csv, or its first line names two of the columns."""
    names = _names(files)
    return files.path.suffix.lower() == ".csv" or len(COLUMNS.intersection(names)) > 1


def parse_csv(files: Files, settings: Settings) -> Parsed:
    """Parse rows with a camera each, below a line that names the columns."""
    lines, names = files.lines(), _names(files)
    if not recognises_csv(files):
        missing = min(([name for name in POSITION + way if name not in names] for way in (TARGET, QUAT)), key=len)
        raise CameraPathError(
            f"its first line, which names the columns, lacks {', '.join(missing)}; a camera needs"
            f" {', '.join(POSITION)}, and {', '.join(TARGET)} or {', '.join(QUAT)}"
        )
    if len(set(names)) < len(names):
        raise CameraPathError("its first line names a column twice")
    try:
        rows = [(f"line {number}", row) for number, row in enumerate(csv.reader(lines[1:]), 2) if row]
    except csv.Error as error:
        raise CameraPathError(f"it is not CSV: {error}") from None
    frames = [_frame(_item_of_row(names, row, line), NO_LENS, Axes.OPENGL_C2W, settings) for line, row in rows]
    unknown = sorted(set(names) - COLUMNS)
    notes = (f"Unknown columns were ignored: {', '.join(unknown)}.",) if unknown else ()
    return Parsed(frames, notes, turned=TARGET[0] not in names)


def _item_of_row(names: list[str], values: list[str], line: str) -> CameraJson:
    """Return a row of CSV as a frame of JSON; empty cells count as missing."""
    row = CameraJson.of_row(names, [value.strip() or None for value in values], line)
    item: dict[str, Any] = {"name": row.label("name")}
    for columns, key in KEYS.items():
        if row.has(columns[0]) or columns == POSITION:
            numbers = [row.number(column) for column in columns]
            item[key] = numbers if len(columns) > 1 else numbers[0]
    if "quat_xyzw" in item:
        item["position"] = item.pop("eye")
    return CameraJson(item, Origin(line, CameraPathError))
