"""The Morton curve along which the quality builder looks for pairs, and the coordinates of its node rows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...model.splats import FloatArray, Splats
from ..check import Bounds
from ..kernels import node_rows, pair_cost
from ..kernels.curve_sort import sort_along_curve
from ..kernels.geometry import SplatColumns
from ..kernels.sort import Keys, Nodes

#: Sample size for the scene's middle, unit and box. Chosen.
SAMPLE = 1 << 14

#: Share of the leaves outside the curve's box on either side of an axis, as scenes have a few far away. Chosen.
OUTSIDE = 0.005

#: How much wider the curve's box is than the scene, as a share of its edge, which leaves room to shift it. From round
#: to round it is shifted by the golden section, so that no two rounds have the same seams. Chosen.
SLACK, GOLDEN = 0.3, 0.6180339887

#: Largest coordinate and size, units: float32 holds its square. Chosen.
FARTHEST = 1e15


@dataclass(frozen=True)
class Curve:
    """The coordinates of node rows, and the box of the Morton curve.

    Attributes:
        middle: (3,) origin, near the middle of the scene, world units.
        unit: length of a unit, world units.
        low: (3,) lowest corner of the box, in units.
        extent: edge of the box, in units.
    """

    middle: NDArray[np.float64]
    unit: float
    low: NDArray[np.float64]
    extent: float

    @classmethod
    def of(cls, splats: Splats, bounds: Bounds) -> Curve:
        """Around most of the splats; the unit is a power of two near their median scale, or as FARTHEST requires."""
        some = slice(None, None, max(1, len(splats) // SAMPLE))
        center = splats.center[some].astype(np.float64)
        middle = np.median(center, axis=0)
        reach = max(float((bounds.high - bounds.low).max()), bounds.largest) / FARTHEST
        unit = 2.0 ** round(math.log2(max(float(np.median(splats.scale[some].max(axis=1).astype(np.float64))), reach)))
        return cls(middle, unit, middle, 1.0).around(center)

    def around(self, center: FloatArray) -> Curve:
        """The same coordinates, with a box around most of (n, 3) centres in world units."""
        some = slice(None, None, max(1, len(center) // SAMPLE))
        units = (center[some].astype(np.float64) - self.middle) / self.unit
        low, high = np.quantile(units, [OUTSIDE, 1 - OUTSIDE], axis=0)
        return replace(self, low=low, extent=float(max((high - low).max(), 1.0)))

    @property
    def space(self) -> node_rows.Space:
        """The coordinates, for kernels."""
        return node_rows.Space(self.middle, self.unit)

    def order(self, center: FloatArray, threads: int) -> Nodes:
        """(n,) places of (n, 3) centres, in world units, along the curve of the first round."""
        units = np.subtract(center, self.middle, dtype=np.float64)
        units /= self.unit
        everything = np.arange(len(center), dtype=np.uint32)
        return self.sort(units.astype(np.float32), everything[:0], everything, 0, threads)[0]

    def leaf_rows(self, splats: Splats, index: Nodes) -> tuple[FloatArray, FloatArray]:
        """(n, WIDTH) node rows and (n,) feature sizes, in units, of some splats."""
        rows, size = np.empty((len(index), pair_cost.WIDTH), np.float32), np.empty(len(index), np.float32)
        columns = SplatColumns(splats.center, splats.scale, splats.quat_xyzw, splats.opacity)
        node_rows.fill_leaf_rows(index, columns, splats.rgb, self.space, rows, size)
        return rows, size

    def sort(self, rows: FloatArray, row: Nodes, nodes: Nodes, turn: int, threads: int) -> tuple[Nodes, Nodes]:
        """Sorts nodes along the curve of a round.

        Args:
            rows: (N, ...) node rows, as many as there are leaves.
            row: (N,) uint32 row of each merged node; that of a leaf is its own.
            nodes: (n,) uint32.
            turn: number of the round.
            threads: number of threads.

        Returns:
            (n,) uint32 nodes, and (n,) uint32 their rows.
        """
        return sort_along_curve(rows, row, len(rows), nodes, *self._grid(turn), threads)

    def keys(self, rows: FloatArray, at: Nodes, turn: int) -> Keys:
        """(n,) Morton codes of rows on the curve of a round."""
        return node_rows.morton_keys(rows, at, *self._grid(turn))

    def _grid(self, turn: int) -> tuple[NDArray[np.float64], float]:
        """The lowest corner of the curve's box in a round, and the edge of a cell, units."""
        shift = np.modf(np.array([1, 2, 3]) * GOLDEN * turn)[0] * SLACK * self.extent
        return self.low - shift, (1 + SLACK) * self.extent / (1 << node_rows.CURVE_BITS)
