"""Input check of builders, and records of builds in stages, block by block where a scene does not fit into memory.

A stage takes the nodes of a region that have no parent yet, gives parents to the nodes whose siblings cannot lie
outside of it, and hands on the others: first for each block of splats, then for regions of several blocks, and at last
for the whole scene.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.errors import InvalidSplatsError
from ..system.progress import Progress
from ..system.threads import BLOCK_ROWS, threads_for
from .kernels.geometry import find_bounds
from .kernels.sort import PART_BITS, Nodes, Parts, split_box

#: Message on splats without an opacity or a size, which a selection should have dropped.
INVISIBLE = "a splat is without opacity or scale: see Selection.apply"


@dataclass(frozen=True)
class Bounds:
    """Bounds of a scene's splats.

    Attributes:
        low, high: (3,) float64 corners of the box of their centres, world units.
        smallest, largest: range of their sizes, 2 * max(scale), world units.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    smallest: float
    largest: float

    @classmethod
    def of(cls, splats: Splats) -> Bounds:
        """Return the bounds of splats; without any, the box is from infinity to minus infinity."""
        low, high = np.empty((2, -(-len(splats) // BLOCK_ROWS), 4))
        find_bounds(len(low), splats.center, splats.scale, low, high)
        least, most = low.min(axis=0, initial=np.inf), high.max(axis=0, initial=-np.inf)
        return cls(least[:3], most[:3], 2 * float(least[3]), 2 * float(most[3]))


def check(splats: Splats) -> Bounds:
    """Return the bounds of valid splats; raise `InvalidSplatsError` without any, or if one is invisible."""
    if len(splats) == 0:
        raise InvalidSplatsError("no splat is left to build a tree of")
    with threads_for(len(splats)):
        bounds = Bounds.of(splats)
    if not (bounds.smallest > 0 and splats.opacity.min() > 0):
        raise InvalidSplatsError(INVISIBLE)
    return bounds


#: Number of the family of a leaf, which has no children.
NO_FAMILY = -1

#: A family's number is that of its stage, shifted by this many bits, and its place among the families of the stage.
STAGE_BITS = 32

#: Parts of a cell on an axis.
CELL_PARTS = 1 << PART_BITS

FLOAT_MAX = np.float32(np.finfo(np.float32).max)
INFINITY = np.float32(np.inf)


@dataclass(frozen=True)
class Region:
    """A half-open box of centres, low <= centre < high, world units; infinite at the borders of the scene."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Pending:
    """Nodes without a parent: (n, ...) arrays by name, of `Splats` as nodes are drawn, and others of the builder."""

    columns: Mapping[str, NDArray[Any]]

    @classmethod
    def of(cls, splats: Splats, **columns: NDArray[Any]) -> Pending:
        """Return nodes by how they are drawn, and their other columns."""
        return cls({**{name: getattr(splats, name) for name in COLUMNS}, **columns})

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    @property
    def splats(self) -> Splats:
        """Nodes as they are drawn."""
        return Splats(**{name: self.columns[name] for name in COLUMNS})

    @classmethod
    def concat(cls, parts: list[Pending]) -> Pending:
        """Return all parts in order."""
        return cls({name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns})


@dataclass(frozen=True, eq=False)
class StageFamilies:
    """The children that a stage gave to F nodes, in the order of the tree.

    In the tree the root comes first, then all families of all stages by batch and then by key: that of a node comes
    after the node itself.

    Attributes:
        batch: (F,) int32, ascending.
        key: (F, words) uint64, ascending within a batch; the first word counts most.
        count: (F,) uint16 number of children, at least 1.
        nodes: (C,) the children of one family after the other, as they are drawn.
        family: (C,) int64 number of the family of each of these nodes, `NO_FAMILY` for a leaf.
        center: (F, 3) float32 of the node whose children they are, world units.
        size: (F,) float32 feature size of that node, as `model.gaussian.spark_size` has it.
    """

    batch: NDArray[np.int32]
    key: NDArray[np.uint64]
    count: NDArray[np.uint16]
    nodes: Splats
    family: NDArray[np.int64]
    center: FloatArray
    size: FloatArray

    def __len__(self) -> int:
        return len(self.count)


class StagedBuilder(Protocol):
    """A builder in stages: a module with these functions.

    `plan` is a value of plain numbers and small arrays, the same for all stages, which can be pickled.
    """

    def plan(self, bounds: Bounds, sample: Splats, setting: float) -> Any:
        """Return the values that all stages share.

        Args:
            sample: an even sample of the splats of the scene, in their order.
            setting: of the builder, base or growth.

        Raises:
            ValueError: the setting is out of its range.
        """

    def leaves(self, splats: Splats, index: NDArray[np.int64], plan: Any) -> Pending:
        """Return valid, visible splats as nodes without a parent; `index` (n,) has their places in the scene."""

    def advance(
        self, pending: Pending, region: Region | None, stage: int, plan: Any, *, progress: Progress
    ) -> tuple[StageFamilies, Pending]:
        """Give parents to nodes whose siblings cannot be outside of the region.

        Args:
            pending: all nodes without a parent whose centres lie in the region, from blocks in ascending order.
            region: None for the whole scene, after which only the root is left.
            stage: number of the stage, which is part of the numbers of its families.
        """


class Margins:
    """The centres that unknown nodes can have: on some axis, at most `below` or at least `above`; in units.

    Outside of a region and near its faces, the quick builder does not know all nodes of a stage.
    """

    def __init__(self, box: NDArray[np.float64], unit: float, region: Region) -> None:
        """Before the first level: all centres that are not in the region.

        Args:
            box: (2, 3) corners of the box of all centres of the scene, units.
            unit: length of a unit, world units.
        """
        self._low, self._high = box.tolist()
        # As centres of rows are rounded, if at all.
        self._below = [_rounded(value / unit) for value in region.low]
        self._above = [_rounded(value / unit) for value in region.high]

    def widen(self, parts: Parts) -> None:
        """Take the whole cells of a level that unknown nodes can be in; called for one level after another."""
        edge = float(parts.step)
        for axis, lowest in enumerate(parts.low.tolist()):
            below, above = self._below[axis], self._above[axis]
            # No centre lies outside of the box of the scene, known or unknown.
            has_below, has_above = below >= self._low[axis], above <= self._high[axis]
            last = _first_part(float(below), edge, lowest) + CELL_PARTS - 1 if has_below else 0
            first = _first_part(float(above), edge, lowest) if has_above else 0
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


def _first_part(value: float, edge: float, lowest: int) -> int:
    """Return the first part of the cell that a coordinate is in; `lowest` is the first part of any cell."""
    return (math.floor(value / edge) - lowest) // CELL_PARTS * CELL_PARTS + lowest


def _last_of_part(part: int, edge: float) -> np.float32:
    """Return the largest float32 in a part of an axis or in one below it."""
    near = np.float32(min(max((part + 1) * edge, -float(FLOAT_MAX)), float(FLOAT_MAX)))
    while near > -FLOAT_MAX and math.floor(float(near) / edge) > part:
        near = np.nextafter(near, -INFINITY)
    while near < FLOAT_MAX and math.floor(float(after := np.nextafter(near, INFINITY)) / edge) <= part:
        near = after
    return near
