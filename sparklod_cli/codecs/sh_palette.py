"""Palettes of spherical harmonics: a few codes for the coefficients of many splats, and a label for each splat.

Codes are found by k-means clustering of the coefficients. Its distance is their squared error, which is the squared
error of the colour over all directions, since spherical harmonics are orthonormal. With few rows to a code, the error
depends more on the start of k-means than on its passes, most of whose time finds the nearest code of each row. So:

1. Equal rows become one row with their weight.
2. Bisection: cells of rows are halved, always those whose error shrinks most, until there are as many cells as codes. A
   cell is cut across its direction of largest spread.
3. Passes of k-means search the code of a row among the neighbours of its present code.

There are no random numbers, and no sum depends on the number of threads: the same rows always give the same palette.
docs/decisions/09-palettes-and-sog.md has measurements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..model.splats import FloatArray, Splats
from ..system.progress import Progress, silent
from ..system.threads import blocks_of, on_threads

#: Passes of k-means, and those before which the neighbours of all codes are found anew. Measured: more passes gain less
#: than 0.5 % of the error.
PASSES, FRESH = 6, (0, 3)

#: Neighbours of a code that are tried for its rows, a multiple of `sh_clustering.LANES`; and groups of
#: `sh_clustering.GROUP` codes that are searched for these neighbours. Measured.
NEIGHBOURS, SEARCH = 48, 16

#: Least gain of cells that are halved together, as a share of the largest gain. Measured: 0.8 takes three times as many
#: rounds for less than 1.5 % of the error.
TOGETHER = 0.5

#: Least weight of a row, as a share of the mean: rows without weight also get codes. Chosen.
WEIGHT_FLOOR = 1e-6

#: Power of the visible area in `visible_weight`. Measured: 1 is better in far views, 0.5 in near ones.
AREA_POWER = 0.75

Indices = NDArray[np.uint32]
Weights = NDArray[np.float64]
Offsets = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ShPalette:
    """Palette of spherical harmonics: (C, K, 3) coefficients as in `Splats.sh`, all in use, and (N,) codes of rows."""

    codes: FloatArray
    labels: Indices

    def expand(self) -> FloatArray:
        """Return the (N, K, 3) float32 coefficients of all rows."""
        return self.codes[self.labels]


def visible_weight(splats: Splats) -> Weights:
    """Return the (N,) visibility of errors in the SH of splats: (opacity * area of the two longest axes) ** AREA_POWER.

    The power below 1 leaves weight to small splats, which are seen from near by.
    """
    axes = np.sort(splats.scale.astype(np.float64), axis=1)
    weight: Weights = (splats.opacity * axes[:, 1] * axes[:, 2]) ** AREA_POWER
    return weight


def cluster(
    sh: FloatArray, codes: int, *, weight: ArrayLike | None = None, threads: int | None = 1, progress: Progress = silent
) -> ShPalette:
    """Cluster the SH coefficients of splats into a palette of at most `codes` entries.

    The result does not depend on the number of threads. With at most `codes` distinct rows, the palette holds exactly
    these. Otherwise each row gets an entry by an approximate search for the nearest one, whose total squared error is
    about 1 % above that of an exact search.

    Args:
        sh: (N, K, 3) finite float32 coefficients, K at least 1.
        codes: largest number of entries, 1 to `formats.MAX_SH_CODES`.
        weight: (N,) weights of the squared errors of rows, finite and at least 0; None for equal weights.
        threads: number of threads; None for all processors.
        progress: receives the number of cells into which rows were split, and then the passes of k-means.

    Raises:
        ValueError: a coefficient is not finite.
    """
    rows = np.ascontiguousarray(sh, np.float32).reshape(len(sh), 3 * sh.shape[1])
    if len(rows) and not (np.isfinite(rows.min()) and np.isfinite(rows.max())):
        raise ValueError("sh holds NaN or infinity; give finite coefficients")
    of_rows = _weights(weight, len(rows))
    with on_threads(threads):
        first, inverse = _distinct(rows)
        if len(first) <= codes:
            return ShPalette(sh[first], inverse)
        of_first = np.zeros(len(first))
        np.add.at(of_first, inverse, of_rows)
        clustering = _Clustering(rows, first, of_first, progress)
        found, labels = clustering.run(codes)
    return ShPalette(found.reshape(len(found), *sh.shape[1:]), labels[inverse])


def _weights(weight: ArrayLike | None, count: int) -> Weights:
    """Return positive weights of rows with a mean of 1."""
    if weight is None:
        return np.ones(count)
    relative = np.asarray(weight, np.float64)
    largest = relative.max(initial=0)
    if not largest > 0:
        return np.ones(count)
    relative = relative / largest
    relative /= relative.mean()
    return np.maximum(relative, WEIGHT_FLOOR)


def _distinct(rows: FloatArray) -> tuple[Indices, Indices]:
    """Return the first row of each set of equal rows, ascending, and the place of each row among these."""
    from .kernels.sh_clustering import hash_rows

    key = np.empty(len(rows), np.uint64)
    hash_rows(len(rows), (rows + np.float32(0)).view(np.uint32), key)  # -0 becomes 0
    order = np.argsort(key, kind="stable")
    is_first = np.ones(len(rows), np.bool_)
    same_key = np.flatnonzero(key[order[1:]] == key[order[:-1]])
    is_first[1:][same_key] = (rows[order[same_key + 1]] != rows[order[same_key]]).any(axis=1)
    group = np.cumsum(is_first) - 1
    first = order[is_first]
    rank = np.empty(len(first), np.uint32)
    ascending = np.argsort(first)
    rank[ascending] = np.arange(len(first), dtype=np.uint32)
    inverse = np.empty(len(rows), np.uint32)
    inverse[order] = rank[group]
    return first[ascending].astype(np.uint32), inverse


class _Clustering:
    """Clustering of (M,) rows, `first`, of (N, D) float32 rows, by their weights."""

    def __init__(self, rows: FloatArray, first: Indices, weight: Weights, progress: Progress) -> None:
        self._rows = rows
        self._first = first
        self._weight = np.zeros(len(rows))
        self._weight[first] = weight
        self._progress = progress

    def run(self, codes: int) -> tuple[FloatArray, Indices]:
        """Return (C, D) codes, and (M,) labels of the rows."""
        from .kernels.sh_clustering import average_cells, choose_codes

        members, begin = self._bisect(codes)
        table = np.empty((len(begin) - 1, self._rows.shape[1]), np.float32)
        average_cells(len(table), self._rows, self._weight, members, begin, table)
        labels, errors = np.zeros(len(self._rows), np.int32), np.zeros(len(self._rows), np.float32)
        for number in range(PASSES):
            self._progress("clustering", number, PASSES, "pass")
            if number in FRESH:
                near, distance = _neighbours(table)
            else:
                distance = np.zeros_like(distance)  # unknown, since codes have moved
            choose_codes(len(table), self._rows, members, begin, table, near, distance, labels, errors)
            if number < PASSES - 1:
                members, begin = self._cells(labels, len(table))
                empty = np.flatnonzero(begin[1:] == begin[:-1])
                if len(empty):
                    self._refill(empty, labels, errors)
                    members, begin = self._cells(labels, len(table))
                average_cells(len(table), self._rows, self._weight, members, begin, table)
        self._progress("clustering", PASSES, PASSES, "pass")
        used, compact = np.unique(labels[self._first], return_inverse=True)
        return table[used], compact.astype(np.uint32)

    def _bisect(self, codes: int) -> tuple[Indices, Offsets]:
        """Divide the rows into `codes` cells, or fewer if rows are too near each other.

        Every new cell is halved at once to know the gain of replacing it by its halves; then the cells with the largest
        gain are replaced. Returns (M,) rows, cell after cell, and the (C + 1,) begins of cells.
        """
        from .kernels.sh_clustering import halve_cells

        members, places = self._first.copy(), np.empty(len(self._first))
        begin, end = np.zeros(1, np.int64), np.array([len(members)])
        error = np.array([np.inf])
        cut, halves = np.empty(1, np.int64), np.empty((1, 2))
        halve_cells(1, self._rows, self._weight, members, begin, end, cut, halves, places)
        while len(begin) < codes:
            self._progress("bisecting", len(begin), codes, "code")
            gain = np.where(end - begin > 1, error - halves.sum(axis=1), 0)
            chosen = np.flatnonzero((gain >= TOGETHER * gain.max()) & (gain > 0))
            if not len(chosen):
                break
            if len(chosen) > codes - len(begin):
                chosen = np.sort(chosen[np.argsort(-gain[chosen], kind="stable")[: codes - len(begin)]])
            made = np.concatenate([begin[chosen], cut[chosen]]), np.concatenate([cut[chosen], end[chosen]])
            cut_made, halves_made = np.empty(len(made[0]), np.int64), np.empty((len(made[0]), 2))
            halve_cells(len(made[0]), self._rows, self._weight, members, *made, cut_made, halves_made, places)
            kept = np.ones(len(begin), np.bool_)
            kept[chosen] = False
            error = np.concatenate([error[kept], halves[chosen].T.ravel()])
            begin, end = np.concatenate([begin[kept], made[0]]), np.concatenate([end[kept], made[1]])
            cut, halves = np.concatenate([cut[kept], cut_made]), np.concatenate([halves[kept], halves_made])
        return members, np.append(np.sort(begin), len(members))

    def _cells(self, labels: NDArray[np.int32], codes: int) -> tuple[Indices, Offsets]:
        """Return the rows of each code, ascending, code after code, and the begins of these cells."""
        of_first = labels[self._first].astype(np.uint16)  # which numpy sorts by radix
        begin = np.concatenate([[0], np.cumsum(np.bincount(of_first, minlength=codes))])
        return self._first[np.argsort(of_first, kind="stable")], begin

    def _refill(self, empty: NDArray[np.intp], labels: NDArray[np.int32], errors: FloatArray) -> None:
        """Give codes without rows the rows with the largest errors, one each."""
        cost = self._weight[self._first] * errors[self._first]
        worst = np.argsort(-cost, kind="stable")[: len(empty)]
        worst = worst[cost[worst] > 0]
        labels[self._first[worst]] = empty[: len(worst)]


def _neighbours(table: FloatArray) -> tuple[NDArray[np.int32], FloatArray]:
    """Return the (C, NEIGHBOURS) nearest codes of each code, nearest first, and their squared distances."""
    from .kernels.sh_clustering import GROUP, find_neighbours

    count, width = table.shape
    starts = np.arange(0, count, GROUP)
    padded = np.zeros((len(starts) * GROUP, width), np.float32)
    padded[:count] = table
    blocks = np.ascontiguousarray(padded.reshape(len(starts), GROUP, width).transpose(0, 2, 1))
    sums = np.add.reduceat(table, starts, axis=0, dtype=np.float64)
    means = (sums / np.diff(np.append(starts, count))[:, None]).astype(np.float32)
    near, distance = np.empty((count, NEIGHBOURS), np.int32), np.empty((count, NEIGHBOURS), np.float32)
    find_neighbours(len(means), table, blocks, means, min(SEARCH, len(starts)), near, distance)
    return near, distance


#: Codes of a group in `labels_of`, and groups that are searched for a row. Measured: the squared error of all rows is 1
#: to 2 % larger than with the nearest code of 16,384, and up to 9 % with 45,000 codes that merely differ.
GROUP, SEARCHED = 256, 16


def labels_of(sh: FloatArray, codes: FloatArray) -> NDArray[np.uint32]:
    """Return (N,) uint32 codes of other rows: the nearest code or, for few rows, nearly.

    The search is limited to the groups of codes whose means are nearest to the row.

    Args:
        sh: (N, K, 3) finite float32 coefficients.
        codes: (C, K, 3) coefficients of a palette, C at least 1.
    """
    table = codes.reshape(len(codes), -1).astype(np.float64)
    groups = _groups(table, np.arange(len(table)))
    means = np.stack([table[group].mean(axis=0) for group in groups])
    half, half_of_means = (np.einsum("ij,ij->i", each, each) / 2 for each in (table, means))
    search = min(SEARCHED, len(groups))
    labels = np.empty(len(sh), np.uint32)
    for part in blocks_of(len(sh)):
        # |row - code|^2 / 2 without |row|^2 / 2, which is the same for all codes.
        rows = sh[part].reshape(part.stop - part.start, -1).astype(np.float64)
        near = np.argpartition(half_of_means - rows @ means.T, search - 1, axis=1)[:, :search].ravel()
        by_group = np.argsort(near, kind="stable")
        begin = np.searchsorted(near[by_group], np.arange(len(groups) + 1))
        least, found = np.full(len(rows), np.inf), np.zeros(len(rows), np.uint32)
        for number, group in enumerate(groups):
            members = by_group[begin[number] : begin[number + 1]] // search
            distances = half[group] - rows[members] @ table[group].T
            nearest = distances.argmin(axis=1)
            distance = distances[np.arange(len(members)), nearest]
            nearer = distance < least[members]
            least[members[nearer]], found[members[nearer]] = distance[nearer], group[nearest[nearer]]
        labels[part] = found
    return labels


def _groups(table: NDArray[np.float64], codes: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Divide codes of a (C, D) table into groups of at most `GROUP`, by halving along the most varied coefficient."""
    if len(codes) <= GROUP:
        return [codes]
    rows = table[codes]
    ordered = codes[np.argsort(rows[:, rows.var(axis=0).argmax()], kind="stable")]
    middle = len(codes) // 2
    return [*_groups(table, ordered[:middle]), *_groups(table, ordered[middle:])]
