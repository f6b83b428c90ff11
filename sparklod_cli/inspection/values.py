"""Statistics of the values of splats."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..lod.kernels.digits import sh_lengths
from ..model.gaussian import spark_size
from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.threads import ordered_map
from ..tables.histograms import Histogram, histogram
from .blocks import Block, ReportBlocks, largest, smallest
from .percentiles import Percentiles
from .value_checks import Ends, ValueTally

#: Coordinates, whose percentiles are those of the box.
AXES = ("x", "y", "z")


class SplatQuantity(NamedTuple):
    """A number of each splat.

    Attributes:
        meaning: for display.
        columns: of `Splats` that it is computed from.
        of: function of N splats to (N,) numbers, some of which may not be finite.
        linear: its histogram has bins of equal width, however many decades the numbers span.
        sh_degree: least SH degree of splats that have it.
    """

    meaning: str
    columns: tuple[str, ...]
    of: Callable[[Splats], FloatArray]
    linear: bool = False
    sh_degree: int = 0


def _component(meaning: str, column: str, at: int) -> SplatQuantity:
    return SplatQuantity(meaning, (column,), lambda splats: getattr(splats, column)[:, at], linear=True)


def _anisotropy(splats: Splats) -> FloatArray:
    return np.divide(largest(splats.scale), smallest(splats.scale), dtype=np.float64)


def _sh(degree: int) -> SplatQuantity:
    def of(splats: Splats) -> FloatArray:
        lengths = np.empty(len(splats), np.float64)
        sh_lengths(splats.sh, COEFFICIENTS[degree - 1], COEFFICIENTS[degree], lengths)
        return lengths

    return SplatQuantity(f"root mean square of the coefficients of degree {degree}", ("sh",), of, sh_degree=degree)


QUANTITIES = {
    **{axis: _component("centres, world units", "center", at) for at, axis in enumerate(AXES)},
    "scale": SplatQuantity(
        "the largest standard deviation, world units", ("scale",), lambda splats: largest(splats.scale)
    ),
    "scale_min": SplatQuantity(
        "the smallest standard deviation, world units", ("scale",), lambda splats: smallest(splats.scale)
    ),
    "anisotropy": SplatQuantity("the largest standard deviation over the smallest", ("scale",), _anisotropy),
    "opacity": SplatQuantity(
        "linear opacity; above 1 for merged splats", ("opacity",), lambda splats: splats.opacity, linear=True
    ),
    "size": SplatQuantity(
        "the feature size by which Spark chooses nodes, world units", ("scale", "opacity"), spark_size
    ),
    **{name: _component("display-referred colour", "rgb", at) for at, name in enumerate(("red", "green", "blue"))},
    **{f"sh{degree}": _sh(degree) for degree in (1, 2, 3)},
}

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
    """Statistics of splats; invalid ones (`splats.INVALID`) are counted but left out of the rest. See `schema.json`."""

    box: Box | None
    box_98: Box | None
    non_finite: int
    negative_scale: int
    zero_opacity: int
    zero_scale: int
    more_than_opaque: int
    quantities: dict[str, dict[str, float | None]]


def names_of(splats: Splats) -> list[str]:
    """Return the names of the quantities of these splats: those of SH by their degree."""
    return [name for name, row in QUANTITIES.items() if row.sh_degree <= splats.sh_degree]


def quantity(splats: Splats, name: str) -> FloatArray:
    """(N,) a quantity by its name; some numbers may not be finite."""
    with np.errstate(all="ignore"):
        return QUANTITIES[name].of(splats)


def histogram_of(splats: Splats, name: str, *, bins: int = 40) -> Histogram:
    """Return the histogram of one of `names_of(splats)`, by its name."""
    return histogram(quantity(splats, name), bins=bins, log=False if QUANTITIES[name].linear else None)


def examine(splats: Splats, *, all_quantities: bool = False) -> ValueFacts:
    """Statistics of N splats in memory."""
    blocks = ReportBlocks.of(Scene(splats))
    tally = ValueTally.total(blocks.map(lambda block: ValueTally.of(block, Ends()), COLUMNS, 1))
    return statistics_of(blocks, tally, all_quantities=all_quantities, threads=1)


def statistics_of(blocks: ReportBlocks, tally: ValueTally, *, all_quantities: bool, threads: int) -> ValueFacts:
    """Statistics of splats, which pass as often as percentiles need.

    Args:
        threads: to work on, each on quantities of some columns, where blocks are in memory.
    """
    none = blocks.about.splats.take(slice(0))
    shown = names_of(none) if all_quantities else MAIN
    numbers = {name: Percentiles(LEVELS, quantity(none, name).dtype) for name in dict.fromkeys((*AXES, *shown))}
    groups: dict[tuple[str, ...], list[str]] = {}
    for name in numbers:
        groups.setdefault(QUANTITIES[name].columns if blocks.in_memory else (), []).append(name)

    def valid_splats(block: Block) -> Splats:
        valid = tally.valid.get(block.start)
        return block.splats if valid is None else block.splats.take(valid)

    def count(names: list[str]) -> None:
        while left := [name for name in names if numbers[name].passes]:
            for splats in blocks.map(valid_splats, {column for name in left for column in QUANTITIES[name].columns}, 1):
                for name in left:
                    numbers[name].add(quantity(splats, name))
            for name in left:
                numbers[name].end_pass()

    for _ in ordered_map(count, groups.values(), threads):
        pass
    box = box_98 = None
    if numbers["x"].count:
        box = Box(_numbers(tally.low), _numbers(tally.high))
        ends = np.array([numbers[axis].values() for axis in AXES])
        box_98 = Box(*(_numbers(ends[:, LEVELS.index(level)]) for level in (1, 99)))
    return ValueFacts(
        box,
        box_98,
        tally.number("non_finite"),
        tally.number("negative_scale"),
        tally.number("transparent"),
        tally.number("without scale"),
        tally.number("opaque"),
        {name: _summary(numbers[name]) for name in shown},
    )


def _summary(numbers: Percentiles) -> dict[str, float | None]:
    if not numbers.count:
        return dict.fromkeys(("min", *PERCENTILES, "max", "mean"))
    levels: dict[str, float | None] = dict(zip(("min", *PERCENTILES, "max"), _numbers(numbers.values()), strict=True))
    return levels | {"mean": _number(numbers.mean)}


def _number(value: Any) -> float:
    return float(f"{float(value):.6g}")


def _numbers(values: NDArray[Any]) -> list[float]:
    return [_number(value) for value in values]
