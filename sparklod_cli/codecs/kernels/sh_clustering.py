"""Kernels of the clustering of spherical harmonics: hashes of rows, cells of rows that are halved, and nearest codes.

A cell is a range of `members`, the indices of its rows; it is halved across the direction in which it spreads most.
Codes are in groups of GROUP whose codes are near each other, so that the neighbours of a code are found in the groups
that are nearest to its own. Distances are squared, and computed for many codes at a time: of a block of codes, the same
coefficient is beside itself in memory.

Arrays that kernels share: `rows` (N, D); `weight` (N,), positive, in float64; `cell` (n,), rows of a cell; `members`
(M,), rows, cell after cell or code after code; `begin`, where each of these begins in `members`; `codes` (C, D).
"""

from __future__ import annotations

import numpy as np

from ...system.jit import f4, f8, i4, i8, kernel, out, u4, u8

#: Rows that a cell's direction is found from, spaced evenly over its members. Measured: 8,192 gain nothing.
SAMPLE = 2048

#: Rounds of the power iteration that finds the direction. Measured: the error after bisection with 3 is 1 to 2 %
#: larger.
ROUNDS = 6

#: Rounds of the two-means along the direction, from the mean of the cell. Chosen.
THRESHOLD_ROUNDS = 4


@kernel(inline=True)
def along(rows, i, axis):
    """Return the dot product of row i and an axis, in four sums, which LLVM keeps in one register."""
    width = len(axis)
    a = b = c = e = 0.0
    d = 0
    while d + 3 < width:
        a += rows[i, d] * axis[d]
        b += rows[i, d + 1] * axis[d + 1]
        c += rows[i, d + 2] * axis[d + 2]
        e += rows[i, d + 3] * axis[d + 3]
        d += 4
    while d < width:
        a += rows[i, d] * axis[d]
        d += 1
    return (a + b) + (c + e)


