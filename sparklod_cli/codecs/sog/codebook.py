"""Codebooks: 256 values for the numbers of an image, chosen so that these are near them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...model.splats import FloatArray

#: Codes of a book: a channel of a texel has 8 bits.
CODES = 256

#: Bins of the histogram that weighs the numbers. Chosen.
BINS = 4096

#: A bin of n numbers weighs n ** CROWDING as much as a bin of one, so that the few numbers far from the others, such as
#: the scales of a background, get codes, too. Chosen.
CROWDING = 0.5

#: Passes of k-means; from where it starts here, more change nothing that can be seen. Measured.
PASSES = 20


def codebook(values: FloatArray, tilt: float = 0) -> FloatArray:
    """A book for some numbers.

    If at most 256 of them differ, the book has just these. Otherwise it has the least and the largest number, so that
    the range stays, and between them the means that k-means finds in one dimension, where it needs no more than sums up
    to the boundaries of its cells. It starts from a density of codes in proportion to the cube root of that of the
    weight, which has the least squared error where codes are many (P. F. Panter and W. Dite, 1951).

    Args:
        values: finite float32 of any shape, at least one.
        tilt: a number weighs e ** (tilt * number).

    Returns:
        (256,) ascending float32; the last value is repeated where there are fewer.
    """
    ordered = np.sort(values, axis=None)
    is_new = np.empty(len(ordered), np.bool_)
    is_new[0] = True
    np.not_equal(ordered[1:], ordered[:-1], out=is_new[1:])
    if np.count_nonzero(is_new) <= CODES:
        distinct = ordered[is_new]
        return np.concatenate([distinct, np.full(CODES - len(distinct), distinct[-1], np.float32)])
    found = np.empty(CODES, np.float32)
    found[0], found[-1] = ordered[0], ordered[-1]
    first, last = np.searchsorted(ordered, ordered[0], "right"), np.searchsorted(ordered, ordered[-1], "left")
    found[1:-1] = _means(ordered[first:last].astype(np.float64), CODES - 2, tilt)
    return found


def nearest(values: FloatArray, book: FloatArray) -> NDArray[np.uint8]:
    """The code of each number, the first of those that are equally near; of any shape.

    Args:
        values: float32.
        book: of `codebook`.
    """
    wide = book.astype(np.float64)
    return np.searchsorted((wide[1:] + wide[:-1]) / 2, values.ravel()).astype(np.uint8).reshape(values.shape)


def _means(ordered: NDArray[np.float64], codes: int, tilt: float) -> NDArray[np.float64]:
    """(codes,) ascending means of cells of ascending numbers, more than codes of which differ."""
    low, extent = ordered[0], ordered[-1] - ordered[0]
    bins = np.minimum((ordered - low) * (BINS / extent), BINS - 1).astype(np.int64)
    counts = np.bincount(bins, minlength=BINS).astype(np.float64)
    crowded = np.maximum(counts, 1) ** (CROWDING - 1)
    weights = crowded[bins] * np.exp(tilt * (ordered - low))
    weight = np.append(0, np.cumsum(weights))
    moment = np.append(0, np.cumsum(weights * (ordered - low)))
    tilted = np.exp(tilt / 3 * np.linspace(0, extent, BINS))
    density = np.append(0, np.cumsum(counts ** (CROWDING / 3) * (counts > 0) * tilted))
    shares = (np.arange(codes) + 0.5) * (density[-1] / codes)
    means = np.interp(shares, density, np.linspace(0, extent, BINS + 1)) + low
    for _ in range(PASSES):
        begin = np.concatenate([[0], np.searchsorted(ordered, (means[1:] + means[:-1]) / 2), [len(ordered)]])
        within, moments = np.diff(weight[begin]), np.diff(moment[begin])
        filled = within > 0
        means[filled] = low + moments[filled] / within[filled]
        means.sort()
    return means
