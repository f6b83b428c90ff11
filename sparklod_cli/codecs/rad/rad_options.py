"""Encodings and ranges of RAD files, and the values that those clamp (docs/decisions/07-rad.md)."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
from numpy.typing import NDArray

from ...model.scene import Scene
from ...model.sh import COEFFICIENTS
from ...system.errors import FormatError
from ..encoder import CodeRange
from ..options import AUTO, RAD_ENCODINGS, RadOptions, WriteOptions
from ..spark_codings import LARGEST_END, SCALE_ZERO, SplatEncoding
from ..statistics import EXACT_BITS, LOWER, SMALL_QUANTILE, UPPER, Distribution, Statistics, fine_bits, tops
from .property_codings import CODINGS, LARGEST_F16, PROPERTIES, Row

#: What "auto" stands for, where the scene does not decide.
AUTOMATIC = RadOptions("f32_lebytes", "r8", "r8", "ln_0r8", "oct88r8", "s8")

#: Encodings of centres as float16.
HALF = ("f16", "f16_lebytes")

#: Range of logarithms of scales from which float16 is used: steps of a byte would be as coarse as SPZ's, 6 %.
WIDE_LOG_RANGE = 16.0

#: Splats are long if they are as many times as long as wide. Where half of them are, rotations are float16: those of
#: oct88r8, off by up to 1.9 degrees, would move the ends of each by a quarter of its width.
LONG = 8.0

#: Range of colours from which float16 is used: a code would be 4 steps of 8-bit colour and more.
WIDE_RGB_RANGE = 4.0

#: Least range of codes of SH in a file: their steps of 1 / 127 are below what colours of 8 bits show, and finer ones
#: take more room. The splatEncoding of the header has the fitted range all the same, since a viewer that packs SH into
#: 6 to 8 bits takes that.
LEAST_SH_MAX = 1.0


#: The statistics that ranges are fitted to.
NEEDED = frozenset(("rgb", "scale", "sh"))

#: Range of the logarithms of scales up to which none is clamped: 254 steps of 4.7 % at most. Beyond, the smallest
#: `SMALL_QUANTILE` of the scales may be; those are flat splats' thicknesses.
LOG_RANGE = 12.0

#: Ranges end at multiples of this, so that their numbers are short and exact.
GRID = 1 / 64

#: An error of a colour or a coefficient from which more is no worse: a colour is then a wrong one. Otherwise a single
#: splat far from all others would decide the steps of all.
WORST = 0.5

#: Ends of ranges that are tried, as shares of the values that lie beyond.
BEYOND = np.array([0.0, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2])


def needed(options: WriteOptions) -> frozenset[str]:
    """Return the statistics by which `settled` settles these options."""
    rad = options.rad
    ranges = NEEDED if rad.ranges is None else frozenset[str]()
    rounds = {"leaf_scale"} if _rounds(rad) else set()
    turns = {"leaf_length"} if rad.orientation == AUTO else set()
    reach = {"reach"} if rad.center in HALF else set()
    return ranges | rounds | turns | reach


def _rounds(rad: RadOptions) -> bool:
    """Return whether the rounding of centres is left open."""
    return rad.center == AUTO and rad.center_bits is None


def settled(scene: Scene | Statistics, options: WriteOptions) -> WriteOptions:
    """Return the options with nothing left open; `FormatError` if they or the format cannot hold the scene."""
    rad = options.rad
    statistics = scene if isinstance(scene, Statistics) else Statistics.of_scene(scene, needed(options))
    if statistics.count >= 1 << 32:
        raise FormatError(f"{statistics.count:,} splats; RAD numbers at most {(1 << 32) - 1:,}")
    if rad.center in HALF and np.float16(min(statistics.reach or 0, LARGEST_F16)) >= LARGEST_F16:
        raise FormatError(
            f"coordinates reach {statistics.reach:.6g}, and {rad.center} holds less than {LARGEST_F16:.0f};"
            " choose another encoding of centres, such as f32"
        )
    ranges = rad.ranges or fitted(statistics)
    encodings = {name: getattr(rad, name) for name in RAD_ENCODINGS}
    chosen = {name: getattr(AUTOMATIC, name) if value == AUTO else value for name, value in encodings.items()}
    if rad.scales == AUTO and ranges.ln_scale_max - ranges.ln_scale_min > WIDE_LOG_RANGE:
        chosen["scales"] = "ln_f16"
    if rad.rgb == AUTO and ranges.rgb_max - ranges.rgb_min > WIDE_RGB_RANGE:
        chosen["rgb"] = "f16"
    if rad.orientation == AUTO and statistics.values["leaf_length"].quantile(0.5) >= LONG:
        chosen["orientation"] = "f16"
    bits = rad.center_bits
    if _rounds(rad):
        # The lowest bytes of rounded float32 are mostly zeros, which take no room.
        bits = min(fine_bits(statistics.values["leaf_scale"]), EXACT_BITS)
    return dataclasses.replace(options, rad=dataclasses.replace(rad, **chosen, center_bits=bits, ranges=ranges))


def code_range(row: Row, ranges: SplatEncoding) -> tuple[float, float]:
    """Return the range of a property's codes in a file; (0, 0) where it has none."""
    if row.degree:
        most = max(LEAST_SH_MAX, float(ranges.sh_max(row.degree)))
        return -most, most
    ends = {
        "rgb": (ranges.rgb_min, ranges.rgb_max),
        "scale": (ranges.ln_scale_min, ranges.ln_scale_max),
        "opacity": (0.0, float(ranges.alpha_max)),
    }
    return ends.get(row.column, (0.0, 0.0))


