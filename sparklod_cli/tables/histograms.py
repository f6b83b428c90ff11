"""Histograms of numbers, and their bars as text."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray

#: Positive numbers whose largest is more than this factor above the smallest get bins of equal ratios.
LOG_SPAN = 100

#: If all numbers span more than this many times the range of the inner 99 %, the bins cover that range only.
FAR_SPAN = 3

#: Blocks of zero to seven eighths of a character.
EIGHTHS = " ▏▎▍▌▋▊▉"


@dataclass(frozen=True)
class Histogram:
    """Counts of numbers in bins.

    Attributes:
        edges: (B + 1,) ascending edges; a bin includes its lower edge, the last one both. Empty without numbers.
        counts: (B,) numbers in each bin.
        log: the bins have equal ratios instead of equal widths.
        below, above: numbers outside the range of the bins.
    """

    edges: NDArray[np.float64]
    counts: NDArray[np.int64]
    log: bool
    below: int = 0
    above: int = 0
    not_finite: int = 0


def histogram(values: FloatArray, *, bins: int = 40, linear: bool = False) -> Histogram:
    """Return the histogram of (N,) numbers, finite or not; it has one bin if all are the same.

    Positive numbers that span more than `LOG_SPAN` get bins of equal ratios, unless it is `linear`.
    """
    finite = values[np.isfinite(values)].astype(np.float64)
    not_finite = len(values) - len(finite)
    if not len(finite):
        return Histogram(np.empty(0), np.empty(0, np.int64), log=False, not_finite=not_finite)
    least, most = float(finite.min()), float(finite.max())
    log = not linear and least > 0 and most > LOG_SPAN * least
    if log:
        np.log(finite, out=finite)
    first, low, high, last = (float(end) for end in np.percentile(finite, [0, 0.5, 99.5, 100]))
    ends = (low, high) if high > low and last - first > FAR_SPAN * (high - low) else (first, last)
    if ends[1] - ends[0] <= 1e-12 * max(map(abs, ends)):
        # A single value: its bin ends at the next floats on both sides.
        edges = np.array([np.nextafter(least, -np.inf), np.nextafter(most, np.inf)])
        return Histogram(edges, np.array([len(finite)]), log, not_finite=not_finite)
    counts, edges = np.histogram(finite, bins, ends)
    below, above = int(np.count_nonzero(finite < edges[0])), int(np.count_nonzero(finite > edges[-1]))
    if log:
        edges = np.exp(edges)  # exp rounds; the outermost edges are set exactly
        edges[0], edges[-1] = edges[0] if below else least, edges[-1] if above else most
    return Histogram(edges, counts.astype(np.int64), log, below, above, not_finite)


def as_text(histogram: Histogram, *, width: int = 60, rows: int = 20) -> str:
    """Return a line for each bin, with its lower edge, count and bar, and lines for the numbers outside the bins.

    Bins are merged to at most `rows`; the longest bar has `width` characters.
    """
    lines: list[tuple[str, int, bool]] = []
    if len(histogram.counts):
        edges, counts = histogram.edges, histogram.counts
        together = -(-len(counts) // rows)
        firsts = np.arange(0, len(counts), together)
        names = edge_names(np.append(edges[firsts], edges[-1]))
        lines = [(name, int(count), True) for name, count in zip(names, np.add.reduceat(counts, firsts), strict=False)]
        if histogram.below:
            lines.insert(0, (f"below {names[0]}", histogram.below, False))
        if histogram.above:
            lines.append((f"above {names[-1]}", histogram.above, False))
    if histogram.not_finite:
        lines.append(("not finite", histogram.not_finite, False))
    if not lines:
        return "no numbers"
    most = max((count for _, count, drawn in lines if drawn), default=0)
    column = max(len(name) for name, _, _ in lines)
    digits = max(len(f"{count:,}") for _, count, _ in lines)
    texts = ((f"{name:>{column}}  {count:>{digits},}", count if drawn else 0) for name, count, drawn in lines)
    return "\n".join(f"{text}  {bar(count, most, width)}".rstrip() for text, count in texts)


def bar(count: int, most: int, width: int) -> str:
    """Return a bar of blocks, `width` characters long for `most`; any count above 0 is visible."""
    eighths = 0 if not count else max(1, round(8 * width * count / most))
    return "█" * (eighths // 8) + EIGHTHS[eighths % 8].strip()


def edge_names(edges: NDArray[np.float64]) -> list[str]:
    """Return the edges as text, with the fewest significant digits, from 3 on, that keep them apart."""
    gap = float(np.diff(edges).min())
    if gap > 1e-12:  # rounds edges that are 0 but for the error of float arithmetic
        edges = np.round(edges, 2 - math.floor(math.log10(gap))) + 0.0
    names = []
    for digits in range(3, 9):
        names = [f"{edge:.{digits}g}" for edge in edges]
        if len(set(names)) == len(names):
            break
    return names
