"""The ranges of codes that suit a scene: what clamping and rounding cost together is least."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from ..magnitudes import LOWER, UPPER, Magnitudes, tops
from ..splat_encoding import LARGEST_END, SCALE_ZERO, SplatEncoding
from ..statistics import Statistics
from ..steps import SMALL_QUANTILE

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


def fitted(found: Statistics) -> SplatEncoding:
    """The ranges that suit splats; they do not depend on their order.

    Args:
        found: of `NEEDED`.
    """
    rgb_min, rgb_max = _linear_range(found.magnitudes["rgb"])
    low, high = _log_range(found.magnitudes["scale"])
    sh_max = dict.fromkeys(("sh1_max", "sh2_max", "sh3_max"), 1.0)
    for degree in range(1, found.sh_degree + 1):
        sh_max[f"sh{degree}_max"] = _largest(found.magnitudes[f"sh{degree}"])
    return SplatEncoding(rgb_min, rgb_max, low, high, **sh_max, lod_opacity=found.tree)


def _outward(value: float, up: bool) -> float:
    return (math.ceil if up else math.floor)(value / GRID) * GRID


def _clamping(counts: NDArray[np.int64], top: float) -> float:
    """The summed squared error of magnitudes that are clamped to `top`."""
    bins = np.flatnonzero(counts[:-1])
    beyond = np.clip(UPPER[bins] - top, 0, WORST)
    return float(np.sum(counts[bins] * beyond**2))


def _linear_range(found: Magnitudes) -> tuple[float, float]:
    """The range of 255 steps with the least squared error, of rounding and of clamping together."""
    total = max(found.count, 1)
    below = tops(found.negative, total, -found.lowest, BEYOND)
    above = np.maximum(tops(found.positive, total, found.highest, BEYOND), 1)
    lows = {-low: _clamping(found.negative, low) for low in below}
    highs = {high: _clamping(found.positive, high) for high in above}

    def error(ends: tuple[float, float]) -> float:
        low, high = ends
        return (lows[low] + highs[high]) / total + ((high - low) / 255) ** 2 / 12

    low, high = min(itertools.product(sorted(lows), sorted(highs)), key=error)
    return _outward(max(low, -LARGEST_END), False), _outward(min(high, LARGEST_END), True)


def _largest(found: Magnitudes) -> float:
    """The largest coefficient for 254 steps with the least squared error, of rounding and of clamping together."""
    total, counts = found.count, found.positive + found.negative
    most = max(found.highest, -found.lowest)
    if not total:
        return 1.0

    def error(top: float) -> float:
        return _clamping(counts, top) / total + (top / 127) ** 2 / 12

    return max(GRID, _outward(min(*tops(counts, total, most, BEYOND), LARGEST_END, key=error), True))


def _log_range(scale: Magnitudes) -> tuple[float, float]:
    """From the logarithm of a small scale to that of the largest: the sizes of coarse splats must not be clamped."""
    counts = scale.positive.copy()
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
