"""Builds in stages, for scenes too large for memory: the data that stages exchange, and what a builder must offer.

A stage builds the tree of a region: first of each block of splats, then of regions of several blocks, at last of the
whole scene. It gives parents to the nodes whose siblings must lie in its region, and leaves the other nodes pending,
for the stage of a larger region.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.progress import Progress
from .bounds import Bounds

#: Number of the family of a leaf, which has no children.
NO_FAMILY = -1

#: The number of a family is the number of its stage, shifted by this many bits, plus its index in `StageFamilies`.
STAGE_BITS = 32


@dataclass(frozen=True)
class Region:
    """A half-open box of centres, low <= centre < high, world units; infinite at the borders of the scene."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]


#: Nodes without a parent: (n, ...) columns of `Splats`, as the nodes are drawn, and of the builder, by name. After the
#: last stage: the root, with the number of its family as "family".
Pending = dict[str, NDArray[Any]]


def drawn_splats(pending: Pending) -> Splats:
    """Return pending nodes as they are drawn."""
    return Splats(**{name: pending[name] for name in COLUMNS})


def joined(parts: Sequence[Pending]) -> Pending:
    """Concatenate the pending nodes of stages."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@dataclass(frozen=True, eq=False)
class StageFamilies:
    """Families that a stage made: F parents, and their C children in all.

    The final order is: the root, then the children of all nodes of all stages, by batch and then by key. A node comes
    before its children.

    Attributes:
        batch: (F,) int32, ascending.
        key: (F, words) uint64, ascending within a batch; the first word counts most.
        count: (F,) uint16 number of children, at least 1.
        nodes: (C,) children as they are drawn, family after family.
        family: (C,) int64 number of the family that each child is the parent of, `NO_FAMILY` for a leaf.
        center: (F, 3) float32 centre of the parent, world units.
        size: (F,) float32 feature size of the parent, see `model.gaussian.spark_size`.
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
    """A module that builds trees in stages.

    `plan` is a value of plain numbers and small arrays, which can be pickled.
    """

    def plan(self, bounds: Bounds, sample: Splats, setting: float) -> Any:
        """Return the parameters that all stages share.

        Args:
            sample: splats of the scene at an even stride.
            setting: of the builder, base or growth.

        Raises:
            ValueError: the setting is out of its range.
        """

    def leaves(self, splats: Splats, index: NDArray[np.int64], plan: Any) -> Pending:
        """Return valid, visible splats as pending nodes; `index` (n,) are their places in the scene."""

    def advance(
        self, pending: Pending, region: Region | None, stage: int, plan: Any, *, progress: Progress
    ) -> tuple[StageFamilies, Pending]:
        """Give parents to pending nodes whose siblings must lie in the region; return them and the other nodes.

        Args:
            pending: all pending nodes in the region, concatenated by ascending block; may be emptied.
            region: None for the whole scene, after which only the root is pending.
            stage: number of the stage, a part of the numbers of its families.
        """