def held(options: WriteOptions, sh_degree: int) -> list[CodeRange]:
    """Return the values that a file of this SH degree holds with these settled options without clamping them."""
    rad, ranges, most = options.rad, [], float(LARGEST_F16)
    for row in PROPERTIES:
        encoding = getattr(rad, row.option) if row.option else ""
        if row.codes or row.degree > sh_degree or row.column == "opacity" or rad.ranges is None:
            continue
        numbers = (3 * COEFFICIENTS[row.degree - 1], 3 * COEFFICIENTS[row.degree]) if row.degree else (0, None)
        low, high = code_range(row, rad.ranges)
        if encoding == "ln_0r8":
            half = (high - low) / 508
            ends = math.exp(low - half), math.exp(min(high + half, 88.0))
            ranges.append(CodeRange(row.column, *ends, zero=float(SCALE_ZERO)))
        elif encoding and CODINGS[encoding].ends:
            half = (high - low) / (508 if encoding.startswith("s8") else 510)
            ranges.append(CodeRange(row.column, low - half, high + half, numbers, degree=row.degree))
        elif encoding in ("f16", "f16_lebytes"):
            ranges.append(CodeRange(row.column, -most, most, numbers, degree=row.degree))
    return ranges


def fitted(statistics: Statistics) -> SplatEncoding:
    """Return the ranges that suit splats in any order: what clamping and rounding cost together is least."""
    rgb_min, rgb_max = _linear_range(statistics.values["rgb"])
    low, high = _log_range(statistics.values["scale"])
    sh_max = dict.fromkeys(("sh1_max", "sh2_max", "sh3_max"), 1.0)
    for degree in range(1, statistics.sh_degree + 1):
        sh_max[f"sh{degree}_max"] = _largest(statistics.values[f"sh{degree}"])
    return SplatEncoding(rgb_min, rgb_max, low, high, **sh_max, lod_opacity=statistics.tree)


def _outward(value: float, up: bool) -> float:
    return (math.ceil if up else math.floor)(value / GRID) * GRID


def _clamping(counts: NDArray[np.int64], top: float) -> float:
    """Return the summed squared error of magnitudes that are clamped to `top`."""
    bins = np.flatnonzero(counts[:-1])
    beyond = np.clip(UPPER[bins] - top, 0, WORST)
    return float(np.sum(counts[bins] * beyond**2))


def _linear_range(values: Distribution) -> tuple[float, float]:
    """Return the range of 255 steps with the least squared error, of rounding and of clamping together."""
    total, negative, positive = max(values.count, 1), values.magnitudes(-1), values.magnitudes(1)
    below = tops(negative, total, -values.lowest, BEYOND)
    above = np.maximum(tops(positive, total, values.highest, BEYOND), 1)
    lows = {-low: _clamping(negative, low) for low in below}
    highs = {high: _clamping(positive, high) for high in above}

    def error(ends: tuple[float, float]) -> float:
        low, high = ends
        return (lows[low] + highs[high]) / total + ((high - low) / 255) ** 2 / 12

    low, high = min(itertools.product(sorted(lows), sorted(highs)), key=error)
    return _outward(max(low, -LARGEST_END), False), _outward(min(high, LARGEST_END), True)


def _largest(values: Distribution) -> float:
    """Return the largest coefficient for 254 steps with the least squared error of rounding and clamping."""
    total, counts = values.count, values.magnitudes(1) + values.magnitudes(-1)
    most = max(values.highest, -values.lowest)
    if not total:
        return 1.0

    def error(top: float) -> float:
        return _clamping(counts, top) / total + (top / 127) ** 2 / 12

    return max(GRID, _outward(min(*tops(counts, total, most, BEYOND), LARGEST_END, key=error), True))


def _log_range(scale: Distribution) -> tuple[float, float]:
    """Return the logarithms of a small and of the largest scale: sizes of coarse splats must not be clamped."""
    counts = scale.magnitudes(1)
    counts[(UPPER <= SCALE_ZERO) | ~np.isfinite(LOWER)] = 0
    bins = np.flatnonzero(counts)
    if not bins.size:
        return SplatEncoding.ln_scale_min, SplatEncoding.ln_scale_max
    small = bins[np.searchsorted(np.cumsum(counts[bins]), SMALL_QUANTILE * counts.sum())]
    largest = min(UPPER[bins[-1]], float(np.finfo(np.float32).max))
    least, small_log, most = np.log([LOWER[bins[0]], LOWER[small], largest])
    end = _outward(math.log(np.finfo(np.float32).max), False)  # the last code must not become infinite
    low = max(least, math.log(SCALE_ZERO), min(small_log, most - LOG_RANGE))
    low, high = _outward(min(low, end - GRID), False), min(_outward(most, True), end)
    return low, high if high > low else low + GRID
