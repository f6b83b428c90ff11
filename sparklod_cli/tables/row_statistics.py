"""Statistics of the cells of a column of a table."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from ..model.instances import TOTAL
from .columns import Row

Number = int | float

#: Statistics by name, besides the percentiles p0 to p100.
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
    """Whether a name is one of `STATISTICS` or a percentile such as p95."""
    return name in STATISTICS or PERCENTILE.fullmatch(name) is not None


def statistic(name: str, values: Sequence[Number]) -> Number:
    """Return a statistic of the numbers of a column, in the order of the frames; at least one, except for "count".

    It is one of `STATISTICS`, or a percentile such as p95, interpolated linearly.
    """
    if name in STATISTICS:
        return STATISTICS[name](values)
    return float(np.percentile(np.array(values, np.float64), int(name[1:])))


def totals(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of all instances together, one a frame; all rows of a table without a column for instances."""
    return [row for row in rows if row.get("instance", TOTAL) == TOTAL]


def numbers(rows: Iterable[Row], name: str) -> list[Number]:
    """Return the cells of a numeric column that are not empty, in order."""
    return [cell for row in rows if isinstance(cell := row[name], (int, float))]
