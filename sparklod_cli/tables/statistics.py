"""Statistics of the cells of a column; what a summary prints is what an assertion compares."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from ..model.instances import TOTAL
from .columns import Row

Number = int | float

#: All but the percentiles, which are p0 to p100.
STATISTICS: dict[str, Callable[[Sequence[Number]], Number]] = {
    "min": min,
    "mean": lambda values: math.fsum(values) / len(values),
    "max": max,
    "sum": lambda values: math.fsum(values) if any(isinstance(value, float) for value in values) else sum(values),
    "first": lambda values: values[0],
    "last": lambda values: values[-1],
    "count": len,
}

PERCENTILE = re.compile(r"p(100|[1-9]?[0-9])")


def is_statistic(name: str) -> bool:
    """Whether there is a statistic of that name: one of `STATISTICS`, or a percentile such as p95."""
    return name in STATISTICS or PERCENTILE.fullmatch(name) is not None


def statistic(name: str, values: Sequence[Number]) -> Number:
    """A statistic of numbers that are not empty cells.

    Args:
        name: for which `is_statistic` holds; a percentile between two numbers is interpolated linearly.
        values: in the order of the frames; at least one, unless they are counted.
    """
    if name in STATISTICS:
        return STATISTICS[name](values)
    return float(np.percentile(np.array(values, np.float64), int(name[1:])))


def totals(rows: Iterable[Row]) -> list[Row]:
    """The rows that stand for all instances together, one a frame; all of a table that does not tell these apart."""
    return [row for row in rows if row.get("instance", TOTAL) == TOTAL]


def numbers(rows: Iterable[Row], name: str) -> list[Number]:
    """The cells of a numeric column that are not empty, in order."""
    return [cell for row in rows if isinstance(cell := row[name], (int, float))]
