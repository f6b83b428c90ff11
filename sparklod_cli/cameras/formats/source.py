"""What parsers read from and hand on: files that were read, JSON that is not believed before it is looked at."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ...support.errors import CameraPathError
from ...support.untrusted import LARGEST, parse_json
from ..camera import Matrix
from ..frame import Frame
from ..pose import pose, rotation_of

#: An image has no more pixels than this along a side.
MAX_SIDE = 1 << 16


@dataclass(frozen=True)
class Files:
    """A camera path's file, with those that belong to it.

    Attributes:
        path: of the file, or of the folder.
        contents: bytes of each file, by name, the one that was asked for first.
    """

    path: Path
    contents: Mapping[str, bytes]

    @property
    def data(self) -> bytes:
        """The bytes of the first file."""
        return next(iter(self.contents.values()), b"")

    @cached_property
    def text(self) -> str | None:
        """The first file as text; None where it is something else."""
        try:
            text = self.data.decode("utf-8-sig")
        except UnicodeDecodeError:
            return None
        return None if "\0" in text else text

    @cached_property
    def json(self) -> Json | None:
        """The first file as JSON; None where it is something else."""
        try:
            return Json(parse_json(self.text or ""))
        except ValueError:
            return None

    def lines(self) -> list[str]:
        """Of the first file, as text; `CameraPathError` where it is none."""
        if self.text is None:
            raise CameraPathError("it is not a text file")
        return self.text.splitlines()

    def object(self) -> Json:
        """The first file as a JSON object or list; `CameraPathError` where it is something else."""
        if self.json is None:
            raise CameraPathError("it is not JSON, or cut short")
        return self.json


@dataclass(frozen=True)
class Parsed:
    """What a parser found.

    Attributes:
        frames: in order; a path that is made of keys has them made when they are asked for.
        notes: what was left out or assumed, a sentence each, for people.
        fps: frames a second that the file names; None where it does not.
        turned: every camera says itself which way is up.
    """

    frames: Sequence[Frame]
    notes: tuple[str, ...] = ()
    fps: float | None = None
    turned: bool = False


@dataclass(frozen=True)
class Json:
    """A value of a JSON file and the way to it; what it should be is checked where it is asked for.

    Every method raises `CameraPathError`, which names the way, where the value is something else.
    """

    value: Any
    way: str = ""

    def has(self, *keys: str) -> bool:
        """Whether it is an object that has all of these keys, and none of them null."""
        return isinstance(self.value, dict) and all(self.value.get(key) is not None for key in keys)

    def get(self, key: str) -> Json:
        """What an object has by this key."""
        if not self.has(key):
            raise CameraPathError(f"{self.way or 'it'} has no {key!r}")
        return Json(self.value[key], f"{self.way}.{key}" if self.way else key)

    def first(self, *keys: str) -> Json | None:
        """What an object has by the first of these keys that it has; None where it has none."""
        return next((self.get(key) for key in keys if self.has(key)), None)

    def find(self, *keys: str) -> Json | None:
        """What is at the end of a way of keys; None where it breaks off."""
        here: Json | None = self
        for key in keys:
            here = here.first(key) if here else None
        return here

    def items(self) -> Iterator[Json]:
        """The items of a list."""
        if not isinstance(self.value, list):
            raise CameraPathError(f"{self.way or 'it'} is not a list")
        return (Json(item, f"{self.way}[{index}]") for index, item in enumerate(self.value))

    def number(self) -> float:
        """A finite number."""
        return finite(self.value, self.way)

    def numbers(self, *counts: int) -> list[float]:
        """Finite numbers, as many as one of `counts`; any number of them where that is empty."""
        if not isinstance(self.value, list) or (counts and len(self.value) not in counts):
            raise CameraPathError(f"{self.way} is not a list of {' or '.join(map(str, counts)) or 'some'} numbers")
        return [finite(item, self.way) for item in self.value]

    def pair(self) -> tuple[float, float]:
        """Two finite numbers."""
        first, second = self.numbers(2)
        return first, second

    def matrix(self, *rows: int, columns: int = 4) -> list[float]:
        """Finite numbers of a matrix, row by row: a list of lists, or one of all numbers.

        Args:
            rows: how many there may be.
            columns: how many there are.
        """
        value = self.value
        if isinstance(value, list) and len(value) in rows and all(isinstance(row, list) for row in value):
            return [number for row in self.items() for number in row.numbers(columns)]
        return self.numbers(*(columns * count for count in rows))

    def side(self) -> int:
        """Pixels along a side of an image."""
        return side(self.number(), self.way)

    def text(self) -> str:
        """A text."""
        if not isinstance(self.value, str):
            raise CameraPathError(f"{self.way} is not a text")
        return self.value


def posed(quat_wxyz: Sequence[float], position: Sequence[float], way: str) -> Matrix:
    """(4, 4) of a quaternion and a position; `CameraPathError`, naming where they are, of a quaternion of length 0."""
    try:
        return pose(rotation_of(quat_wxyz), position)
    except ValueError as error:
        raise CameraPathError(f"{way} {error}") from None


def finite(value: Any, way: str) -> float:
    """A finite number, of a number or of its digits; `CameraPathError`, naming where it is, of anything else."""
    try:
        number = float(value) if not isinstance(value, bool) else math.nan
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not abs(number) < LARGEST:
        raise CameraPathError(f"{way} has {brief(value)}, which is not a finite number")
    return number


def brief(value: Any) -> str:
    """A value of a file as it may be quoted: in a line, and not for pages."""
    return f"a {type(value).__name__}" if isinstance(value, (dict, list)) else repr(value)[:30]


def side(number: float, way: str) -> int:
    """Pixels along a side of an image; `CameraPathError`, naming where it is, of a number that cannot be that."""
    if not 1 <= number <= MAX_SIDE or number != int(number):
        raise CameraPathError(f"{way} of {number:g} is not a number of pixels")
    return int(number)
