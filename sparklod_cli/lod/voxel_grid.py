"""The cells of the quick builder: one grid a level for the whole scene, whatever part of it is built.

Nodes of a level are about base ** level large. A cell is wider, so that it holds several of them to choose from, and is
divided into parts, along which its nodes are sorted. From level to level the grid is shifted, and its seams with it.

`Margins` are where nodes can be that a stage of the builder does not know: outside of its region, and near its faces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray
from .check import Bounds
from .kernels.node_rows import Space
from .kernels.sort import PART_BITS, Nodes, Parts, fill_level_keys, sort_by_key, split_box

#: Largest coordinate in steps of a level: parts are half a step wide, their coordinates int64, and so must be their
#: differences. No level is finer than this allows.
MAX_STEPS = 2.0**59

#: Edge of a cell in steps of its level. Chosen; 8 is no better (benchmarks/notes/quick-builder.md).
CELL = 4

#: Parts of a cell on an axis.
PARTS = 1 << PART_BITS

#: The grid is shifted from level to level by these shares of a cell on the three axes: powers of the golden section,
#: so that seams hardly ever recur.
SHIFT = (0.38196601, 0.76393202, 0.14589803)

#: The largest size of a merged node, in steps of its level; a node's size is about 2 * sqrt(trace of its covariance /
#: 3). Chosen; what matters is the number of rounds (`kernels/cell_pairs.py`).
LIMIT = 0.7

#: Largest coordinate and size, units: float32 holds its square. Chosen.
FARTHEST = 1e15

#: Bits per axis of the Morton codes that leaves are sorted by: 51 bits, and at most 11 for the level (sizes are
#: float32, the base is at least 1.1), fit a uint64.
CURVE_BITS = 17

FLOAT_MAX = np.float32(np.finfo(np.float32).max)
INFINITY = np.float32(np.inf)
Corner = tuple[float, float, float]


@dataclass(frozen=True)
class VoxelGrid:
    """The levels of a scene, the finest of which is level 0, and their cells.

    Attributes:
        base: growth of the cells from level to level.
        finest: power of the base that is the edge of the cells of level 0.
        coarsest: power of the base that no splat is larger than.
        low, high: corners of the box of all centres, world units.
        largest: size of the largest splat, world units.
        unit: length of a unit of node rows, world units; a power of two, so that centres are divided by it exactly.
    """

    base: float
    finest: int
    coarsest: int
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    largest: float
    unit: float

    @classmethod
    def of(cls, bounds: Bounds, base: float) -> VoxelGrid:
        """Return the grid of a scene with these bounds."""
        farthest = float(np.abs([bounds.low, bounds.high]).max())
        finest = math.floor(math.log(max(bounds.smallest, farthest / MAX_STEPS), base))
        coarsest = max(finest + 1, math.ceil(math.log(bounds.largest, base)) + 1)
        low, high = ((float(x), float(y), float(z)) for x, y, z in (bounds.low, bounds.high))
        middle = math.sqrt(bounds.smallest) * math.sqrt(bounds.largest)
        unit = 2.0 ** round(math.log2(max(middle, farthest / FARTHEST, bounds.largest / FARTHEST)))
        return cls(base, finest, coarsest, low, high, bounds.largest, unit)

    @property
    def space(self) -> Space:
        """The coordinates of node rows."""
        return Space(np.zeros(3), np.float64(self.unit))

    @property
    def steps(self) -> NDArray[np.float64]:
        """The steps of all levels that a splat can belong to, world units."""
        return self.base ** np.arange(self.finest, self.coarsest + 1, dtype=np.float64)

    def step(self, level: int) -> np.float64:
        """Return the step of any level, in units."""
        return np.float64(np.float64(self.base) ** (self.finest + level) / self.unit)

    def largest_trace(self, level: int) -> np.float32:
        """Return the largest trace of the covariance of a node merged at a level, units squared; may be infinite."""
        size = LIMIT * float(self.step(level))
        return np.float32(0.75 * size * size if size < FARTHEST**1.2 else math.inf)

    def edge_and_shift(self, level: int) -> tuple[np.float64, NDArray[np.int64]]:
        """Return the edge of the parts of a level, units, and how many its grid is shifted: fewer than a cell has."""
        shift = np.floor(np.array(SHIFT) * level % 1 * PARTS).astype(np.int64)
        return self.step(level) * np.float64(CELL / PARTS), shift

    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the corners of the box of all centres, in units, as rows hold them."""
        low, high = (np.array(corner) / self.unit for corner in (self.low, self.high))
        return low.astype(np.float32).astype(np.float64), high.astype(np.float32).astype(np.float64)

    def parts(self, level: int) -> Parts:
        """Return the parts of a level; the scene's box bounds all, as a mean is in the box of its terms."""
        edge, shift = self.edge_and_shift(level)
        low, high = (np.floor(corner / edge).astype(np.int64) for corner in self.box())
        lowest = (low - shift) // PARTS * PARTS + shift
        return Parts(edge, lowest, int((high - lowest).max()).bit_length())

    def sorted_leaves(
        self, center: FloatArray, scale: FloatArray, threads: int, order: Nodes | None = None
    ) -> tuple[Nodes, NDArray[np.int64]]:
        """Return the splats by level and then along a curve, and where each level ends.

        Args:
            center, scale: (n, 3) of the splats.
            order: (n,) the splats in the order of the scene; by default they are in it.
        """
        steps = self.steps
        low, high = np.array(self.low), np.array(self.high)
        edge = max(float((high - low).max()) / (2**CURVE_BITS - 2), float(steps[0]))  # one cell to spare at either end
        low_cell = np.floor(low / edge).astype(np.int64)
        keys, levels = np.empty(len(scale), np.uint64), np.empty(len(scale), np.int32)
        fill_level_keys(len(scale), center, scale, steps, edge, low_cell, 3 * CURVE_BITS, keys, levels)
        ends = np.cumsum(np.bincount(levels))
        del levels
        if order is None:
            order = np.arange(len(center), dtype=np.uint32)
        else:
            keys = keys[order]
        return sort_by_key(keys, order, 3 * CURVE_BITS + len(steps).bit_length(), threads)[1], ends


