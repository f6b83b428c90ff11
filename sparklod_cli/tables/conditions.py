"""The one language of checks, for tables of frames and for reports on files: `NAME SIGN VALUE`, such as `nodes<=5M`."""

from __future__ import annotations

import json
import math
import operator
import re
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from ..support.errors import SparklodError
from ..support.units import PREFIXES
from .statistics import Number

SIGNS: dict[str, Callable[[Any, Any], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}

TEXT = re.compile(r"\s*(?P<left>[^<>=!]*?)\s*(?P<sign>[<>=!]+)\s*(?P<right>[^<>=!]*?)\s*")
NUMBER = re.compile(
    r"(?P<number>[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?)\s*(?P<unit>%|[kKMG]?(?:i?B)?)"
)

#: Values that are no numbers, as JSON spells them. A text is put in quotes, as there.
WORDS: dict[str, Any] = {"true": True, "false": False, "null": None}


class BadAssertionError(SparklodError):
    """An assertion cannot be understood, or not be answered."""


@dataclass(frozen=True)
class Condition:
    """What must hold of something that has a name.

    Attributes:
        text: as it was given, without spaces at its ends.
        name: of what is compared.
        sign: one of `SIGNS`.
        bound: what it is compared with: a number, or for == and != anything that JSON has.
    """

    text: str
    name: str
    sign: str
    bound: Any

    @classmethod
    def of(cls, name: str, sign: str, bound: Any) -> Condition:
        """A condition that nobody typed."""
        return cls(f"{name}{sign}{json.dumps(bound)}", name, sign, bound)

    def holds(self, value: Any) -> bool:
        """Whether a value is on the right side of the bound. Only numbers are in an order; true is not 1."""
        if self.sign in ("==", "!="):
            same = bool(value == self.bound) and isinstance(value, bool) == isinstance(self.bound, bool)
            return same == (self.sign == "==")
        return is_number(value) and is_number(self.bound) and SIGNS[self.sign](value, self.bound)


def is_number(value: Any) -> bool:
    """Whether a value can be compared by its size."""
    # Only NaN differs from itself; math.isnan fails on whole numbers beyond the range of floats.
    return isinstance(value, (int, float)) and not isinstance(value, bool) and value == value


def parse(text: str, *, example: str) -> Condition:
    """A condition from `NAME SIGN VALUE`.

    VALUE is a number, which may end in k, M, G, % or a unit of bytes (3MB, 3MiB); or true, false, null or a text in
    double quotes.

    Args:
        text: of the condition.
        example: of one, for the error.

    Raises:
        BadAssertionError: it cannot be understood.
    """
    found = TEXT.fullmatch(text)
    if not found or not found["left"] or not found["right"]:
        raise BadAssertionError(f"{text!r} is not an assertion like {example!r}")
    if found["sign"] not in SIGNS:
        raise BadAssertionError(f"{text!r}: {found['sign']} is not one of {' '.join(SIGNS)}")
    return Condition(text.strip(), found["left"], found["sign"], _value(text, found["right"]))


def _value(text: str, right: str) -> Any:
    if right in WORDS:
        return WORDS[right]
    if right.startswith('"'):
        try:
            return json.loads(right)
        except ValueError:
            raise BadAssertionError(f"{text!r}: {right} is not a text in double quotes") from None
    return _number(text, right)


def _number(text: str, right: str) -> Number:
    found = NUMBER.fullmatch(right)
    if not found:
        raise BadAssertionError(f"{text!r}: {right!r} is not a number such as 0.2, 500k, 2M or 20%")
    prefix = found["unit"].removesuffix("B")
    factor = Decimal("0.01") if prefix == "%" else PREFIXES.get(prefix.lower(), 0)
    number = float(Decimal(found["number"]) * factor)  # in decimals, so that 1.1k is 1100
    if not factor:
        raise BadAssertionError(f"{text!r}: {right!r} has no unit that is known; write k, M, G, %, MB or MiB")
    if not math.isfinite(number):
        raise BadAssertionError(f"{text!r}: {right} is too large")
    return int(number) if number.is_integer() else number


def number_text(value: Number) -> str:
    """A number as exact as a comparison needs it: "1,234,567", "0.2", "0.123457"."""
    return f"{int(value):,}" if float(value).is_integer() and abs(value) < 1e15 else f"{value:.9g}"
