"""Histograms of the numbers of a scene, and as bars of text."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray

#: Positive numbers that span more than this factor are counted in bins of equal ratios.
LOG_SPAN = 100

#: Where all numbers span more than this many times what the inner 99 % do, the bins span these only.
FAR_SPAN = 3

#: Eighths of a character, from none to seven.
EIGHTHS = " ▏▎▍▌▋▊▉"


@dataclass(frozen=True)
class Histogram:
    """How many numbers are where.

    Attributes:
        edges: (B + 1,) of the bins, ascending; a bin has its lower edge, the last one both. Empty if there is none.
        counts: (B,) of each bin.
        log: the bins have equal ratios, not equal widths.
        below, above: numbers beyond the bins, which are few and far out.
        not_finite: numbers that are left out.
    """

    edges: NDArray[np.float64]
    counts: NDArray[np.int64]
    log: bool
    below: int = 0
    above: int = 0
    not_finite: int = 0


def histogram(values: FloatArray, *, bins: int = 40, log: bool | None = None) -> Histogram:
    """Counts numbers.

    Args:
        values: (N,) of any kind; those that are not finite are counted apart.
        bins: how many, unless all numbers are the same.
        log: bins of equal ratios, for positive numbers; None where they are positive and span more than `LOG_SPAN`.

    Raises:
        ValueError: there are no bins, or `log` is set and a number is not positive.
    """
    if bins < 1:
        raise ValueError(f"{bins} bins")
    finite = values[np.isfinite(values)].astype(np.float64)
    not_finite = len(values) - len(finite)
    if not len(finite):
        return Histogram(np.empty(0), np.empty(0, np.int64), bool(log), not_finite=not_finite)
    least, most = float(finite.min()), float(finite.max())
    if log and least <= 0:
        raise ValueError(f"{least:g} has no logarithm")
    if log is None:
        log = least > 0 and most > LOG_SPAN * least
    if log:
        np.log(finite, out=finite)
    ends = _range(finite)
    if ends[1] - ends[0] <= 1e-12 * max(abs(ends[0]), abs(ends[1])):  # one number, in a bin as wide as its step
        edges = np.array([np.nextafter(least, -np.inf), np.nextafter(most, np.inf)])
        return Histogram(edges, np.array([len(finite)]), log, not_finite=not_finite)
    counts, edges = np.histogram(finite, bins, ends)
    below, above = int(np.count_nonzero(finite < edges[0])), int(np.count_nonzero(finite > edges[-1]))
    if log:
        edges = np.exp(edges)  # which rounds: the outermost are known
        edges[0], edges[-1] = edges[0] if below else least, edges[-1] if above else most
    return Histogram(edges, counts.astype(np.int64), log, below, above, not_finite)


def _range(values: NDArray[np.float64]) -> tuple[float, float]:
    least, low, high, most = (float(end) for end in np.percentile(values, [0, 0.5, 99.5, 100]))
    if high > low and most - least > FAR_SPAN * (high - low):
        return low, high
    return least, most


def as_text(histogram: Histogram, *, width: int = 60, rows: int = 20) -> str:
    """A line for each bin: where it begins, a bar and how many; and one for what is beyond the bins.

    Args:
        histogram: of which neighbouring bins are put together where there are more than `rows`.
        width: of the longest bar, in characters.
        rows: at most, beside those for what is beyond.
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
    """A bar of blocks, as long as `width` characters for `most`; what is not nothing is seen."""
    eighths = 0 if not count else max(1, round(8 * width * count / most))
    return "█" * (eighths // 8) + EIGHTHS[eighths % 8].strip()


def edge_names(edges: NDArray[np.float64]) -> list[str]:
    """Numbers with as few digits as tell them from each other."""
    gap = float(np.diff(edges).min())
    if gap > 1e-12:  # an edge that differs from 0 by much less than a bin is 0
        edges = np.round(edges, 2 - math.floor(math.log10(gap))) + 0.0
    names = []
    for digits in range(3, 9):
        names = [f"{edge:.{digits}g}" for edge in edges]
        if len(set(names)) == len(names):
            break
    return names
