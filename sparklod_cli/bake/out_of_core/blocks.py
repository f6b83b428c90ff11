"""Division of a scene into blocks of about as many splats each, and the tree of stages that joins them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...lod.stage_records import Region
from ...model.splats import FloatArray

#: The most regions that are joined at once: those of three splits.
CHILDREN = 8

#: Share of the centres at either end of an axis that is left out of its extent: a few splats of a scan lie far away.
OUTLIERS = 0.02


@dataclass(frozen=True)
class BuildStage:
    """Stage of the build.

    Attributes:
        number: greater than those of its children.
        region: of the scene; None for the whole scene, the last stage.
        block: that the stage builds on; None for a join of other stages.
        children: numbers of the joined stages, in ascending order of their blocks.
        blocks: number of blocks below the stage.
    """

    number: int
    region: Region | None
    block: int | None
    children: tuple[int, ...]
    blocks: int


@dataclass(frozen=True)
class BlockDivision:
    """Division of a scene into blocks.

    Attributes:
        splits: (axis, value, low, high) of each split: centres below the value are on the low side. A side is the
            number of another split, or ~number of a block.
        stages: by number, children first.
    """

    splits: tuple[tuple[int, float, int, int], ...]
    stages: tuple[BuildStage, ...]

    @property
    def count(self) -> int:
        """Number of blocks."""
        return self.stages[-1].blocks

    @property
    def groups(self) -> tuple[range, ...]:
        """Ranges of blocks whose stages have the same parent."""
        parents = {child: stage.number for stage in self.stages for child in stage.children}
        joined = [parents.get(stage.number) for stage in self.stages if stage.block is not None]
        ends = [*(k for k in range(1, self.count) if joined[k] != joined[k - 1]), self.count]
        return tuple(range(start, stop) for start, stop in zip([0, *ends], ends, strict=False))

    def sort(self, center: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Sort splats by their blocks, stably.

        Returns:
            (N,) the splats, and (blocks + 1,) the first one of each block, and N.
        """
        parts: list[NDArray[np.int64]] = [np.empty(0, np.int64)] * self.count
        pending = [(0 if self.splits else ~0, np.arange(len(center)))]
        while pending:
            number, index = pending.pop()
            if number < 0:
                parts[~number] = index
                continue
            axis, value, low, high = self.splits[number]
            below = center[index, axis] < np.float32(value)
            pending += [(low, index[below]), (high, index[~below])]
        return np.concatenate(parts), np.cumsum([0, *map(len, parts)])


@dataclass(frozen=True)
class _Part:
    """Part of a scene: a block, or two halves."""

    side: int
    region: Region
    halves: tuple[_Part, ...] = ()


class _Cut:
    """Division of a scene by a sample of its centres, while it is made."""

    def __init__(self, sample: FloatArray) -> None:
        self.sample = sample
        self.splits: list[tuple[int, float, int, int]] = []
        self.stages: list[BuildStage] = []
        self.blocks = 0

    def part(self, index: NDArray[np.int64], count: int, region: Region) -> _Part:
        """Divide a region, which has these centres of the sample, into at most `count` blocks."""
        split = self._split(index, count) if count > 1 else None
        if split is None:
            self.blocks += 1
            return _Part(~(self.blocks - 1), region)
        axis, value = split
        number = len(self.splits)
        self.splits.append((axis, value, 0, 0))
        below = self.sample[index, axis] < value
        low = self.part(index[below], count // 2, Region(region.low, _moved(region.high, axis, value)))
        high = self.part(index[~below], count - count // 2, Region(_moved(region.low, axis, value), region.high))
        self.splits[number] = (axis, value, low.side, high.side)
        return _Part(number, region, (low, high))

    def _split(self, index: NDArray[np.int64], count: int) -> tuple[int, float] | None:
        """Return the axis and the value of a split; None if all centres are the same."""
        center = self.sample[index]
        if not len(center):
            return None
        low, high = np.quantile(center, [OUTLIERS, 1 - OUTLIERS], axis=0)
        whole = np.ptp(center, axis=0)
        for axis in sorted(range(3), key=lambda axis: (low[axis] - high[axis], -whole[axis])):
            values = np.sort(center[:, axis])
            if values[0] < values[-1]:
                value = values[len(values) * (count // 2) // count]
                return axis, float(max(value, values[np.searchsorted(values, values[0], "right")]))
        return None

    def stage(self, part: _Part, region: Region | None) -> BuildStage:
        """Make the stages of a part; the last one has this region."""
        below = [self.stage(each, each.region) for each in _joined(part)] if part.halves else []
        stage = BuildStage(
            number=len(self.stages),
            region=region,
            block=None if part.halves else ~part.side,
            children=tuple(each.number for each in below),
            blocks=sum(each.blocks for each in below) or 1,
        )
        self.stages.append(stage)
        return stage


def _joined(part: _Part) -> list[_Part]:
    """Return the parts, at most `CHILDREN`, that one stage joins."""
    parts = [part]
    for _ in range(int(math.log2(CHILDREN))):
        parts = [half for each in parts for half in each.halves or (each,)]
    return parts


def _moved(corner: tuple[float, float, float], axis: int, value: float) -> tuple[float, float, float]:
    x, y, z = (value if each == axis else corner[each] for each in range(3))
    return x, y, z


def cut_into_blocks(sample: FloatArray, count: int, block_splats: int) -> BlockDivision:
    """Divide a scene into blocks of about `block_splats` at most, by a sample of its centres.

    Args:
        sample: (n, 3) centres, evenly drawn; without any, the scene is one block.
        block_splats: at least 1.
    """
    cut = _Cut(sample)
    everywhere = Region((-math.inf,) * 3, (math.inf,) * 3)
    whole = cut.part(np.arange(len(sample)), -(-count // block_splats), everywhere)
    cut.stage(whole, None)
    return BlockDivision(tuple(cut.splits), tuple(cut.stages))
