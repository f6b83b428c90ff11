"""Morton codes of cells, a parallel, stable radix sort, and separation of the nodes in a box."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model.splats import FloatArray
from ...system.jit import f4, f8, i4, i8, kernel, out, u4, u8

Keys = NDArray[np.uint64]
Nodes = NDArray[np.uint32]

#: Bits per axis in one 64-bit Morton word: 3 x 21 = 63.
AXIS_BITS = 21

#: Bits that one pass of the radix sort sorts by: 2048 counters fit the first-level cache. Measured against 8, 9 and 12;
#: results do not depend on it.
DIGIT_BITS = 11

#: Bits per axis of the parts of a cell: 8 x 8 x 8 of them.
PART_BITS = 3


@dataclass(frozen=True, eq=False)
class Parts:
    """The parts of the cells of a level, in units of `node_rows.Space`."""

    step: np.float64  # edge of a part; that of a cell is 2 ** PART_BITS times it
    low: NDArray[np.int64]  # (3,) int64, the lowest part of the scene's lowest cell: the origin of offsets
    axis_bits: int  # number of bits of the largest offset of a part, up to 63
    words: int  # number of 63-bit words of the Morton codes of parts


@kernel()
def spread_bits(x):
    """Return the low 21 bits of a uint64, each followed by two zero bits."""
    x &= np.uint64(0x1FFFFF)
    x = (x | (x << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    x = (x | (x << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    x = (x | (x << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    x = (x | (x << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (x | (x << np.uint64(2))) & np.uint64(0x1249249249249249)


@kernel()
def interleave(i, j, k):
    """Return the Morton code of three uint64 coordinates of 21 bits; the lowest bit is of `i`."""
    return spread_bits(i) | (spread_bits(j) << np.uint64(1)) | (spread_bits(k) << np.uint64(2))


@kernel()
def morton_code(x, y, z, step, low, shift):
    """Return the Morton code of bits shift .. shift + 20 of floor(centre / step) - low on each axis."""
    i = np.uint64(np.int64(math.floor(x / step)) - low[0]) >> shift
    j = np.uint64(np.int64(math.floor(y / step)) - low[1]) >> shift
    k = np.uint64(np.int64(math.floor(z / step)) - low[2]) >> shift
    return interleave(i, j, k)


@kernel(i8, f4[:, :], u4[:], f8, i8[:], i8, out(u8[:]), ranges=True)
def fill_cell_words(start, stop, geometry, nodes, step, low, word, words):
    """Fill one 63-bit word of the Morton code of each node's cell.

    Args:
        geometry: node rows of `pair_merge.py`, or any array whose first columns are the centre.
        nodes: (n,) rows of it.
        step: edge of a cell.
        low: (3,) the lowest cell on each axis, so that offsets from it are not negative.
        word: index of the word, the lowest first; each has AXIS_BITS bits per axis.
    """
    shift = np.uint64(AXIS_BITS * word)
    for i in range(start, stop):
        x, y, z = geometry[nodes[i], 0], geometry[nodes[i], 1], geometry[nodes[i], 2]
        words[i] = morton_code(np.float64(x), np.float64(y), np.float64(z), step, low, shift)


def cell_words(geometry: FloatArray, nodes: Nodes, grid: Parts, word: int) -> Keys:
    """Return one 63-bit word of the Morton code of the part that each node is in; see `fill_cell_words`."""
    words = np.empty(len(nodes), np.uint64)
    fill_cell_words(len(nodes), geometry, nodes, grid.step, grid.low, word, words)
    return words


@kernel(i8, u8[:], i8, out(i8[:, :]), ranges=True)
def count_keys(begin, end, keys, shift, counts):
    """Count the keys of each block by `bits` bits from `shift` on, into (blocks, 1 << bits) `counts`."""
    low, mask = np.uint64(shift), np.uint64(counts.shape[1] - 1)
    for block in range(begin, end):
        for i in range(len(keys) * block // len(counts), len(keys) * (block + 1) // len(counts)):
            counts[block, (keys[i] >> low) & mask] += 1


@kernel(i8, u8[:], u4[:], i8, out(i8[:, :]), out(u8[:]), out(u4[:]), ranges=True)
def place_keys(begin, end, keys, values, shift, places, keys_out, values_out):
    """Write keys and their values in the order of the bits of `count_keys`.

    `places` has the place of the next key for each block and each value of the bits; it is updated.
    """
    low, mask = np.uint64(shift), np.uint64(places.shape[1] - 1)
    for block in range(begin, end):
        for i in range(len(keys) * block // len(places), len(keys) * (block + 1) // len(places)):
            bucket = (keys[i] >> low) & mask
            to = places[block, bucket]
            places[block, bucket] = to + 1
            keys_out[to] = keys[i]
            values_out[to] = values[i]


def sort_by_key(keys: Keys, values: Nodes, key_bits: int, blocks: int) -> tuple[Keys, Nodes]:
    """Return (n,) uint64 keys below 2 ** key_bits and (n,) values, sorted stably by key; overwrites its inputs.

    `blocks` is the number of parallel ranges; the result does not depend on it.
    """
    passes = max(1, -(-key_bits // DIGIT_BITS))
    bits = max(1, -(-key_bits // passes))
    other_keys, other_values = np.empty_like(keys), np.empty_like(values)
    for k in range(passes):
        counts = np.zeros((blocks, 1 << bits), np.int64)
        count_keys(blocks, keys, k * bits, counts)
        places = np.cumsum(counts.T).reshape(-1, blocks).T - counts
        place_keys(blocks, keys, values, k * bits, np.ascontiguousarray(places), other_keys, other_values)
        keys, other_keys = other_keys, keys
        values, other_values = other_values, values
    return keys, values


def sort_by_cell(
    geometry: FloatArray, nodes: Nodes, grid: Parts, blocks: int, *, within: bool = True
) -> tuple[Nodes, NDArray[np.bool_]]:
    """Sort nodes in the Morton order of their cells and, within a cell, of its parts.

    Args:
        geometry, nodes: as for `fill_cell_words`.
        blocks: number of parallel ranges; the result does not depend on it.
        within: sort within cells, too; otherwise a cell's nodes stay in their order.

    Returns:
        (n,) sorted nodes, and (n,) whether each is the first of its cell.
    """
    axis_bits, words, in_cell = grid.axis_bits, grid.words, np.uint64(3 * PART_BITS)
    is_first = np.zeros(len(nodes), np.bool_)
    is_first[:1] = True
    for word in range(words):
        keys = cell_words(geometry, nodes, grid, word)
        if word == 0 and not within:
            keys &= ~((np.uint64(1) << in_cell) - np.uint64(1))
        keys, nodes = sort_by_key(keys, nodes.copy(), 3 * min(axis_bits - AXIS_BITS * word, AXIS_BITS), blocks)
    for word in range(words):
        if words > 1:  # `keys` holds the last word only
            keys = cell_words(geometry, nodes, grid, word)
        if word == 0:
            keys = keys >> in_cell
        is_first[1:] |= keys[1:] != keys[:-1]
    return nodes, is_first


@kernel(i8, f4[:, :], f4[:, :], f8[:], f8, i8[:], i8, out(u8[:]), out(i4[:]), ranges=True)
def fill_level_keys(begin, end, center, scale, steps, grid, low, cell_bits, keys, levels):
    """Fill the levels of splats, indices into `steps`, and keys that order splats by level and along a Morton curve.

    Args:
        steps: (L,) the cell edge of each level, a rising geometric series. The last is at least the largest size;
            splats smaller than the first belong to it.
        grid: edge of the cells of the curve.
        low: (3,) the lowest cell of the curve.
        cell_bits: number of bits of the curve, the lower bits of a key.
    """
    start = math.log(steps[0])
    per_level = (len(steps) - 1) / (math.log(steps[-1]) - start)
    for i in range(begin, end):
        size = 2 * np.float64(max(scale[i, 0], scale[i, 1], scale[i, 2]))
        level = min(max(np.int64(math.ceil((math.log(size) - start) * per_level)), 0), len(steps) - 1)
        # The logarithm is rounded, so the table of steps decides.
        while level > 0 and size <= steps[level - 1]:
            level -= 1
        while size > steps[level]:
            level += 1
        levels[i] = level
        x, y, z = np.float64(center[i, 0]), np.float64(center[i, 1]), np.float64(center[i, 2])
        keys[i] = morton_code(x, y, z, grid, low, np.uint64(0)) | (np.uint64(level) << np.uint64(cell_bits))


def split_box(
    nodes: NDArray[Any], geometry: NDArray[Any], below: NDArray[Any], above: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the nodes with centres between corners, (3,) `below` and `above`, and the other nodes, in their order."""
    inside, outside = np.empty(len(nodes), np.uint32), np.empty(len(nodes), np.uint32)
    count = fill_box(nodes, geometry, below, above, inside, outside)
    return inside[:count], outside[: len(nodes) - count].copy()


@kernel(u4[:], f4[:, :], f4[:], f4[:], out(u4[:]), out(u4[:]), returns=i8)
def fill_box(nodes, geometry, below, above, inside, outside):
    """Fill the arrays of `split_box` from the start; return the number of nodes inside."""
    n = m = 0
    for i in range(len(nodes)):
        x, y, z = geometry[nodes[i], 0], geometry[nodes[i], 1], geometry[nodes[i], 2]
        if below[0] < x < above[0] and below[1] < y < above[1] and below[2] < z < above[2]:
            inside[n] = nodes[i]
            n += 1
        else:
            outside[m] = nodes[i]
            m += 1
    return n