@kernel()
def find_direction(rows, weight, cell, mean, axis):
    """Fill the weighted mean of a cell's rows, and the unit vector along which they spread most; both of a sample.

    A cell has at least 2 rows. The axis is 0 if the rows of the sample are equal.
    """
    width = rows.shape[1]
    step = max(1, len(cell) // SAMPLE)
    spread = np.zeros(width)
    mean[:] = 0
    axis[:] = 0
    total = 0.0
    for a in range(0, len(cell), step):
        i = cell[a]
        total += weight[i]
        for d in range(width):
            mean[d] += weight[i] * rows[i, d]
    for d in range(width):
        mean[d] /= total
    for a in range(0, len(cell), step):
        i = cell[a]
        for d in range(width):
            x = rows[i, d] - mean[d]
            spread[d] += weight[i] * x * x
    axis[np.argmax(spread)] = 1
    for _ in range(ROUNDS):
        spread[:] = 0
        middle = 0.0
        for d in range(width):
            middle += mean[d] * axis[d]
        for a in range(0, len(cell), step):
            i = cell[a]
            p = weight[i] * (along(rows, i, axis) - middle)
            for d in range(width):
                spread[d] += p * (rows[i, d] - mean[d])
        length = 0.0
        for d in range(width):
            length += spread[d] * spread[d]
        length = np.sqrt(length)
        if not length > 0:
            break
        for d in range(width):
            axis[d] = spread[d] / length


@kernel()
def find_threshold(weight, cell, place):
    """Return where to cut places along a line, so that both sides are near their means: two-means in one dimension."""
    threshold = 0.0
    for _ in range(THRESHOLD_ROUNDS):
        low = low_weight = high = high_weight = 0.0
        for a in range(len(cell)):
            w = weight[cell[a]]
            if place[a] <= threshold:
                low += w * place[a]
                low_weight += w
            else:
                high += w * place[a]
                high_weight += w
        if not (low_weight > 0 and high_weight > 0):
            break
        threshold = 0.5 * (low / low_weight + high / high_weight)
    return threshold


@kernel()
def partition(cell, place, threshold):
    """Move members at or below the threshold to the front, and return how many there are."""
    i, j = 0, len(cell) - 1
    while i <= j:
        if place[i] <= threshold:
            i += 1
        else:
            cell[i], cell[j] = cell[j], cell[i]
            place[i], place[j] = place[j], place[i]
            j -= 1
    return i


@kernel()
def squared_error(rows, weight, cell, origin):
    """Return the weighted sum of squared distances of a cell's rows to their weighted mean.

    Sums are taken from `origin` (D,), near the rows, so that little cancels.
    """
    width = rows.shape[1]
    total, squares = np.zeros(width), np.zeros(width)
    mass = 0.0
    for a in range(len(cell)):
        i = cell[a]
        mass += weight[i]
        for d in range(width):
            x = rows[i, d] - origin[d]
            total[d] += weight[i] * x
            squares[d] += weight[i] * x * x
    error = 0.0
    for d in range(width):
        error += squares[d] - total[d] * total[d] / mass
    return max(error, 0.0)


@kernel(i8, f4[:, :], f8[:], out(u4[:]), i8[:], i8[:], out(i8[:]), out(f8[:, :]), out(f8[:]), ranges=True)
def halve_cells(start, stop, rows, weight, members, begin, end, cuts, errors, places):
    """Sort the members of each cell into two halves.

    Args:
        begin, end: (n,) the range of members of each cell; ranges do not overlap.
        cuts: (n,) filled with where the second half begins; a cell with one member is not cut.
        errors: (n, 2) filled with the squared error of each half.
        places: (M,) for intermediate results.
    """
    width = rows.shape[1]
    for k in range(start, stop):
        cell, place = members[begin[k] : end[k]], places[begin[k] : end[k]]
        cuts[k] = begin[k] + len(cell) // 2
        errors[k, 0] = errors[k, 1] = 0
        if len(cell) > 2:
            mean, axis = np.empty(width), np.empty(width)
            find_direction(rows, weight, cell, mean, axis)
            middle = 0.0
            for d in range(width):
                middle += mean[d] * axis[d]
            for a in range(len(cell)):
                place[a] = along(rows, cell[a], axis) - middle
            first = partition(cell, place, find_threshold(weight, cell, place))
            if first == 0 or first == len(cell):  # equal places, as rows of the sample may have been
                first = len(cell) // 2
            cuts[k] = begin[k] + first
            errors[k, 0] = squared_error(rows, weight, cell[:first], mean)
            errors[k, 1] = squared_error(rows, weight, cell[first:], mean)


@kernel(i8, f4[:, :], f8[:], u4[:], i8[:], out(f4[:, :]), ranges=True)
def average_cells(start, stop, rows, weight, members, begin, codes):
    """Fill each code with the weighted mean of the rows of its cell; codes of empty cells are left as they are."""
    width = rows.shape[1]
    for c in range(start, stop):
        if begin[c] < begin[c + 1]:
            total = np.zeros(width)
            mass = 0.0
            for a in range(begin[c], begin[c + 1]):
                i = members[a]
                mass += weight[i]
                for d in range(width):
                    total[d] += weight[i] * rows[i, d]
            for d in range(width):
                codes[c, d] = np.float32(total[d] / mass)


#: Codes of a group.
GROUP = 256

#: Codes whose distance to a row is computed at a time.
LANES = 16


@kernel(i8, f4[:, :], f4[:, :, :], f4[:, :], i8, out(i4[:, :]), out(f4[:, :]), ranges=True)
def find_neighbours(start, stop, codes, blocks, groups, search, near, distance):
    """Fill the nearest other codes of each code, nearest first, from the groups that are nearest to its own.

    Args:
        blocks: (G, D, GROUP) the codes of each group.
        groups: (G, D) the mean of each.
        search: number of groups to search, at most G.
        near: (C, n) filled; the code itself where there are not as many others.
        distance: (C, n) filled with squared distances, infinite there.
    """
    width, count = codes.shape[1], near.shape[1]
    for g in range(start, stop):
        away = np.zeros(len(groups))
        for h in range(len(groups)):
            for d in range(width):
                x = np.float64(groups[g, d]) - np.float64(groups[h, d])
                away[h] += x * x
        nearest = np.argsort(away, kind="mergesort")[:search]
        sums = np.empty(GROUP, np.float32)
        for c in range(g * GROUP, min(len(codes), g * GROUP + GROUP)):
            near[c] = c
            distance[c] = np.inf
            for h in nearest:
                sums[:] = 0
                for d in range(width):
                    for lane in range(GROUP):
                        x = codes[c, d] - blocks[h, d, lane]
                        sums[lane] += x * x
                for lane in range(min(GROUP, len(codes) - h * GROUP)):
                    if sums[lane] < distance[c, count - 1] and h * GROUP + lane != c:
                        at = count - 1
                        while at > 0 and distance[c, at - 1] > sums[lane]:
                            distance[c, at], near[c, at] = distance[c, at - 1], near[c, at - 1]
                            at -= 1
                        distance[c, at], near[c, at] = sums[lane], h * GROUP + lane


@kernel(i8, f4[:, :], u4[:], i8[:], f4[:, :], i4[:, :], f4[:, :], out(i4[:]), out(f4[:]), ranges=True)
def choose_codes(start, stop, rows, members, begin, codes, near, distance, labels, errors):
    """Fill the nearest code of each row, among its present code and that code's neighbours.

    The search ends at neighbours that are twice as far from the code as the row is: by the triangle inequality, none
    beyond is nearer to the row.

    Args:
        near: (C, n) the neighbours of each code, nearest first; n is a multiple of LANES.
        distance: (C, n) at most their squared distances.
        labels: (N,) filled for all members.
        errors: (N,) filled with the squared distance of each row to its code.
    """
    width, parts = codes.shape[1], near.shape[1] // LANES
    block, sums = np.empty((parts, width, LANES), np.float32), np.empty(LANES, np.float32)
    for c in range(start, stop):
        filled = 0
        for a in range(begin[c], begin[c + 1]):
            i = members[a]
            best, label = np.float32(0), c
            for d in range(width):
                x = rows[i, d] - codes[c, d]
                best += x * x
            own = best
            for part in range(parts):
                if distance[c, part * LANES] >= np.float32(4) * own:
                    break
                if filled == part:
                    for lane in range(LANES):
                        for d in range(width):
                            block[part, d, lane] = codes[near[c, part * LANES + lane], d]
                    filled += 1
                sums[:] = 0
                for d in range(width):
                    for lane in range(LANES):
                        x = rows[i, d] - block[part, d, lane]
                        sums[lane] += x * x
                for lane in range(LANES):
                    if sums[lane] < best:
                        best, label = sums[lane], near[c, part * LANES + lane]
            labels[i] = label
            errors[i] = best


#: Odd multipliers with irregular bits: 2 ** 64 / golden ratio, and the second of MurmurHash3's finalizer.
SPREAD, MIX = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC4CEB9FE1A85EC53)
SHIFT = np.uint64(29)


@kernel(i8, u4[:, :], out(u8[:]), ranges=True)
def hash_rows(start, stop, bits, hashes):
    """Fill a hash of each row of (N, D) words: equal for equal rows, different for nearly all others."""
    for i in range(start, stop):
        mixed = SPREAD
        for d in range(bits.shape[1]):
            mixed = (mixed ^ np.uint64(bits[i, d])) * MIX
            mixed ^= mixed >> SHIFT
        hashes[i] = mixed
