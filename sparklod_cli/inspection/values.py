"""Statistics of the values of splats."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import spark_size
from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import COLUMNS, FloatArray, Splats
from ..tables.histograms import Histogram, histogram
from .blocks import Block, Blocks
from .percentiles import Percentiles

#: The quantities of a splat by name, as functions of N splats to (N,) numbers. Splats with SH have `SH_QUANTITIES` too.
QUANTITIES: dict[str, Callable[[Splats], FloatArray]] = {
    "x": lambda splats: splats.center[:, 0],
    "y": lambda splats: splats.center[:, 1],
    "z": lambda splats: splats.center[:, 2],
    "scale": lambda splats: splats.scale.max(axis=1),
    "scale_min": lambda splats: splats.scale.min(axis=1),
    "anisotropy": lambda splats: splats.scale.max(axis=1).astype(np.float64) / splats.scale.min(axis=1),
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

#: The quantities of a report without --stats.
MAIN = ("scale", "opacity", "anisotropy")
#: Percentiles of a quantity, by name.
PERCENTILES = {"p1": 1, "p25": 25, "p50": 50, "p75": 75, "p99": 99}


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


def quantity(splats: Splats, name: str) -> FloatArray:
    """(N,) a quantity by its name; some numbers may not be finite."""
    with np.errstate(all="ignore"):
        if name in QUANTITIES:
            return QUANTITIES[name](splats)
        degree = SH_QUANTITIES.index(name)
        return np.sqrt(
            np.square(splats.sh[:, COEFFICIENTS[degree] : COEFFICIENTS[degree + 1]], dtype=np.float64).mean((1, 2))
        )


def columns_of(name: str) -> tuple[str, ...]:
    """The columns of `Splats` that a quantity is computed from."""
    return COLUMNS_OF.get(name, ("sh",))


def histogram_of(splats: Splats, name: str, *, bins: int = 40) -> Histogram:
    """The histogram of one of `names_of(splats)`, by its name."""
    return histogram(quantity(splats, name), bins=bins, log=False if name in LINEAR else None)


def examine(splats: Splats, *, all_quantities: bool = False) -> ValueFacts:
    """Statistics of N splats in memory, see `Statistics`."""
    blocks, found = Blocks.of(Scene(splats)), Statistics(splats.sh_degree, all_quantities=all_quantities)
    while found.passes:
        for block in blocks.read(COLUMNS):
            found.add(block)
        found.end_pass()
    return found.facts()


class Statistics:
    """Statistics of splats that pass block by block, as often as `passes` says.

    Args:
        sh_degree: of the splats.
        all_quantities: compute all quantities, not only those of `MAIN`.
    """

    def __init__(self, sh_degree: int, *, all_quantities: bool = False) -> None:
        none = Splats.empty(0, sh_degree)
        self._numbers = {
            name: Percentiles((0, *PERCENTILES.values(), 100), quantity(none, name).dtype)
            for name in (names_of(none) if all_quantities else MAIN)
        }
        self._center = [Percentiles((1, 99), np.float32) for _ in range(3)]
        self._low, self._high = np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
        self._counts = dict.fromkeys(("good", "non_finite", "negative_scale"), 0)
        self._counts |= dict.fromkeys(("zero_opacity", "zero_scale", "more_than_opaque"), 0)
        self._valid: dict[int, NDArray[np.bool_]] = {}  # by the start of each block in which some are not
        self._first = True

    @property
    def passes(self) -> int:
        """How often all blocks have to pass from here on."""
        return int(self._first) or max(each.passes for each in (*self._center, *self._numbers.values()))

    @property
    def columns(self) -> set[str]:
        """Columns of `Splats` that the next pass needs."""
        if self._first:
            return set(COLUMNS)
        needed = {column for name, each in self._numbers.items() if each.passes for column in columns_of(name)}
        return needed | ({"center"} if self._center[0].passes else set())

    def add(self, block: Block) -> None:
        """Adds a block; the first time with all columns."""
        if self._first and block.invalid:
            self._valid[block.start] = block.valid
            for kind in ("non_finite", "negative_scale"):
                self._counts[kind] += int(np.count_nonzero(block.invalid.get(kind, False)))
        valid = self._valid.get(block.start)
        good = block.splats if valid is None else block.splats.take(valid)
        if self._first:
            self._count(good)
        for axis, each in enumerate(self._center):
            if each.passes:
                each.add(np.ascontiguousarray(good.center[:, axis]))
        for name, each in self._numbers.items():
            if each.passes:
                values = quantity(good, name)
                each.add(np.ascontiguousarray(values[np.isfinite(values)]))

    def _count(self, good: Splats) -> None:
        self._counts["good"] += len(good)
        self._low = np.minimum(self._low, good.center.min(axis=0, initial=np.inf))
        self._high = np.maximum(self._high, good.center.max(axis=0, initial=-np.inf))
        self._counts["zero_opacity"] += int(np.count_nonzero(good.opacity == 0))
        self._counts["zero_scale"] += int(np.count_nonzero(good.scale.max(axis=1, initial=0) == 0))
        self._counts["more_than_opaque"] += int(np.count_nonzero(good.opacity > 1))

    def end_pass(self) -> None:
        """Ends a pass over all blocks."""
        self._first = False
        for each in (*self._center, *self._numbers.values()):
            each.end_pass()

    def facts(self) -> ValueFacts:
        """What was found, after the last pass."""
        box = box_98 = None
        counts = dict(self._counts)
        if counts.pop("good"):
            box = Box(_numbers(self._low), _numbers(self._high))
            low, high = np.stack([each.values() for each in self._center], axis=1)
            box_98 = Box(_numbers(low), _numbers(high))
        quantities = {name: _summary(each) for name, each in self._numbers.items()}
        return ValueFacts(box=box, box_98=box_98, quantities=quantities, **counts)


def _summary(numbers: Percentiles) -> dict[str, float | None]:
    if not numbers.count:
        return dict.fromkeys(("min", *PERCENTILES, "max", "mean"))
    levels: dict[str, float | None] = dict(zip(("min", *PERCENTILES, "max"), _numbers(numbers.values()), strict=True))
    return levels | {"mean": _number(numbers.mean)}


def _number(value: Any) -> float:
    return float(f"{float(value):.6g}")


def _numbers(values: NDArray[Any]) -> list[float]:
    return [_number(value) for value in values]
