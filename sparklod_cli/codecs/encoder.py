"""Encoding of files in windows, for splats in memory or not, and counts of the values that codes clamp.

Each window is encoded alone, on any thread or machine, and its result stays in memory or in a store that machines
share. The bytes of the file are then assembled from the results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import Scene
from ..model.splats import FloatArray, Splats
from ..system.progress import Progress
from ..system.threads import blocks_of, ordered_map
from . import quantize
from .formats import WriteOptions

if TYPE_CHECKING:
    from typing import Protocol

    class Encoder(Protocol):
        """Encoder of the windows of one file, which can be pickled."""

        @property
        def options(self) -> WriteOptions:
            """Settled options: none is None."""

        @property
        def ranges(self) -> tuple[CodeRange, ...]:
            """Ranges beyond which values are counted; empty for no count."""

        def encode(self, splats: Splats, tree: LodTree | None, start: int) -> Encoded:
            """Encode a window; the result has the `tally` of values beyond the ranges as `CLAMPED`.

            Args:
                tree: nodes of the window, with the indices of children in the file; None for a file without a tree.
                start: number of the first splat; the start of one of `windows_of`.
            """

        def pieces(self, windows: Windows, *, threads: int, progress: Progress) -> Iterator[bytes]:
            """Yield the bytes of the file, assembled from the results of all windows."""

        def keeping(self, stored: Any, unchanged: NDArray[np.bool_]) -> Encoder:
            """Return an encoder that copies the codes of (N,) unchanged nodes from `stored` codes, see `Format`."""


#: Result of a window: arrays by name.
Encoded = dict[str, NDArray[Any]]

#: Returns an array of the result of a window, by the number of the window and the name of the array.
Windows = Callable[[int, str], NDArray[Any]]

#: Name of the array that counts the clamped values of a window, see `tally`.
CLAMPED = "clamped"


@dataclass(frozen=True)
class CodeRange:
    """Range of the values of a column that a format stores without clamping.

    Attributes:
        column: column of `Splats`.
        low, high: smallest and largest value that is rounded to a code.
        numbers: the range is that of these numbers of a splat, from the first to the one before the second; all by
            default.
        zero: values below this are stored as 0.
        degree: degree of the SH; 0 for other columns, and for SH of all degrees.
    """

    column: str
    low: float
    high: float
    numbers: tuple[int, int | None] = (0, None)
    zero: float = 0.0
    degree: int = 0


#: Ranges of SPZ.
SPZ_RANGES = tuple(CodeRange(column, low, high) for column, (low, high) in quantize.CLAMPS.items())


def windows_of(count: int) -> list[slice]:
    """Divide the splats of a file into windows."""
    return blocks_of(count, CHUNK_NODES)


def results(encoder: Encoder, scene: Scene, threads: int, progress: Progress, stage: str) -> Iterator[Encoded]:
    """Encode all windows of a scene and yield the results in order; `stage` is the word for it in `progress`."""
    windows, tree = windows_of(len(scene)), scene.tree
    rows = ((scene.splats.take(part), None if tree is None else tree.rows(part), part.start) for part in windows)
    encoded = ordered_map(lambda arguments: encoder.encode(*arguments), rows, threads)
    for part, result in zip(windows, encoded, strict=True):
        progress(stage, part.stop, len(scene), "splat")
        yield result


#: Smallest visible change of the displayed colour of a splat, 0..1. Chosen.
STEP = 8 / 255

#: Largest value of a basis function of SH of degree 1; those of other degrees are a little larger.
BASIS = 0.5

#: Result of `tally`.
Tally = NDArray[np.float64]


def tally(splats: Splats, ranges: Sequence[CodeRange], leaf: NDArray[np.bool_] | None = None) -> Tally:
    """Count the splats with values beyond ranges.

    The loss of a leaf is visible if a coordinate is clamped, if the largest scale is clamped, or if the colour changes
    by `STEP` or more, displayed on black, by its base or by a coefficient of SH. Clamping a smaller scale only makes a
    flat splat thicker, which is not visible.

    Args:
        ranges: ranges; those of one column are side by side.
        leaf: (n,) mask of the leaves; None if all splats are leaves.

    Returns:
        (ranges, 9) float64: numbers of splats below the range, above it, and either; number of splats beyond any range
        of the column; least and largest value, infinity and minus infinity without values; numbers of leaves with a
        visible loss below, above, and either.
    """
    counts = np.zeros((len(ranges), 9))
    counts[:, 4:6] = np.inf, -np.inf
    for name in dict.fromkeys(each.column for each in ranges):
        column, either = getattr(splats, name).reshape(len(splats), -1), np.zeros(len(splats), np.bool_)
        rows = [row for row, each in enumerate(ranges) if each.column == name]
        for row in rows:
            each = ranges[row]
            values = column[:, slice(*each.numbers)]
            if not values.size:
                continue
            if each.zero:
                values = np.where(values < each.zero, each.low, values)
            counts[row, 4:6] = values.min(), values.max()
            if counts[row, 4] >= each.low and counts[row, 5] <= each.high:
                continue
            below, above = _rows_with(values < each.low), _rows_with(values > each.high)
            beyond = below | above
            either |= beyond
            counts[row, :3] = [np.count_nonzero(mask) for mask in (below, above, beyond)]
            leaves = np.flatnonzero(beyond if leaf is None else beyond & leaf)
            seen = leaves[_is_visible(each, values[leaves], splats.opacity[leaves])]
            counts[row, 6:] = np.count_nonzero(below[seen]), np.count_nonzero(above[seen]), len(seen)
        counts[rows, 3] = np.count_nonzero(either)
    return counts


@np.errstate(over="ignore")  # of numbers near the end of float32
def _is_visible(each: CodeRange, values: FloatArray, opacity: FloatArray) -> NDArray[np.bool_]:
    """Return an (n,) mask of the leaves whose loss is visible if their (n, K) values are clamped to a range."""
    if each.column == "center":
        return np.ones(len(values), np.bool_)
    if each.column == "scale":
        return (values.max(axis=1) < each.low) | (values.max(axis=1) > each.high)
    alpha, clamped = opacity[:, None], np.clip(values, each.low, each.high)
    if each.column == "rgb":
        change = np.clip(alpha * values, 0, 1) - np.clip(alpha * clamped, 0, 1)
    else:
        change = BASIS * alpha * (values - clamped)
    return _rows_with(np.abs(change) >= STEP)


def _rows_with(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return `mask.any(axis=1)` of an (N, K) mask; five times as fast if few values are true."""
    rows = np.zeros(len(mask), np.bool_)
    rows[np.flatnonzero(mask) // mask.shape[1]] = True
    return rows
