"""Splats as rows of one matrix, so that a range of them is one piece of a file rather than six."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...model.sh import COEFFICIENTS, degree_of
from ...model.splats import COLUMNS, Splats
from ...support.parallel import for_blocks

#: (N, `width_of`) float32: centre, scale, rotation, opacity, rgb and SH of a splat, in the order of `COLUMNS`.
Rows = NDArray[np.float32]


def width_of(sh_degree: int) -> int:
    """Numbers of a row."""
    return 14 + 3 * COEFFICIENTS[sh_degree]


def rows_of(splats: Splats, threads: int = 1) -> Rows:
    """The rows of splats."""
    rows = np.empty((len(splats), width_of(splats.sh_degree)), np.float32)
    fill_rows(splats, rows, threads)
    return rows


def fill_rows(splats: Splats, rows: Rows, threads: int = 1) -> None:
    """Fills rows with splats."""
    places = _places(splats)

    def fill(block: slice) -> None:
        for part, column in places:
            rows[block, part] = column[block]

    for_blocks(fill, len(rows), threads, _nothing)


def splats_of(rows: Rows, threads: int = 1) -> Splats:
    """The splats of rows."""
    splats = Splats.empty(len(rows), degree_of((rows.shape[1] - width_of(0)) // 3))
    places = _places(splats)

    def fill(block: slice) -> None:
        for part, column in places:
            column[block] = rows[block, part]

    for_blocks(fill, len(rows), threads, _nothing)
    return splats


def _nothing(done: int) -> None:
    """Nobody is told."""


def _places(splats: Splats) -> list[tuple[slice, Rows]]:
    """Each column as a matrix, a view of it, and where it is in a row."""
    places, at = [], 0
    for name in COLUMNS:
        column = getattr(splats, name)
        numbers = math.prod(column.shape[1:])
        places.append((slice(at, at + numbers), column.reshape(len(splats), numbers)))
        at += numbers
    return places
