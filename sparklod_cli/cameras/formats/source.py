"""Input and output of parsers: `Files`, `Json`, which checks values where they are used, and `Parsed`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ...system.errors import CameraPathError
from ...system.json_text import decoded_text
from ...system.untrusted import LARGEST, parse_json, quoted_value
from ..camera import Matrix
from ..frame import Frame
from ..pose import pose, rotation_of

#: Most pixels along a side of an image.
MAX_SIDE = 1 << 16


@dataclass(frozen=True)
class Files:
    """The file of a camera path and those that belong to it.

    Attributes:
        contents: bytes of each file by name; the one that was asked for comes first.
    """

    path: Path
    contents: Mapping[str, bytes]

    @property
    def data(self) -> bytes:
        """The bytes of the first file."""
        return next(iter(self.contents.values()), b"")

    @cached_property
    def text(self) -> str | None:
        """The first file as text; None if it is not text."""
        return decoded(self.data)

    @cached_property
    def json(self) -> Json | None:
        """The first file as JSON; None if it is not JSON."""
        try:
            return Json(parse_json(self.text or ""))
        except ValueError:
            return None

    def lines(self) -> list[str]:
        """Return the lines of the first file; `CameraPathError` if it is not text."""
        if self.text is None:
            raise CameraPathError("it is not a text file")
        return self.text.splitlines()

    def object(self) -> Json:
        """Return the first file as JSON; `CameraPathError` if it is not JSON."""
        if self.json is None:
            raise CameraPathError("it is not JSON, or cut short")
        return self.json


@dataclass(frozen=True)
class Parsed:
    """The result of a parser.

    Attributes:
        frames: in order; those between keys are computed when they are asked for.
        notes: what was ignored or assumed, one sentence each, for display.
        fps: frames a second in the file; None if it gives none.
        turned: every camera has its own up axis.
    """

    frames: Sequence[Frame]
    notes: tuple[str, ...] = ()
    fps: float | None = None
    turned: bool = False


@dataclass(frozen=True)
class Json:
    """A value of a JSON file and the keys that lead to it, as one text.

    Every method raises `CameraPathError`, which names the keys, if the value is not of the required type.
    """

    value: Any
    way: str = ""

    def has(self, *keys: str) -> bool:
        """Return whether it is an object with all of these keys, none of them null."""
        return isinstance(self.value, dict) and all(self.value.get(key) is not None for key in keys)

    def get(self, key: str) -> Json:
        """Return the value of a key of an object."""
        if not self.has(key):
            raise CameraPathError(f"{self.way or 'it'} has no {key!r}")
        return Json(self.value[key], f"{self.way}.{key}" if self.way else key)

    def first(self, *keys: str) -> Json | None:
        """Return the value of the first of these keys that an object has; None if it has none."""
        return next((self.get(key) for key in keys if self.has(key)), None)

    def find(self, *keys: str) -> Json | None:
        """Return the value at the end of nested keys; None if one is missing."""
        here: Json | None = self
        for key in keys:
            here = here.first(key) if here else None
        return here

    def items(self) -> Iterator[Json]:
        """Return the items of a list."""
        if not isinstance(self.value, list):
            raise CameraPathError(f"{self.way or 'it'} is not a list")
        return (Json(item, f"{self.way}[{index}]") for index, item in enumerate(self.value))

    def number(self) -> float:
        """Return a finite number."""
        return finite(self.value, self.way)

    def numbers(self, *counts: int) -> list[float]:
        """Return a list of finite numbers, of one of the lengths `counts`; of any length without them."""
        if not isinstance(self.value, list) or (counts and len(self.value) not in counts):
            raise CameraPathError(f"{self.way} is not a list of {' or '.join(map(str, counts)) or 'some'} numbers")
        return [finite(item, self.way) for item in self.value]

    def pair(self) -> tuple[float, float]:
        """Return two finite numbers."""
        first, second = self.numbers(2)
        return first, second

    def matrix(self, *rows: int, columns: int = 4) -> list[float]:
        """Return the finite numbers of a matrix, row by row, from a list of rows or of all numbers.

        Args:
            rows: numbers of rows that are accepted.
            columns: number of columns.
        """
        value = self.value
        if isinstance(value, list) and len(value) in rows and all(isinstance(row, list) for row in value):
            return [number for row in self.items() for number in row.numbers(columns)]
        return self.numbers(*(columns * count for count in rows))

    def side(self) -> int:
        """Return pixels along a side of an image."""
        return side(self.number(), self.way)

    def text(self) -> str:
        """Return a text."""
        if not isinstance(self.value, str):
            raise CameraPathError(f"{self.way} is not a text")
        return self.value

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
    try:
        number = float(value) if not isinstance(value, bool) else math.nan
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not abs(number) < LARGEST:
        raise CameraPathError(f"{way} has {brief(value)}, which is not a finite number")
    return number


def whole(number: float, way: str) -> int:
    """Return a whole number; `CameraPathError`, naming its place, for a fraction."""
    if not number.is_integer():
        raise CameraPathError(f"{way} has {number:g}, which is not a whole number")
    return int(number)


def brief(value: Any) -> str:
    """Return a value of a file as an error quotes it: on one line, and shortened."""
    return f"a {type(value).__name__}" if isinstance(value, (dict, list)) else repr(value)[:30]


def side(number: float, way: str) -> int:
    """Return pixels along a side of an image; `CameraPathError`, naming its place, for an impossible number."""
    if not 1 <= number <= MAX_SIDE or number != int(number):
        raise CameraPathError(f"{way} of {number:g} is not a number of pixels")
    return int(number)
