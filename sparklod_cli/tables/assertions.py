"""Assertions about a table, such as `churn_p95<0.2`: what `--assert` takes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from ..support.printable import near
from . import conditions
from .columns import Column, Row
from .conditions import SIGNS, BadAssertionError, is_number, number_text
from .statistics import STATISTICS, Number, is_statistic, numbers, statistic, totals


@dataclass(frozen=True)
class Assertion:
    """A comparison of a column, or of a statistic of it, with a bound.

    Attributes:
        text: as it was given, without spaces at its ends.
        column: a numeric column.
        statistic: of its cells, see `statistics`; empty if every frame must hold by itself.
        sign: one of `conditions.SIGNS`.
        bound: right side of the comparison.
    """

    text: str
    column: Column
    statistic: str
    sign: str
    bound: Number

    def holds(self, value: Number) -> bool:
        """Whether a value compares with the bound as it must."""
        return SIGNS[self.sign](value, self.bound)


@dataclass(frozen=True)
class Outcome:
    """Whether an assertion holds.

    Attributes:
        assertion: the assertion.
        held: whether it holds.
        value: the statistic; without one, the value of the worst frame.
        failed, frames: frames that fail by themselves, and frames that have a value; `failed` is 0 for a statistic.
        worst: row of the frame that fails by most, or that comes closest to failing; None for a count.
    """

    assertion: Assertion
    held: bool
    value: Number
    failed: int
    frames: int
    worst: Row | None

    def message(self) -> str:
        """The outcome, in a line."""
        asked = self.assertion
        where = self.worst and place_text(self.worst)
        if not asked.statistic:
            some = f"fails in {self.failed:,} of {self.frames:,}" if self.failed else f"holds in all {self.frames:,}"
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

    NAME is that of a numeric column, the longest one that fits: `pixel_scale_min<1` is about every cell of the column
    pixel_scale_min, `pixel_scale_min_max<1` about the largest of them. NUMBER may end in k, M, G or %.

    Args:
        text: the assertion.
        columns: of the table.

    Raises:
        BadAssertionError: it is not well formed; suggests similar names.
    """
    condition = conditions.parse(text, example="churn_p95<0.2")
    column, name = _column(text, condition.name, columns)
    if not is_number(condition.bound):
        raise BadAssertionError(f"{text!r}: {condition.bound!r} is not a number such as 0.2, 500k, 2M or 20%")
    return Assertion(condition.text, column, name, condition.sign, condition.bound)


def _column(text: str, left: str, columns: Sequence[Column]) -> tuple[Column, str]:
    """The column and the statistic on the left side; the statistic may be empty."""
    every = {column.name: column for column in columns}
    fitting = [
        name for name in every if left == name or (left.startswith(f"{name}_") and is_statistic(left[len(name) + 1 :]))
    ]
    if not fitting:
        raise BadAssertionError(f"{text!r}: {_unknown(left, columns)}")
    name = max(fitting, key=len)
    if every[name].kind is str:
        raise BadAssertionError(f"{text!r}: {name} is a text, only numbers can be compared")
    return every[name], left[len(name) + 1 :]


def _unknown(left: str, columns: Sequence[Column]) -> str:
    """The error about a name that is neither a column nor a column with a statistic."""
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
    """The outcomes of assertions, in their order.

    Args:
        assertions: to check.
        rows: of all frames; rows of single instances are left out.
        empty: why all cells of a column may be empty, by the column's name, for the error.

    Raises:
        BadAssertionError: there is no frame, or all cells of a column are empty.
    """
    frames = totals(rows)
    if not frames:
        raise BadAssertionError("there are no frames to check")
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
    """Larger for values that fail by more, or come closer to failing."""
    if assertion.sign in ("<", "<="):
        return value
    if assertion.sign in (">", ">="):
        return -value
    away = abs(value - assertion.bound)
    return away if assertion.sign == "==" else -away


def place_text(row: Row) -> str:
    """The frame of a row, for display: "frame 12 at 0.400 s (door)"."""
    at = "" if row["time_s"] is None else f" at {row['time_s']:.3f} s"
    name = "" if row["name"] is None else str(row["name"]).replace("\r", "\\r").replace("\n", "\\n")
    return f"frame {row['frame']}{at}" + (f" ({name})" if name else "")
