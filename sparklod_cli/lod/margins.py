"""Where nodes can be that a stage of the quick builder does not know: outside of its region, and in a margin of it."""

from __future__ import annotations

import math

import numpy as np

from ..model.splats import FloatArray
from .kernels.group import split_box
from .kernels.sort import Nodes
from .voxel_grid import PARTS, VoxelGrid

FARTHEST = np.float32(np.finfo(np.float32).max)
INFINITY = np.float32(np.inf)

Corner = tuple[float, float, float]


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
        """Takes the whole cells of a level that unknown nodes can be in; called for one level after another."""
        edge, shift = float(self._grid.part_edge(level)), self._grid.shift(level).tolist()
        for axis in range(3):
            below, above = self._below[axis], self._above[axis]
            # No centre lies outside of the box of the scene, known or unknown.
            has_below, has_above = below >= self._low[axis], above <= self._high[axis]
            last = _first_part(float(below), edge, shift[axis]) + PARTS - 1 if has_below else 0
            first = _first_part(float(above), edge, shift[axis]) if has_above else 0
            self._below[axis] = _last_of_part(last, edge) if has_below else -INFINITY
            self._above[axis] = _first_of_part(first, edge) if has_above else INFINITY

    @property
    def are_closed(self) -> bool:
        """Whether no centre in the box of the scene is off the margins."""
        sides = zip(self._below, self._above, self._low, self._high, strict=True)
        return any(float(below) >= min(float(above), high) or float(above) <= low for below, above, low, high in sides)

    def split(self, nodes: Nodes, geometry: FloatArray) -> tuple[Nodes, Nodes]:
        """Separates nodes off the margins, whose cells no unknown node can be in, from the others."""
        return split_box(nodes, geometry, np.array(self._below), np.array(self._above))


def _rounded(value: float) -> np.float32:
    """The nearest float32, which may be infinite."""
    return np.float32(value if math.isinf(value) else min(max(value, -float(FARTHEST)), float(FARTHEST)))


def _first_part(value: float, edge: float, shift: int) -> int:
    """The first part of the cell that a coordinate is in."""
    return (math.floor(value / edge) - shift) // PARTS * PARTS + shift


def _last_of_part(part: int, edge: float) -> np.float32:
    """The largest float32 in a part of an axis or in one below it."""
    near = np.float32(min(max((part + 1) * edge, -float(FARTHEST)), float(FARTHEST)))
    while near > -FARTHEST and math.floor(float(near) / edge) > part:
        near = np.nextafter(near, -INFINITY)
    while near < FARTHEST and math.floor(float(after := np.nextafter(near, INFINITY)) / edge) <= part:
        near = after
    return near


def _first_of_part(part: int, edge: float) -> np.float32:
    """The least float32 in a part of an axis or in one above it."""
    return np.nextafter(_last_of_part(part - 1, edge), INFINITY)
