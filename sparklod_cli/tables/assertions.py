"""Assertions, `NAME SIGN VALUE` such as `nodes<=5M`, about tables of frames and reports; their outcomes for tables."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from types import MappingProxyType
from typing import Any

from ..system.errors import SparklodError
from ..system.units import PREFIXES
from ..system.untrusted import near, parse_json
from .columns import STATISTICS, Column, Number, Row, is_statistic, numbers, statistic, totals

SIGNS: dict[str, Callable[[Any, Any], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}

TEXT = re.compile(r'([^<>=!]*)([<>=!]+)(\s*["[{].*|[^<>=!]*)', re.DOTALL)
NUMBER = re.compile(
    r"(?P<number>[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?)\s*(?P<unit>%|[kKMG]?(?:i?B)?)"
)


class BadAssertionError(SparklodError):
    """An assertion cannot be parsed, or there are no values to check."""


@dataclass(frozen=True)
class Assertion:
    """Comparison of a value of a report, of a column, or of a statistic of a column.

    Attributes:
        sign: one of `SIGNS`.
        bound: a number, or for == and != any value of JSON; a number for columns.
        statistic: of a column, see `statistic`; empty for reports, and if every frame must satisfy the assertion.
    """

    text: str
    name: str
    sign: str
    bound: Any
    statistic: str = ""

    def holds(self, value: Any) -> bool:
        """Return whether a value satisfies the assertion. Only numbers have an order; true is not 1."""
        if self.sign in ("==", "!="):
            same = bool(value == self.bound) and isinstance(value, bool) == isinstance(self.bound, bool)
            return same == (self.sign == "==")
        return is_number(value) and is_number(self.bound) and SIGNS[self.sign](value, self.bound)


def is_number(value: Any) -> bool:
    """Return whether a value is a number other than NaN; true and false are not."""
    # Only NaN differs from itself; math.isnan fails on whole numbers beyond the range of floats.
    return isinstance(value, (int, float)) and not isinstance(value, bool) and value == value


def parse_assertion(text: str, *, example: str) -> Assertion:
    """Parse an assertion about any name, `NAME SIGN VALUE`, like the `example` that errors show.

    VALUE is a number, which may end in k, M, G, % or a unit of bytes (3MB, 3MiB); or true, false, null, or a text in
    double quotes, a list or an object as in JSON.
    """
    match = TEXT.fullmatch(text)
    name, sign, right = (part.strip() for part in match.groups()) if match else ("", "", "")
    if not name or not right:
        raise BadAssertionError(f"{text!r} is not an assertion like {example!r}")
    if sign not in SIGNS:
        raise BadAssertionError(f"{text!r}: {sign} is not one of {' '.join(SIGNS)}")
    if right not in ("true", "false", "null") and not right.startswith(('"', "[", "{")):
        return Assertion(text.strip(), name, sign, _number(text, right))
    try:
        return Assertion(text.strip(), name, sign, parse_json(right))
    except ValueError:
        what = "a text in double quotes" if right.startswith('"') else "a list or an object of JSON"
        raise BadAssertionError(f"{text!r}: {right} is not {what}") from None


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
    """Return a number with enough digits for comparisons: "1,234,567", "0.2", "0.123456789"."""
    return f"{int(value):,}" if float(value).is_integer() and abs(value) < 1e15 else f"{value:.9g}"


@dataclass(frozen=True)
class Outcome:
    """Result of checking an assertion.

    Attributes:
        value: the statistic; without one, the value of the worst frame.
        failed, frames: number of frames that fail, 0 for a statistic, and of frames that have a value.
        worst: row of the frame that fails by most, or that comes closest to failing; None for a count.
    """

    assertion: Assertion
    held: bool
    value: Number
    failed: int
    frames: int
    worst: Row | None

    def as_dict(self) -> dict[str, Any]:
        return {"assert": self.assertion.text, "held": self.held, "value": self.value}

    def message(self) -> str:
        assertion = self.assertion
        where = self.worst and place_text(self.worst)
        if not assertion.statistic:
            some = f"fails in {self.failed:,} of {self.frames:,}" if self.failed else f"holds in all {self.frames:,}"
            return f"{assertion.text}: {some} frames; the worst is {where} with {number_text(self.value)}"
        found = f"{assertion.text}: {assertion.name}_{assertion.statistic} is {number_text(self.value)}"
        if self.worst is None:
            return found
        if assertion.statistic in ("first", "last"):
            return f"{found}, in {where}"
        (cell,) = numbers([self.worst], assertion.name)
        return f"{found}; the worst is {where} with {number_text(cell)}"


def parse(text: str, columns: Sequence[Column]) -> Assertion:
    """Parse an assertion about a numeric column, `NAME[_STATISTIC] SIGN NUMBER`; errors suggest similar names.

    The longest matching column is meant: `pixel_scale_min<1` is about every cell of the column pixel_scale_min,
    `pixel_scale_min_max<1` about the largest of them. NUMBER may end in k, M, G or %.
    """
    assertion = parse_assertion(text, example="churn_p95<0.2")
    left, kinds = assertion.name, {column.name: column.kind for column in columns}
    fitting = [
        name for name in kinds if left == name or (left.startswith(f"{name}_") and is_statistic(left[len(name) + 1 :]))
    ]
    if not fitting:
        raise BadAssertionError(f"{text!r}: {_unknown(left, columns)}")
    name = max(fitting, key=len)
    if kinds[name] is str:
        raise BadAssertionError(f"{text!r}: {name} is a text, only numbers can be compared")
    if not is_number(assertion.bound):
        raise BadAssertionError(f"{text!r}: {assertion.bound!r} is not a number such as 0.2, 500k, 2M or 20%")
    return replace(assertion, name=name, statistic=left[len(name) + 1 :])


def _unknown(left: str, columns: Sequence[Column]) -> str:
    """Return the error for the left side of an assertion that names no column, or no statistic of one."""
    numeric = [column.name for column in columns if column.kind is not str]
    stem, _, last = left.rpartition("_")
    name = stem if stem and is_statistic(last) else left
    meant = near(name, numeric, cutoff=0.8)
    of = max((each for each in numeric if left.startswith(f"{each}_")), key=len, default=None)
    if of is not None and not meant:
        statistics = f"{', '.join(STATISTICS)} or a percentile such as p95"
        return f"{left[len(of) + 1 :]!r} is not a statistic of {of}: {statistics}"
    return f"there is no column {name!r}{meant or near(name, numeric)}"


def check(
    assertions: Sequence[Assertion], rows: Iterable[Row], *, empty: Mapping[str, str] = MappingProxyType({})
) -> list[Outcome]:
    """Return the outcomes of assertions, in their order.

    Args:
        rows: of all frames; rows of single instances are left out.
        empty: reasons for columns without values, by column, for the error.

    Raises:
        BadAssertionError: there is no frame, or all cells of a column are empty.
    """
    frames = totals(rows)
    if not frames:
        raise BadAssertionError("there are no frames to check")
    return [_outcome(assertion, frames, empty) for assertion in assertions]


def _outcome(assertion: Assertion, rows: Sequence[Row], empty: Mapping[str, str]) -> Outcome:
    name = assertion.name
    filled = [row for row in rows if row[name] is not None]
    values = numbers(filled, name)
    if assertion.statistic == "count":
        return Outcome(assertion, assertion.holds(len(values)), len(values), 0, len(values), None)
    if not values:
        why = empty.get(name, "no frame has a value")
        raise BadAssertionError(f"{assertion.text!r}: {name} is empty: {why}")
    failed = [not assertion.holds(value) for value in values]
    worst = max(range(len(values)), key=lambda at: (failed[at], _badness(assertion, values[at])))
    if assertion.statistic in ("first", "last"):
        worst = 0 if assertion.statistic == "first" else len(values) - 1
    if not assertion.statistic:
        return Outcome(assertion, not any(failed), values[worst], sum(failed), len(values), filled[worst])
    value = statistic(assertion.statistic, values)
    return Outcome(assertion, assertion.holds(value), value, 0, len(values), filled[worst])


def _badness(assertion: Assertion, value: Number) -> Number:
    """Return a rank of a value: larger if it fails by more, or comes closer to failing."""
    if assertion.sign in ("<", "<="):
        return value
    if assertion.sign in (">", ">="):
        return -value
    away = abs(value - assertion.bound)
    return away if assertion.sign == "==" else -away


def place_text(row: Row) -> str:
    """Return the frame of a row, for display: "frame 12 at 0.400 s (door)"."""
    at = "" if row["time_s"] is None else f" at {row['time_s']:.3f} s"
    name = "" if row["name"] is None else str(row["name"]).replace("\r", "\\r").replace("\n", "\\n")
    return f"frame {row['frame']}{at}" + (f" ({name})" if name else "")
