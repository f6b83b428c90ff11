"""`--assert`: what a column must be for a check to hold, such as `churn_p95<0.2`."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from types import MappingProxyType

from ..support.errors import SparklodError
from .columns import Column, Row
from .files import near
from .statistics import STATISTICS, Number, is_statistic, numbers, statistic, totals

COMPARISONS: dict[str, Callable[[Number, Number], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}

TEXT = re.compile(r"\s*(?P<left>[^<>=!]*?)\s*(?P<sign>[<>=!]+)\s*(?P<right>[^<>=!]*?)\s*")
NUMBER = re.compile(r"(?P<number>[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?)\s*(?P<unit>[kKMG%]?)")
UNITS: dict[str, int | Decimal] = {"": 1, "k": 10**3, "K": 10**3, "M": 10**6, "G": 10**9, "%": Decimal("0.01")}


class BadAssertionError(SparklodError):
    """An assertion cannot be understood, or not be answered."""


@dataclass(frozen=True)
class Assertion:
    """What must hold.

    Attributes:
        text: as it was given, without spaces at its ends.
        column: a numeric one.
        statistic: of its cells, see `statistics`; empty where every cell must hold by itself.
        sign: one of `COMPARISONS`.
        bound: what they are compared with.
    """

    text: str
    column: Column
    statistic: str
    sign: str
    bound: Number

    def holds(self, value: Number) -> bool:
        """Whether a value is on the right side of the bound."""
        return COMPARISONS[self.sign](value, self.bound)


@dataclass(frozen=True)
class Outcome:
    """Whether an assertion holds.

    Attributes:
        assertion: the question.
        held: the answer.
        value: the statistic; where every frame must hold by itself, the value of the worst one.
        failed, frames: how many frames do not hold by themselves, of those that have a value; `failed` is 0 for a
            statistic.
        worst: row of the frame that is farthest on the wrong side, or nearest to it; None for a count.
    """

    assertion: Assertion
    held: bool
    value: Number
    failed: int
    frames: int
    worst: Row | None

    def message(self) -> str:
        """What was found, in a line."""
        asked = self.assertion
        where = self.worst and place_text(self.worst)
        if not asked.statistic:
            some = (
                f"does not hold in {self.failed:,} of {self.frames:,}"
                if self.failed
                else f"holds in all {self.frames:,}"
            )
            return f"{asked.text}: {some} frames; the worst is {where} with {number_text(self.value)}"
        found = f"{asked.text}: {asked.column.name}_{asked.statistic} is {number_text(self.value)}"
        if self.worst is None:
            return found
        if asked.statistic in ("first", "last"):
            return f"{found}, in {where}"
        (cell,) = numbers([self.worst], asked.column.name)
        return f"{found}; the worst is {where} with {number_text(cell)}"


def parse(text: str, columns: Sequence[Column]) -> Assertion:
    """An assertion from `NAME[_STATISTIC] SIGN NUMBER`.

    NAME is that of a numeric column, and the longest name that fits is taken: `pixel_scale_min<1` is about every cell
    of the column pixel_scale_min, `pixel_scale_min_max<1` about the greatest of them. NUMBER may end in k, M, G or %.

    Raises:
        BadAssertionError: it cannot be understood; in a line that says what comes near.
    """
    found = TEXT.fullmatch(text)
    if not found or not found["left"] or not found["right"]:
        raise BadAssertionError(f"{text!r} is not an assertion like 'churn_p95<0.2'")
    if found["sign"] not in COMPARISONS:
        raise BadAssertionError(f"{text!r}: {found['sign']} is not one of {' '.join(COMPARISONS)}")
    column, name = _column(text, found["left"], columns)
    return Assertion(text.strip(), column, name, found["sign"], _bound(text, found["right"]))


def _column(text: str, left: str, columns: Sequence[Column]) -> tuple[Column, str]:
    """The column and the statistic that stand on the left, the latter may be empty."""
    every = {column.name: column for column in columns}
    fitting = [
        name for name in every if left == name or (left.startswith(f"{name}_") and is_statistic(left[len(name) + 1 :]))
    ]
    if not fitting:
        raise BadAssertionError(f"{text!r}: {_unknown(left, columns)}")
    name = max(fitting, key=len)
    if every[name].kind is str:
        raise BadAssertionError(f"{text!r}: {name} is text, and only numbers can be compared")
    return every[name], left[len(name) + 1 :]


def _unknown(left: str, columns: Sequence[Column]) -> str:
    """What is wrong with a name that is neither a column nor a column with a statistic."""
    numeric = [column.name for column in columns if column.kind is not str]
    stem, _, last = left.rpartition("_")
    name = stem if stem and is_statistic(last) else left
    meant = near(name, numeric, cutoff=0.8)
    of = max((each for each in numeric if left.startswith(f"{each}_")), key=len, default=None)
    if of is not None and not meant:
        statistics = f"{', '.join(STATISTICS)} or a percentile such as p95"
        return f"{left[len(of) + 1 :]!r} is not a statistic of {of}: {statistics}"
    return f"there is no column {name!r}{meant or near(name, numeric)}"


def _bound(text: str, right: str) -> Number:
    found = NUMBER.fullmatch(right)
    if not found:
        raise BadAssertionError(f"{text!r}: {right!r} is not a number such as 0.2, 500k, 2M or 20%")
    number = float(Decimal(found["number"]) * UNITS[found["unit"]])  # in decimals, so that 1.1k is 1100
    if not math.isfinite(number):
        raise BadAssertionError(f"{text!r}: {right} is too large")
    return int(number) if number.is_integer() else number


def check(
    assertions: Sequence[Assertion], rows: Iterable[Row], *, empty: Mapping[str, str] = MappingProxyType({})
) -> list[Outcome]:
    """Whether assertions hold, in their order.

    Args:
        assertions: the questions.
        rows: of all frames; those of single instances, in a table that has any, are left out.
        empty: why all cells of a column may be empty, by the column's name, for the error.

    Raises:
        BadAssertionError: there is no frame, or all cells of a column are empty.
    """
    frames = totals(rows)
    if not frames:
        raise BadAssertionError("there are no frames that an assertion could be about")
    return [_outcome(assertion, frames, empty) for assertion in assertions]


def _outcome(assertion: Assertion, rows: Sequence[Row], empty: Mapping[str, str]) -> Outcome:
    name = assertion.column.name
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
    """Greater for values that are farther on the wrong side of the bound."""
    if assertion.sign in ("<", "<="):
        return value
    if assertion.sign in (">", ">="):
        return -value
    away = abs(value - assertion.bound)
    return away if assertion.sign == "==" else -away


def number_text(value: Number) -> str:
    """A number as exact as a comparison needs it: "1,234,567", "0.2", "0.123457"."""
    return f"{int(value):,}" if float(value).is_integer() and abs(value) < 1e15 else f"{value:.9g}"


def place_text(row: Row) -> str:
    """Which frame a row is of: "frame 12 at 0.400 s (door)"."""
    at = "" if row["time_s"] is None else f" at {row['time_s']:.3f} s"
    name = "" if row["name"] is None else str(row["name"]).replace("\r", "\\r").replace("\n", "\\n")
    return f"frame {row['frame']}{at}" + (f" ({name})" if name else "")
