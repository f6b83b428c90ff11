"""The cells of the quick builder: one grid a level for the whole scene, whatever part of it is built."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray
from .check import Bounds
from .kernels.group import level_keys
from .kernels.sort import AXIS_BITS, Keys

#: Largest cell coordinate: they are int64, and their differences must be, too. No level is finer than this allows.
MAX_CELL = 2.0**61

#: Bits per axis of the Morton codes that leaves are sorted by: 51 bits, and at most 11 for the level (sizes are
#: float32, the base is at least 1.1), fit a uint64.
CURVE_BITS = 17


@dataclass(frozen=True)
class VoxelGrid:
    """The levels of a scene, the finest of which is level 0, and their cells.

    Attributes:
        base: growth of the cells from level to level.
        finest: power of the base that is the edge of the cells of level 0.
        coarsest: power of the base that no splat is larger than.
        low, high: corners of the box of all centres, world units.
        largest: size of the largest splat, world units.
    """

    base: float
    finest: int
    coarsest: int
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    largest: float

    @classmethod
    def of(cls, bounds: Bounds, base: float) -> VoxelGrid:
        """The grid of a scene with these bounds."""
        farthest = float(np.abs([bounds.low, bounds.high]).max())
        finest = math.floor(math.log(max(bounds.smallest, farthest / MAX_CELL), base))
        coarsest = max(finest + 1, math.ceil(math.log(bounds.largest, base)) + 1)
        low, high = ((float(x), float(y), float(z)) for x, y, z in (bounds.low, bounds.high))
        return cls(base, finest, coarsest, low, high, bounds.largest)

    @property
    def steps(self) -> NDArray[np.float64]:
        """The edges of the cells of all levels that a splat can belong to."""
        return self.base ** np.arange(self.finest, self.coarsest + 1, dtype=np.float64)

    def step(self, level: int) -> np.float64:
        """The edge of the cells of any level."""
        return np.float64(np.float64(self.base) ** (self.finest + level))

    def cells(self, level: int) -> tuple[np.float64, NDArray[np.int64], int]:
        """The edge of the cells of a level, the lowest cell (3,), and the number of bits of the largest offset from it.

        A mean is in the box of its terms, so the scene's box bounds the cells of all levels.
        """
        step = self.step(level)
        low_cell = np.floor(np.array(self.low) / step).astype(np.int64)
        return (
            step,
            low_cell,
            int((np.floor(np.array(self.high) / step).astype(np.int64) - low_cell).max()).bit_length(),
        )

    def words(self, level: int) -> int:
        """The number of 63-bit words of the Morton codes of a level's cells."""
        return max(1, -(-self.cells(level)[2] // AXIS_BITS))

    def leaf_keys(self, center: FloatArray, scale: FloatArray) -> tuple[Keys, NDArray[np.int32], int]:
        """Keys that order splats by level and along a curve, (n,) their levels, and the number of bits of a key."""
        steps = self.steps
        low, high = np.array(self.low), np.array(self.high)
        edge = max(float((high - low).max()) / (2**CURVE_BITS - 2), float(steps[0]))  # one cell to spare at either end
        low_cell = np.floor(low / edge).astype(np.int64)
        keys, levels = level_keys(center, scale, steps, edge, low_cell, 3 * CURVE_BITS)
        return keys, levels, 3 * CURVE_BITS + len(steps).bit_length()

    @property
    def last_level(self) -> int:
        """The level of the largest splat, the last one that a splat joins at."""
        return max(0, int(np.searchsorted(self.steps, self.largest)))
