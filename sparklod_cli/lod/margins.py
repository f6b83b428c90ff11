"""Where nodes can be that a stage of the quick builder does not know: outside of its region, and in a margin of it."""

from __future__ import annotations

import math

import numpy as np

from ..model.splats import FloatArray
from .kernels.group import split_box
from .kernels.sort import Nodes
from .voxel_grid import VoxelGrid

FARTHEST = np.float32(np.finfo(np.float32).max)
INFINITY = np.float32(np.inf)

Corner = tuple[float, float, float]


class Margins:
    """The centres that unknown nodes can have: on some axis, at most `below` or at least `above`."""

    def __init__(self, grid: VoxelGrid, low: Corner, high: Corner) -> None:
        """Before the first level: whatever is not within low <= centre < high, which may be infinite."""
        self._grid = grid
        self._below = [_before(_first_from(value)) for value in low]
        self._above = [_first_from(value) for value in high]

    def widen(self, level: int) -> None:
        """Takes the whole cells of a level that unknown nodes can be in; called for one level after another."""
        step = float(self._grid.step(level))
        for axis in range(3):
            below, above = self._below[axis], self._above[axis]
            # No centre lies outside of the box of the scene, known or unknown.
            has_below, has_above = below >= self._grid.low[axis], above <= self._grid.high[axis]
            self._below[axis] = _last_of_cell(math.floor(float(below) / step), step) if has_below else -INFINITY
            self._above[axis] = _first_of_cell(math.floor(float(above) / step), step) if has_above else INFINITY

    @property
    def are_closed(self) -> bool:
        """Whether no centre in the box of the scene is off the margins."""
        sides = zip(self._below, self._above, self._grid.low, self._grid.high, strict=True)
        return any(float(below) >= min(float(above), high) or float(above) <= low for below, above, low, high in sides)

    def split(self, nodes: Nodes, geometry: FloatArray) -> tuple[Nodes, Nodes]:
        """Separates nodes off the margins, whose cells no unknown node can be in, from the others."""
        return split_box(nodes, geometry, np.array(self._below), np.array(self._above))


def _first_from(value: float) -> np.float32:
    """The least float32 that is not below a number."""
    if math.isinf(value):
        return np.float32(value)
    near = np.float32(min(max(value, -float(FARTHEST)), float(FARTHEST)))
    return np.nextafter(near, INFINITY) if float(near) < value else near


def _before(value: np.float32) -> np.float32:
    return np.nextafter(value, -INFINITY)


def _last_of_cell(cell: int, step: float) -> np.float32:
    """The largest float32 in a cell of an axis or in one below it."""
    near = np.float32(min(max((cell + 1) * step, -float(FARTHEST)), float(FARTHEST)))
    while near > -FARTHEST and math.floor(float(near) / step) > cell:
        near = _before(near)
    while near < FARTHEST and math.floor(float(after := np.nextafter(near, INFINITY)) / step) <= cell:
        near = after
    return near


def _first_of_cell(cell: int, step: float) -> np.float32:
    """The least float32 in a cell of an axis or in one above it."""
    return np.nextafter(_last_of_cell(cell - 1, step), INFINITY)
