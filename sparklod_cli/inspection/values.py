"""Statistics of the values of splats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..lod.kernels.digits import sh_lengths
from ..model.gaussian import spark_size
from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import COLUMNS, FloatArray, Splats
from ..support.parallel import ordered_map
from ..tables.histograms import Histogram, histogram
from .blocks import Block, Blocks, largest, smallest
from .percentiles import Known, Percentiles

#: The quantities of a splat by name, as functions of N splats to (N,) numbers. Splats with SH have `SH_QUANTITIES` too.
QUANTITIES: dict[str, Callable[[Splats], FloatArray]] = {
    "x": lambda splats: splats.center[:, 0],
    "y": lambda splats: splats.center[:, 1],
    "z": lambda splats: splats.center[:, 2],
    "scale": lambda splats: largest(splats.scale),
    "scale_min": lambda splats: smallest(splats.scale),
    "anisotropy": lambda splats: np.divide(largest(splats.scale), smallest(splats.scale), dtype=np.float64),
    "opacity": lambda splats: splats.opacity,
    "size": spark_size,
    "red": lambda splats: splats.rgb[:, 0],
    "green": lambda splats: splats.rgb[:, 1],
    "blue": lambda splats: splats.rgb[:, 2],
}
#: Columns of `Splats` that each of them is computed from.
COLUMNS_OF = {
    **dict.fromkeys(("x", "y", "z"), ("center",)),
    **dict.fromkeys(("scale", "scale_min", "anisotropy"), ("scale",)),
    "opacity": ("opacity",),
    "size": ("scale", "opacity"),
    **dict.fromkeys(("red", "green", "blue"), ("rgb",)),
}
#: Root mean square of a splat's SH coefficients of degree 1, 2 and 3.
SH_QUANTITIES = ("sh1", "sh2", "sh3")

#: Quantities whose histograms have bins of equal width, however many decades the numbers span.
LINEAR = ("x", "y", "z", "opacity", "red", "green", "blue")

#: Coordinates, whose percentiles are those of the box.
AXES = ("x", "y", "z")
#: Columns of `Splats` that are counted in; sound splats need no other.
USED = ("center", "scale", "opacity")
#: What is counted, by name.
COUNTED = ("good", "non_finite", "negative_scale", "zero_opacity", "zero_scale", "more_than_opaque")

#: The quantities of a report without --stats.
MAIN = ("scale", "opacity", "anisotropy")
#: Percentiles of a quantity, by name.
PERCENTILES = {"p1": 1, "p25": 25, "p50": 50, "p75": 75, "p99": 99}
#: The same, the least and the largest number.
LEVELS = (0, *PERCENTILES.values(), 100)


@dataclass(frozen=True)
class Box:
    """An axis-aligned box: (3,) lowest and highest corner, world units."""

    min: list[float]
    max: list[float]


@dataclass(frozen=True)
class ValueFacts:
    """Statistics of splats; invalid ones (`splats.INVALID`) are counted but left out of the rest.

    Attributes:
        box: of all centres; None if no splat is valid.
        box_98: from the 1 % to the 99 % quantile of each coordinate.
        non_finite: splats with a number that is not finite.
        negative_scale: splats with a scale below 0.
        zero_opacity, zero_scale: splats that cannot be drawn.
        more_than_opaque: splats with an opacity above 1.
        quantities: min, mean, max and percentiles of each quantity, by name.
    """

    box: Box | None
    box_98: Box | None
    non_finite: int
    negative_scale: int
    zero_opacity: int
    zero_scale: int
    more_than_opaque: int
    quantities: dict[str, dict[str, float | None]]


def names_of(splats: Splats) -> list[str]:
    """The names of the quantities of these splats: those of SH by their degree."""
    return [*QUANTITIES, *SH_QUANTITIES[: splats.sh_degree]]


def needed(sh_degree: int, *, all_quantities: bool) -> list[str]:
    """The names of the quantities whose percentiles a report needs: those of the box first."""
    names = [*QUANTITIES, *SH_QUANTITIES[:sh_degree]] if all_quantities else MAIN
    return list(dict.fromkeys((*AXES, *names)))


def quantity(splats: Splats, name: str) -> FloatArray:
    """(N,) a quantity by its name; some numbers may not be finite."""
    with np.errstate(all="ignore"):
        if name in QUANTITIES:
            return QUANTITIES[name](splats)
        degree, lengths = SH_QUANTITIES.index(name), np.empty(len(splats), np.float64)
        sh_lengths(splats.sh, COEFFICIENTS[degree], COEFFICIENTS[degree + 1], lengths)
        return lengths


def columns_of(name: str) -> tuple[str, ...]:
    """The columns of `Splats` that a quantity is computed from."""
    return COLUMNS_OF.get(name, ("sh",))


def histogram_of(splats: Splats, name: str, *, bins: int = 40) -> Histogram:
    """The histogram of one of `names_of(splats)`, by its name."""
    return histogram(quantity(splats, name), bins=bins, log=False if name in LINEAR else None)


def examine(splats: Splats, *, all_quantities: bool = False) -> ValueFacts:
    """Statistics of N splats in memory, see `Statistics`."""
    blocks, found = Blocks.of(Scene(splats)), Statistics(splats.sh_degree, all_quantities=all_quantities)
    for block in blocks.read(COLUMNS):
        found.merge(found.part_of(block))
    found.finish(blocks, threads=1)
    return found.facts()


class Part(NamedTuple):
    """What is counted of a block.

    Attributes:
        start: of the block.
        valid: (n,) bool; None where all splats are valid.
        good: valid splats.
        non_finite, negative_scale: invalid splats.
        zero_opacity, zero_scale, more_than_opaque: among the valid.
        low, high: (3,) box of their centres.
    """

    start: int
    valid: NDArray[np.bool_] | None
    good: int
    non_finite: int
    negative_scale: int
    zero_opacity: int
    zero_scale: int
    more_than_opaque: int
    low: FloatArray
    high: FloatArray


class Statistics:
    """Statistics of splats: parts of all blocks are added in order, then `finish` makes further passes.

    Args:
        sh_degree: of the splats.
        all_quantities: compute all quantities, not only those of `MAIN`.
    """

    def __init__(self, sh_degree: int, *, all_quantities: bool = False) -> None:
        none = Splats.empty(0, sh_degree)
        self._numbers = {
            name: Percentiles(LEVELS, quantity(none, name).dtype)
            for name in needed(sh_degree, all_quantities=all_quantities)
        }
        self._shown = [name for name in self._numbers if all_quantities or name in MAIN]
        self._low, self._high = np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
        self._counts = dict.fromkeys(COUNTED, 0)
        self._valid: dict[int, NDArray[np.bool_]] = {}  # by the start of each block in which some are not

    @staticmethod
    def part_of(block: Block) -> Part:
        """What is counted of a block with all columns, or with those `USED` where it is sound."""
        invalid = {kind: int(np.count_nonzero(mask)) for kind, mask in block.invalid.items()}
        valid = block.valid if invalid else None
        good = block.splats if valid is None else block.splats.take(valid)
        return Part(
            block.start,
            valid,
            len(good),
            invalid.get("non_finite", 0),
            invalid.get("negative_scale", 0),
            int(np.count_nonzero(good.opacity == 0)),
            int(np.count_nonzero(largest(good.scale) == 0)),
            int(np.count_nonzero(good.opacity > 1)),
            np.array([axis.min(initial=np.inf) for axis in good.center.T]),
            np.array([axis.max(initial=-np.inf) for axis in good.center.T]),
        )

    def merge(self, part: Part) -> None:
        """Adds what was counted of the next block."""
        if part.valid is not None:
            self._valid[part.start] = part.valid
        for name in COUNTED:
            self._counts[name] += getattr(part, name)
        self._low, self._high = np.minimum(self._low, part.low), np.maximum(self._high, part.high)

    def finish(self, blocks: Blocks, *, threads: int) -> None:
        """Passes all blocks as often as percentiles need.

        Args:
            blocks: those whose parts were added.
            threads: to work on, each on quantities of some columns, where blocks are in memory.
        """
        groups: dict[tuple[str, ...], list[str]] = {}
        for name in self._numbers:
            groups.setdefault(columns_of(name) if blocks.at is not None else (), []).append(name)
        for _ in ordered_map(lambda names: self._pass_all(blocks, names), groups.values(), threads):
            pass

    def _pass_all(self, blocks: Blocks, names: list[str]) -> None:
        while left := [name for name in names if self._numbers[name].passes]:
            for block in blocks.read({column for name in left for column in columns_of(name)}):
                valid = self._valid.get(block.start)
                good = block.splats if valid is None else block.splats.take(valid)
                for name in left:
                    self._numbers[name].add(quantity(good, name))
            for name in left:
                self._numbers[name].end_pass()

    def facts(self) -> ValueFacts:
        """What was found."""
        return facts_of(self._counts, self._low, self._high, self._numbers, self._shown)


def facts_of(
    counts: Mapping[str, int],
    low: FloatArray,
    high: FloatArray,
    numbers: Mapping[str, Percentiles | Known],
    shown: Iterable[str],
) -> ValueFacts:
    """What is reported of splats.

    Args:
        counts: of `COUNTED`.
        low, high: (3,) box of the centres of valid splats.
        numbers: of `LEVELS`, of all quantities that are shown and of `AXES`.
        shown: quantities.
    """
    box = box_98 = None
    if counts["good"]:
        box = Box(_numbers(low), _numbers(high))
        places = [LEVELS.index(level) for level in (1, 99)]
        inner_low, inner_high = np.stack([numbers[axis].values()[places] for axis in AXES], axis=1)
        box_98 = Box(_numbers(inner_low), _numbers(inner_high))
    told = {name: counts[name] for name in COUNTED if name != "good"}
    return ValueFacts(box=box, box_98=box_98, quantities={name: _summary(numbers[name]) for name in shown}, **told)


def _summary(numbers: Percentiles | Known) -> dict[str, float | None]:
    if not numbers.count:
        return dict.fromkeys(("min", *PERCENTILES, "max", "mean"))
    levels: dict[str, float | None] = dict(zip(("min", *PERCENTILES, "max"), _numbers(numbers.values()), strict=True))
    return levels | {"mean": _number(numbers.mean)}


def _number(value: Any) -> float:
    return float(f"{float(value):.6g}")


def _numbers(values: NDArray[Any]) -> list[float]:
    return [_number(value) for value in values]
