"""Which encodings and ranges a RAD file is written with; docs/decisions has the measurements behind them."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
from numpy.typing import NDArray

from ...model.nodes import CHUNK_NODES
from ...model.scene import Scene
from ...model.sh import COEFFICIENTS
from ...model.splats import FloatArray
from ...support.errors import FormatError
from ..clamps import Range
from ..magnitudes import LOWER, UPPER, Magnitudes, tops
from ..options import RadOptions, WriteOptions
from ..splat_encoding import SCALE_ZERO, SplatEncoding
from ..steps import SMALL_QUANTILE, fine_bits
from .encodings import LARGEST_F16
from .layout import AUTO, PROPERTIES, RANGES, Row, choices

#: What "auto" stands for, where the scene does not decide.
AUTOMATIC = RadOptions("f32_lebytes", "r8", "r8", "ln_0r8", "oct88r8", "s8")

#: Range of the logarithms of scales up to which none is clamped: 254 steps of 4.7 % at most. Beyond, the smallest
#: `SMALL_QUANTILE` of the scales may be; those are flat splats' thicknesses.
LOG_RANGE = 12.0

#: Range from which float16 is used: as Spark does, which is also where its error of 2 ** -11 becomes the smaller one.
WIDE_LOG_RANGE = 25.0

#: Range of colours from which float16 is used: a code would be 4 steps of 8-bit colour and more.
WIDE_RGB_RANGE = 4.0

#: Ranges end at multiples of this, so that their numbers are short and exact.
GRID = 1 / 64

#: Least range of codes of SH in a file: their steps of 1 / 127 are below what colours of 8 bits show, and finer ones
#: take more room. The splatEncoding of the header has the fitted range all the same, since a viewer that packs SH into
#: 6 to 8 bits takes that.
LEAST_SH_MAX = 1.0

#: An error of a colour or a coefficient from which more is no worse: a colour is then a wrong one. Otherwise a single
#: splat far from all others would decide the steps of all.
WORST = 0.5

#: Ends of ranges that are tried, as shares of the values that lie beyond.
BEYOND = np.array([0.0, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2])


def settled(scene: Scene, options: WriteOptions) -> WriteOptions:
    """These options with nothing left open: `encode` writes the scene with them.

    Raises:
        FormatError: there are more splats than the format can number.
        ValueError: an encoding is unknown, or the palette has no code or more than a label can name.
    """
    rad = options.rad
    if rad.sh_codes is not None and not 1 <= rad.sh_codes <= CHUNK_NODES:
        raise ValueError(f"sh_codes is {rad.sh_codes}, not 1 to {CHUNK_NODES:,}")
    for name in ("center", "alpha", "rgb", "scales", "orientation", "sh"):
        if getattr(rad, name) not in choices(name):
            raise ValueError(f"{name} is {getattr(rad, name)!r}, not one of {', '.join(choices(name))}")
    if len(scene.splats) >= 1 << 32:
        raise FormatError(f"{len(scene.splats):,} splats; RAD numbers at most {(1 << 32) - 1:,}")
    ranges = rad.ranges or fitted(scene)
    given = {name: getattr(rad, name) for name in ("center", "alpha", "rgb", "scales", "orientation", "sh")}
    chosen = {name: getattr(AUTOMATIC, name) if value == AUTO else value for name, value in given.items()}
    if rad.scales == AUTO and ranges.ln_scale_max - ranges.ln_scale_min > WIDE_LOG_RANGE:
        chosen["scales"] = "ln_f16"
    if rad.rgb == AUTO and ranges.rgb_max - ranges.rgb_min > WIDE_RGB_RANGE:
        chosen["rgb"] = "f16"
    bits = rad.center_bits
    if rad.center == AUTO and bits is None:
        # The lowest bytes of rounded float32 are mostly zeros, which take no room.
        bits = fine_bits(scene)
    return dataclasses.replace(options, rad=dataclasses.replace(rad, **chosen, center_bits=bits, ranges=ranges))


def fitted(scene: Scene) -> SplatEncoding:
    """The ranges that suit a scene."""
    splats = scene.splats
    rgb_min, rgb_max = _linear_range(splats.rgb)
    low, high = _log_range(splats.scale)
    tops = [1.0, 1.0, 1.0]
    for degree in range(1, splats.sh_degree + 1):
        tops[degree - 1] = _largest(splats.sh[:, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]])
    return SplatEncoding(rgb_min, rgb_max, low, high, tops[0], tops[1], tops[2], scene.tree is not None)


def code_range(row: Row, ranges: SplatEncoding) -> tuple[float, float]:
    """The range of a property's codes in a file; (0, 0) where it has none."""
    if row.degree:
        most = max(LEAST_SH_MAX, float(ranges.sh_max(row.degree)))
        return -most, most
    ends = {
        "rgb": (ranges.rgb_min, ranges.rgb_max),
        "scale": (ranges.ln_scale_min, ranges.ln_scale_max),
        "opacity": (0.0, float(ranges.alpha_max)),
    }
    return ends.get(row.column, (0.0, 0.0))


