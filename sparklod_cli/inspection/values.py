"""Statistics of the values of splats, and findings about them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..codecs import quantize
from ..model.gaussian import spark_size
from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..tables.histograms import Histogram, histogram
from .findings import Finding

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
#: Root mean square of a splat's SH coefficients of degree 1, 2 and 3.
SH_QUANTITIES = ("sh1", "sh2", "sh3")

#: Quantities whose histograms have bins of equal width, however many decades the numbers span.
LINEAR = ("x", "y", "z", "opacity", "red", "green", "blue")

#: Code and message of each reason that makes a splat invalid (`splats.INVALID`).
OF_INVALID = {
    "non_finite": ("values.non-finite", "a number is not finite, or the rotation has length 0"),
    "bad_rotation": ("values.rotation", "the length of the rotation is not 1"),
    "negative_scale": ("values.negative-scale", "a scale is below 0"),
    "negative_opacity": ("values.opacity", "the opacity is below 0"),
}

#: The quantities of a report without --stats.
MAIN = ("scale", "opacity", "anisotropy")
#: Percentiles of a quantity, by name.
PERCENTILES = {"p1": 1, "p25": 25, "p50": 50, "p75": 75, "p99": 99}

#: Shares of splats above which clamped scales and invisible splats are findings: a few of either are the rounding of
#: good files.
MANY_CLAMPED, MANY_INVISIBLE = 0.01, 0.1

#: Coordinates from this on become infinite in float16, which Spark's PackedSplats use.
FLOAT16_END = 65_520


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


def histogram_of(splats: Splats, name: str, *, bins: int = 40) -> Histogram:
    """The histogram of one of `names_of(splats)`, by its name."""
    return histogram(quantity(splats, name), bins=bins, log=False if name in LINEAR else None)


def examine(splats: Splats, *, all_quantities: bool = False) -> ValueFacts:
    """Statistics of N splats.

    Args:
        splats: N splats.
        all_quantities: compute all quantities, not only those of `MAIN`.
    """
    invalid = splats.invalid()
    good = splats.take(splats.is_valid()) if invalid else splats
    names = names_of(splats) if all_quantities else MAIN
    box = box_98 = None
    if len(good):
        box = Box(_numbers(good.center.min(axis=0)), _numbers(good.center.max(axis=0)))
        low, high = np.percentile(good.center.astype(np.float64), [1, 99], axis=0)
        box_98 = Box(_numbers(low), _numbers(high))
    return ValueFacts(
        box=box,
        box_98=box_98,
        non_finite=int(np.count_nonzero(invalid.get("non_finite", False))),
        negative_scale=int(np.count_nonzero(invalid.get("negative_scale", False))),
        zero_opacity=int(np.count_nonzero(good.opacity == 0)),
        zero_scale=int(np.count_nonzero(good.scale.max(axis=1, initial=0) == 0)),
        more_than_opaque=int(np.count_nonzero(good.opacity > 1)),
        quantities={name: _summary(quantity(good, name)) for name in names},
    )


def _summary(values: FloatArray) -> dict[str, float | None]:
    values = values[np.isfinite(values)].astype(np.float64)  # float32 would overflow where numbers span its range
    if not len(values):
        return dict.fromkeys(("min", *PERCENTILES, "max", "mean"))
    levels = _numbers(np.percentile(values, [0, *PERCENTILES.values(), 100]))
    summary: dict[str, float | None] = dict(zip(("min", *PERCENTILES, "max"), levels, strict=True))
    return summary | {"mean": _number(values.mean(dtype=np.float64))}


def _number(value: Any) -> float:
    return float(f"{float(value):.6g}")


def _numbers(values: NDArray[Any]) -> list[float]:
    return [_number(value) for value in values]


@dataclass(frozen=True)
class Ends:
    """The numbers at which a file's codes end; values at one of them may have been clamped.

    Attributes:
        scale: smallest and largest scale, world units; 0 and infinity for floats.
        center: largest absolute coordinate, world units.
    """

    scale: tuple[float, float] = (0.0, math.inf)
    center: float = math.inf


def ends_of(scene: Scene) -> Ends:
    """The ends of the codes of an SPZ file, and none for other formats, whose numbers are floats."""
    header = scene.header
    if "fractional_bits" not in header:
        return Ends()
    low, high = quantize.decode_log_scale(np.array([0, 255], np.uint8))
    fixed = header["version"] >= 2  # version 1 has floats
    return Ends((low, high), quantize.FIXED24_MAX * 2.0 ** -int(header["fractional_bits"]) if fixed else math.inf)


def check(scene: Scene, ends: Ends | None = None) -> list[Finding]:
    """Findings about the values of a scene.

    Args:
        scene: as it was read.
        ends: of its codes; None for `ends_of(scene)`.
    """
    ends = ends_of(scene) if ends is None else ends
    splats = scene.splats
    if not len(splats):
        return [Finding("values.empty", "there are no splats")]
    found = []

    def report(code: str, mask: Any, what: str) -> None:
        count = int(np.count_nonzero(mask))
        if count:
            index = int(np.argmax(mask))
            more = f" and {count - 1:,} more" if count > 1 else ""
            found.append(Finding(code, f"splat {index:,}{more}: {what}", index, count))

    invalid = splats.invalid()
    valid = splats.is_valid() if invalid else np.ones(len(splats), np.bool_)
    for kind, (code, what) in OF_INVALID.items():
        if kind in invalid:
            report(code, invalid[kind], what)
    if scene.tree is None:
        report("values.opacity", valid & (splats.opacity > 1), "the opacity is above 1")
    invisible = (splats.opacity == 0) | (splats.scale.max(axis=1) == 0)
    checked = len(splats)
    if scene.tree is not None:  # merged splats of thin leaves far apart may be fainter than any code
        invisible &= scene.tree.is_leaf
        checked = int(np.count_nonzero(scene.tree.is_leaf))
    if np.count_nonzero(invisible) > MANY_INVISIBLE * checked:
        report("values.invisible", valid & invisible, "cannot be drawn, as its opacity or scale is 0")
    if ends.center < math.inf:
        clamped = valid & (np.abs(splats.center) >= ends.center).any(axis=1)
        report("values.center-clamped", clamped, f"a coordinate is {ends.center:g}, the end of the range of its code")
    low, high = ends.scale
    if high < math.inf:
        most = splats.scale.max(axis=1)  # a smallest scale that was clamped is not visible
        clamped = (most > 0) & ((most <= low) | (most >= high))
        if scene.tree is not None:  # merged splats of leaves far apart may be larger than any code
            clamped &= scene.tree.is_leaf
        if np.count_nonzero(clamped) > MANY_CLAMPED * checked:
            text = f"a scale is {low:.2g} or {high:.0f}, the ends of the range of its code"
            report("values.scale-clamped", clamped, text)
    far = valid & (np.abs(splats.center) >= FLOAT16_END).any(axis=1)
    report("values.center-far", far, f"a coordinate is {FLOAT16_END:,} or more, which float16 cannot hold")
    return found
