"""`Fields`: an object of a header's JSON, whose values are checked when they are read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ...support.errors import FormatError
from ...support.untrusted import quoted_value


@dataclass(frozen=True)
class Fields:
    """An object of a stranger's JSON.

    Attributes:
        values: the object.
        what: it is, for errors.

    Raises:
        FormatError: here it is something else than an object; in every method, a value is not of the kind.
    """

    values: Any
    what: str

    def __post_init__(self) -> None:
        if not isinstance(self.values, dict):
            raise FormatError(f"its {self.what} is not a JSON object")

    def has(self, key: str) -> bool:
        """Whether there is such a key, with a value other than null."""
        return self.values.get(key) is not None

    def whole(self, key: str, default: int | None = None) -> int:
        """A whole number that is not negative."""
        value = self.values.get(key)
        if value is None and default is not None:
            return default
        if type(value) is not int or value < 0:
            raise self._wrong(key, "a whole number of 0 or more")
        return value

    def number_or_none(self, key: str) -> float | None:
        """A finite number."""
        value = self.values.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise self._wrong(key, "a finite number")
        return float(value)

    def flag(self, key: str) -> bool:
        """True or false; false without the key."""
        value = self.values.get(key)
        if value is not None and not isinstance(value, bool):
            raise self._wrong(key, "true or false")
        return bool(value)

    def text(self, key: str) -> str:
        """A text."""
        value = self.text_or_none(key)
        if value is None:
            raise self._wrong(key, "a text")
        return value

    def text_or_none(self, key: str) -> str | None:
        """A text, or None without the key."""
        value = self.values.get(key)
        if value is not None and not isinstance(value, str):
            raise self._wrong(key, "a text")
        return value

    def inner(self, key: str) -> Fields:
        """An object."""
        return Fields(self.values.get(key), f"{self.what}'s {key}")

    def items(self, key: str) -> Iterator[Fields]:
        """The objects of a list."""
        values = self.values.get(key)
        if not isinstance(values, list):
            raise self._wrong(key, "a list")
        return (Fields(value, f"{self.what}'s {key}[{number}]") for number, value in enumerate(values))

    def _wrong(self, key: str, kind: str) -> FormatError:
        if key not in self.values:
            return FormatError(f"its {self.what} has no {key}")
        return FormatError(f"its {self.what} has {key} = {quoted_value(self.values[key])}, which is not {kind}")
