"""Writing a file in windows, whether its splats are in memory or not, and counting the values that its codes clamp.

Each window is encoded alone, on any thread or machine, and its result stays in memory or in a store that machines
share. The pieces of the file are then made of the results.
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
            """Options with nothing left open."""

        @property
        def ranges(self) -> tuple[CodeRange, ...]:
            """Ranges of which the values beyond are counted; empty for no count."""

        def encode(self, splats: Splats, tree: LodTree | None, start: int) -> Encoded:
            """Encode a window, and `tally` the values beyond the ranges as `CLAMPED`.

            Args:
                tree: of the window, whose children have the numbers of the file; None where the file has no tree.
                start: number of the first splat; the start of one of `windows_of`.
            """

        def pieces(self, windows: Windows, *, threads: int, progress: Progress) -> Iterator[bytes]:
            """Return the bytes of the file, piece by piece, made of the results of all windows."""

        def keeping(self, stored: Any, unchanged: NDArray[np.bool_]) -> Encoder:
            """Return an encoder that gives (N,) unchanged nodes their codes of a file, by the codec's `stored`."""


#: The result of a window: arrays by name.
Encoded = dict[str, NDArray[Any]]

#: Results of the windows of a file: returns an array by the number of the window and its name, as often as asked.
Windows = Callable[[int, str], NDArray[Any]]

#: Name of the array that counts what a window clamps, see `tally`.
CLAMPED = "clamped"


@dataclass(frozen=True)
class CodeRange:
    """Values of a column that a format holds without clamping them.

    Attributes:
        column: of `Splats`.
        low, high: smallest and largest value that is rounded to a code.
        numbers: the first, and the one after the last, of the numbers of a splat that are meant; all by default.
        zero: values below this are held as 0.
        degree: of the SH that they are; 0 for other columns, or for SH of all degrees.
    """

    column: str
    low: float
    high: float
    numbers: tuple[int, int | None] = (0, None)
    zero: float = 0.0
    degree: int = 0


#: What SPZ holds.
SPZ_RANGES = tuple(CodeRange(column, low, high) for column, (low, high) in quantize.CLAMPS.items())


def windows_of(count: int) -> list[slice]:
    """Divide the splats of a file into windows."""
    return blocks_of(count, CHUNK_NODES)


def results(encoder: Encoder, scene: Scene, threads: int, progress: Progress, stage: str) -> Iterator[Encoded]:
    """Encode all windows of a scene in order, a few ahead; `stage` is the word for it that `progress` gets."""
    windows, tree = windows_of(len(scene)), scene.tree
    rows = ((scene.splats.take(part), None if tree is None else tree.rows(part), part.start) for part in windows)
    encoded = ordered_map(lambda arguments: encoder.encode(*arguments), rows, threads)
    for part, result in zip(windows, encoded, strict=True):
        progress(stage, part.stop, len(scene), "splat")
        yield result


#: Change of a splat's displayed colour, 0..1, from which on it is visible through those before it. Chosen.
STEP = 8 / 255

#: Most of a basis function of SH of degree 1, which others exceed by little.
BASIS = 0.5

#: Counts of what lies beyond ranges, see `tally`.
Tally = NDArray[np.float64]


def tally(splats: Splats, ranges: Sequence[CodeRange], leaf: NDArray[np.bool_] | None = None) -> Tally:
    """Count the values of splats that lie beyond ranges.

    The loss of a leaf can be seen if a coordinate is clamped; if its colour, as it is displayed on black, changes by
    `STEP` or more, as it is or by a coefficient of SH; or if it grows as a whole or shrinks. That a flat splat gets
    thicker than a number that small cannot be seen.

    Args:
        ranges: those of one column are side by side.
        leaf: (n,) which of them are leaves; None for all.

    Returns:
        (ranges, 9) float64: splats below the range, above, and either; splats beyond any range of its column; the
        least and the largest value, infinity and minus infinity without values; leaves with a visible loss below,
        above, and either.
    """
    found = np.zeros((len(ranges), 9))
    found[:, 4:6] = np.inf, -np.inf
    for name in dict.fromkeys(each.column for each in ranges):
        column, either = getattr(splats, name).reshape(len(splats), -1), np.zeros(len(splats), np.bool_)
        numbers = [number for number, each in enumerate(ranges) if each.column == name]
        for number in numbers:
            each = ranges[number]
            values = column[:, slice(*each.numbers)]
            if not values.size:
                continue
            if each.zero:
                values = np.where(values < each.zero, each.low, values)
            found[number, 4:6] = values.min(), values.max()
            if found[number, 4] >= each.low and found[number, 5] <= each.high:
                continue
            below, above = _rows_with(values < each.low), _rows_with(values > each.high)
            either |= below | above
            found[number, :3] = [np.count_nonzero(mask) for mask in (below, above, below | above)]
            rows = np.flatnonzero(below | above if leaf is None else (below | above) & leaf)
            seen = rows[_is_seen(each, values[rows], splats.opacity[rows])]
            found[number, 6:] = np.count_nonzero(below[seen]), np.count_nonzero(above[seen]), len(seen)
        found[numbers, 3] = np.count_nonzero(either)
    return found


@np.errstate(over="ignore")  # of numbers near the end of float32
def _is_seen(each: CodeRange, values: FloatArray, opacity: FloatArray) -> NDArray[np.bool_]:
    """Return (n,) whether the loss can be seen of leaves with values, (n, K), beyond a range."""
    if each.column == "center":
        return np.ones(len(values), np.bool_)
    if each.column == "scale":
        return (values.max(axis=1) < each.low) | (values.max(axis=1) > each.high)
    alpha, held = opacity[:, None], np.clip(values, each.low, each.high)
    if each.column == "rgb":
        change = np.clip(alpha * values, 0, 1) - np.clip(alpha * held, 0, 1)
    else:
        change = BASIS * alpha * (values - held)
    return _rows_with(np.abs(change) >= STEP)


def _rows_with(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (N,) which rows of an (N, K) mask have a true value; where few do, five times as fast as `any`."""
    rows = np.zeros(len(mask), np.bool_)
    rows[np.flatnonzero(mask) // mask.shape[1]] = True
    return rows