class Margins:
    """The centres that unknown nodes can have: on some axis, at most `below` or at least `above`; in units."""

    def __init__(self, grid: VoxelGrid, low: Corner, high: Corner) -> None:
        """Before the first level: whatever is not within low <= centre < high, world units, which may be infinite."""
        self._grid = grid
        self._low, self._high = (corner.tolist() for corner in grid.box())
        # As centres of rows are rounded, if at all.
        self._below = [_rounded(value / grid.unit) for value in low]
        self._above = [_rounded(value / grid.unit) for value in high]

    def widen(self, level: int) -> None:
        """Take the whole cells of a level that unknown nodes can be in; called for one level after another."""
        width, shift = self._grid.edge_and_shift(level)
        edge = float(width)
        for axis in range(3):
            below, above = self._below[axis], self._above[axis]
            # No centre lies outside of the box of the scene, known or unknown.
            has_below, has_above = below >= self._low[axis], above <= self._high[axis]
            last = _first_part(float(below), edge, shift[axis]) + PARTS - 1 if has_below else 0
            first = _first_part(float(above), edge, shift[axis]) if has_above else 0
            self._below[axis] = _last_of_part(last, edge) if has_below else -INFINITY
            self._above[axis] = np.nextafter(_last_of_part(first - 1, edge), INFINITY) if has_above else INFINITY

    @property
    def are_closed(self) -> bool:
        """Whether no centre in the box of the scene is off the margins."""
        sides = zip(self._below, self._above, self._low, self._high, strict=True)
        return any(float(below) >= min(float(above), high) or float(above) <= low for below, above, low, high in sides)

    def split(self, nodes: Nodes, geometry: FloatArray) -> tuple[Nodes, Nodes]:
        """Separate nodes off the margins, whose cells no unknown node can be in, from the others."""
        return split_box(nodes, geometry, np.array(self._below), np.array(self._above))


def _rounded(value: float) -> np.float32:
    """Return the nearest float32, which may be infinite."""
    return np.float32(value if math.isinf(value) else min(max(value, -float(FLOAT_MAX)), float(FLOAT_MAX)))


def _first_part(value: float, edge: float, shift: int) -> int:
    """Return the first part of the cell that a coordinate is in."""
    return (math.floor(value / edge) - shift) // PARTS * PARTS + shift


def _last_of_part(part: int, edge: float) -> np.float32:
    """Return the largest float32 in a part of an axis or in one below it."""
    near = np.float32(min(max((part + 1) * edge, -float(FLOAT_MAX)), float(FLOAT_MAX)))
    while near > -FLOAT_MAX and math.floor(float(near) / edge) > part:
        near = np.nextafter(near, -INFINITY)
    while near < FLOAT_MAX and math.floor(float(after := np.nextafter(near, INFINITY)) / edge) <= part:
        near = after
    return near
