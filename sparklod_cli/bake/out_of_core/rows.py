"""Splats as rows of one matrix, so that a range of them is one piece of a file rather than six."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...model.sh import COEFFICIENTS, degree_of
from ...model.splats import COLUMNS, Splats

#: (N, `width_of`) float32: centre, scale, rotation, opacity, rgb and SH of a splat, in the order of `COLUMNS`.
Rows = NDArray[np.float32]


def width_of(sh_degree: int) -> int:
    """Numbers of a row."""
    return 14 + 3 * COEFFICIENTS[sh_degree]


def rows_of(splats: Splats) -> Rows:
    """The rows of splats."""
    rows = np.empty((len(splats), width_of(splats.sh_degree)), np.float32)
    fill_rows(splats, rows)
    return rows


def fill_rows(splats: Splats, rows: Rows) -> None:
    """Fills rows with splats."""
    for part, column in _places(splats):
        rows[:, part] = column


def splats_of(rows: Rows) -> Splats:
    """The splats of rows."""
    splats = Splats.empty(len(rows), degree_of((rows.shape[1] - width_of(0)) // 3))
    for part, column in _places(splats):
        column[...] = rows[:, part]
    return splats


def _places(splats: Splats) -> list[tuple[slice, Rows]]:
    """Each column as a matrix, a view of it, and where it is in a row."""
    places, at = [], 0
    for name in COLUMNS:
        column = getattr(splats, name)
        numbers = math.prod(column.shape[1:])
        places.append((slice(at, at + numbers), column.reshape(len(splats), numbers)))
        at += numbers
    return places