def held(options: WriteOptions, sh_degree: int) -> list[Range]:
    """The values that a file with these settled options holds without clamping them.

    Args:
        options: of `settled`.
        sh_degree: of the scene.
    """
    rad, found, most = options.rad, [], float(LARGEST_F16)
    for row in PROPERTIES:
        encoding = getattr(rad, row.option) if row.option else ""
        if row.codes or row.degree > sh_degree or row.column == "opacity" or rad.ranges is None:
            continue
        numbers = (3 * COEFFICIENTS[row.degree - 1], 3 * COEFFICIENTS[row.degree]) if row.degree else (0, None)
        low, high = code_range(row, rad.ranges)
        if encoding == "ln_0r8":
            half = (high - low) / 508
            ends = math.exp(low - half), math.exp(min(high + half, 88.0))
            found.append(Range(row.column, *ends, zero=float(SCALE_ZERO)))
        elif encoding in RANGES:
            half = (high - low) / (508 if encoding.startswith("s8") else 510)
            found.append(Range(row.column, low - half, high + half, numbers, degree=row.degree))
        elif encoding in ("f16", "f16_lebytes"):
            found.append(Range(row.column, -most, most, numbers, degree=row.degree))
    return found


def _outward(value: float, up: bool) -> float:
    return (math.ceil if up else math.floor)(value / GRID) * GRID


def _clamping(counts: NDArray[np.int64], top: float) -> float:
    """The summed squared error of magnitudes that are clamped to `top`."""
    bins = np.flatnonzero(counts[:-1])
    beyond = np.clip(UPPER[bins] - top, 0, WORST)
    return float(np.sum(counts[bins] * beyond**2))


def _linear_range(values: FloatArray) -> tuple[float, float]:
    """The range of 255 steps with the least squared error, of rounding and of clamping together."""
    found = Magnitudes.of(values)
    total = max(found.count, 1)
    below = tops(found.negative, total, -found.lowest, BEYOND)
    above = np.maximum(tops(found.positive, total, found.highest, BEYOND), 1)
    lows = {-low: _clamping(found.negative, low) for low in below}
    highs = {high: _clamping(found.positive, high) for high in above}

    def error(ends: tuple[float, float]) -> float:
        low, high = ends
        return (lows[low] + highs[high]) / total + ((high - low) / 255) ** 2 / 12

    low, high = min(itertools.product(sorted(lows), sorted(highs)), key=error)
    return _outward(low, False), _outward(high, True)


def _largest(values: FloatArray) -> float:
    """The largest coefficient for 254 steps with the least squared error, of rounding and of clamping together."""
    found = Magnitudes.of(values)
    total, counts = found.count, found.positive + found.negative
    most = max(found.highest, -found.lowest)
    if not total:
        return 1.0

    def error(top: float) -> float:
        return _clamping(counts, top) / total + (top / 127) ** 2 / 12

    return max(GRID, _outward(min(tops(counts, total, most, BEYOND), key=error), True))


def _log_range(scale: FloatArray) -> tuple[float, float]:
    """From the logarithm of a small scale to that of the largest: the sizes of coarse splats must not be clamped."""
    counts = Magnitudes.of(scale).positive.copy()
    counts[UPPER <= SCALE_ZERO] = 0
    counts[-1] = 0
    bins = np.flatnonzero(counts)
    if not bins.size:
        return SplatEncoding.ln_scale_min, SplatEncoding.ln_scale_max
    small = bins[np.searchsorted(np.cumsum(counts[bins]), SMALL_QUANTILE * counts.sum())]
    least, small_log, most = np.log([LOWER[bins[0]], LOWER[small], UPPER[bins[-1]]])
    low = max(least, math.log(SCALE_ZERO), min(small_log, most - LOG_RANGE))
    low, high = _outward(low, False), _outward(most, True)
    return low, high if high > low else low + GRID
