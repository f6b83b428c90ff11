"""Labels of a palette of spherical harmonics for splats that it was not made of.

Numbers are products and sums of float64 without kernels, so that windows can be labelled on any thread.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray
from ..support.parallel import blocks_of

#: Codes of a group, and the groups that are searched for a row. Measured: the squared error of all rows is 1 to 2 %
#: larger than with the nearest code of 16,384, and up to 9 % with 45,000 that nothing but equality told apart.
GROUP, SEARCH = 256, 16


def labels_of(sh: FloatArray, codes: FloatArray) -> NDArray[np.uint32]:
    """The codes of rows that the palette was not made of: the nearest of all or, of few rows, nearly.

    The nearest code is looked for in the groups of codes whose means are nearest to the row.

    Args:
        sh: (N, K, 3) finite float32 coefficients.
        codes: (C, K, 3) those of a `sh_palette.ShPalette`, C at least 1.

    Returns:
        (N,) uint32.
    """
    table = codes.reshape(len(codes), -1).astype(np.float64)
    groups = _groups(table, np.arange(len(table)))
    means = np.stack([table[group].mean(axis=0) for group in groups])
    half, half_of_means = (np.einsum("ij,ij->i", each, each) / 2 for each in (table, means))
    search = min(SEARCH, len(groups))
    labels = np.empty(len(sh), np.uint32)
    for part in blocks_of(len(sh)):
        # Of |row - code|^2 / 2, |row|^2 / 2 is left out: it is the same for all codes.
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
    """Codes in groups of at most `GROUP` that are near each other, halved along the coefficient that varies most.

    Args:
        table: (C, D) all codes.
        codes: some of them, at least 1.
    """
    if len(codes) <= GROUP:
        return [codes]
    rows = table[codes]
    ordered = codes[np.argsort(rows[:, rows.var(axis=0).argmax()], kind="stable")]
    middle = len(codes) // 2
    return [*_groups(table, ordered[:middle]), *_groups(table, ordered[middle:])]
