"""Input and output of parsers of camera paths.

A parser reads `Files`, as text or as `CameraJson`, which checks values where they are used. It returns `Parsed` frames:
poses in the axes of their format, and lenses as the file has them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ..system import untrusted
from ..system.errors import CameraPathError
from ..system.untrusted import LARGEST, Origin, decoded_text, quoted_value
from .camera import Frame, Matrix, Numbers, pose, rotation_of

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
        fps: frames a second in the file; None if it gives none.
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
    return number if abs(number) < LARGEST else None


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
