"""Files of cameras: their formats are recognised and parsed; and matrices of `--world-transform`.

A parser reads `Files`, as text or as `CameraJson`, which checks values where they are used. It returns `Parsed` frames:
poses in the axes of their format, and lenses as the file has them.
"""

from __future__ import annotations

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
from .camera import Frame, Matrix, Numbers, Settings, pose, rigid, rotation_of
from .camera_formats import FORMATS, NAMES, PathFormat
from .sources import CameraPath, cameras_of

#: Most pixels along a side of an image.
MAX_SIDE = 1 << 16

#: Errors are prefixed with the name of the file where it is known.
ORIGIN = Origin("", CameraPathError)


@dataclass(frozen=True)
class Files:
    """The file of a camera path and those that belong to it.

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
        """The first file as text; None if it is not text."""
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
    """The result of a parser.

    Attributes:
        frames: in order; or a function that computes frames between keys from their numbers.
        notes: what was ignored or assumed, one sentence each, for display.
        turned: every camera has its own up axis.
        count: number of frames that are computed, rounded up and at least one.
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

    def _number(self, value: Any) -> float | None:
        return _finite(value)

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
        number = self.number()
        if not _is_side(number):
            raise self.unexpected("a number of pixels")
        return int(number)

    def label(self, key: str) -> str:
        """Return the text of a key that only names its object: of a number its digits, empty without the key."""
        value = self.value.get(key) if isinstance(self.value, dict) else None
        return value if isinstance(value, str) else "" if value is None else quoted_value(value)


def decoded(data: bytes) -> str | None:
    """Return the text of a file, see `decoded_text`; None if it is not text."""
    try:
        text = decoded_text(data)
    except UnicodeDecodeError:
        return None
    return None if "\0" in text else text


def posed(quat_wxyz: Sequence[float], position: Sequence[float], way: str) -> Matrix:
    """Return the (4, 4) pose of a quaternion and a position; `CameraPathError`, naming the place, for length 0."""
    try:
        return pose(rotation_of(quat_wxyz), position)
    except ValueError as error:
        raise CameraPathError(f"{way} {error}") from None


def finite(value: Any, way: str) -> float:
    """Return a finite number from a number or its digits; `CameraPathError`, naming its place, for anything else."""
    number = _finite(value)
    if number is None:
        raise CameraPathError(f"{way} has {repr(value)[:30]}, which is not a finite number")
    return number


def _finite(value: Any) -> float | None:
    try:
        number = float(value) if not isinstance(value, bool) else math.nan
    except (TypeError, ValueError, OverflowError):
        return None
    return number if abs(number) < LARGEST_NUMBER else None


def whole(number: float, way: str) -> int:
    """Return a whole number; `CameraPathError`, naming its place, for a fraction."""
    if not number.is_integer():
        raise CameraPathError(f"{way} has {number:g}, which is not a whole number")
    return int(number)


def side(number: float, way: str) -> int:
    """Return pixels along a side of an image; `CameraPathError`, naming its place, for an impossible number."""
    if not _is_side(number):
        raise CameraPathError(f"{way} of {number:g} is not a number of pixels")
    return int(number)


def _is_side(number: float) -> bool:
    return 1 <= number <= MAX_SIDE and number == int(number)


#: Bytes of a camera path's file. COLMAP's images.txt has all points that its images see.
LARGEST = 1 << 31


def read(files: Files, *, format: str | None = None, settings: Settings | None = None) -> CameraPath:
    """Return the cameras of a file; `format` is the name of a row of `FORMATS`, None to recognize it by the content.

    `CameraPathError` if the file has no known format or is broken, or a camera makes no sense.
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
    words = re.split(r"[\s,;]+", text.strip())
    try:
        if text.lstrip().startswith("["):
            numbers = CameraJson(parse_json(text), Origin("matrix", CameraPathError)).matrix(4)
        else:
            numbers = [finite(word, "matrix") for word in words]
    except ValueError:
        raise CameraPathError("is not JSON") from None
    if len(numbers) != 16:
        raise CameraPathError(f"has {len(numbers)} numbers, not 16")
    matrix = np.array(numbers).reshape(4, 4)
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
