"""Reads the prefix codes of lossless WebP (RFC 9649, section 3.7) into tables by which pixels are decoded.

A number of a table is symbol * 16 + bits; `LONG` stands for codes of more bits than the table's, which are found by
their length. Bits come first to last from 64-bit words, least significant first.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...support.jit import kernel

#: Codes of a group: green, lengths and the cache; red; blue; alpha; distances.
CODES = 5

#: Lengths beside the 256 values of green, the values of another colour, and distances.
LENGTHS, VALUES, DISTANCES = 24, 256, 40

#: Columns of a group: where the table of each code begins, the last index of each, where its long codes begin.
FIRST, MASK, FAR, COLUMNS = 0, 5, 10, 16

#: Most bits of a code; the number in a table that stands for longer codes; and how many numbers come before the symbols
#: of these: the end of the codes of each length, aligned to 15 bits, and what is added to a code to find its symbol.
MOST_BITS, LONG, ENDS = 15, 0xFFFF, 32

#: Largest alphabet, with a cache of 2048 colours.
LARGEST = VALUES + LENGTHS + 2048

#: What a kernel answers: done, more input or more room is needed, or the codes are corrupt.
DONE, INPUT, ROOM, CORRUPT = 0, 1, 2, 3

#: The order in which the lengths of the codes of lengths are stored.
ORDER = np.array([17, 18, 0, 1, 2, 3, 4, 5, 16, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15], np.int64)

#: Bits of the table of the codes of lengths.
SHORT_BITS = 7


class Tables(NamedTuple):
    """Where the codes of an image go.

    Attributes:
        groups: (G, COLUMNS) uint32.
        table, longs: (T,) uint16 and (L,) int32, the tables and the long codes of all groups.
        used: (2,) int64, how many numbers of these two are in use.
    """

    groups: Any
    table: Any
    longs: Any
    used: Any


_ONE, _IN_WORD, _WORD = np.uint64(1), np.uint64(63), np.uint64(6)


@kernel(nogil=True, inline=True)
def bits_at(words, bit):
    """The 64 bits from a bit on, as uint64; both words that they are in must exist."""
    word, shift = bit >> _WORD, bit & _IN_WORD
    return (words[word] >> shift) | ((words[word + _ONE] << _ONE) << (_IN_WORD - shift))


@kernel(nogil=True)
def _reversed(code, bits):
    out = 0
    for _ in range(bits):
        out = out << 1 | code & 1
        code >>= 1
    return out


@kernel(nogil=True)
def _add_code(lengths, alphabet, most, table, longs, used, group, which):
    """Makes the table of a code of `alphabet` lengths; False if they are not those of a complete code."""
    count = np.zeros(MOST_BITS + 1, np.int64)
    last = 0
    for symbol in range(alphabet):
        count[lengths[symbol]] += 1
        if lengths[symbol]:
            last = symbol
    count[0] = 0
    group[FIRST + which] = used[0]
    if count.sum() == 1:
        group[MASK + which] = 0
        table[used[0]] = last << 4
        used[0] += 1
        return True
    full, longest, code = 0, 0, 0
    following = np.zeros(MOST_BITS + 2, np.int64)  # the next code of each length
    for bits in range(1, MOST_BITS + 1):
        full += count[bits] << (MOST_BITS - bits)
        following[bits] = code
        code = (code + count[bits]) << 1
        if count[bits]:
            longest = bits
    if full != 1 << MOST_BITS:
        return False
    bits_of_table = min(longest, most)
    size = 1 << bits_of_table
    far = used[1]
    group[MASK + which] = size - 1
    group[FAR + which] = far
    if longest > bits_of_table:
        at = ENDS
        for bits in range(MOST_BITS + 1):
            before = following[bits]
            longs[far + bits] = (before + count[bits]) << (MOST_BITS - bits) if bits > bits_of_table else 0
            longs[far + MOST_BITS + 1 + bits] = at - before
            if bits > bits_of_table:
                at += count[bits]
        used[1] += at
    for symbol in range(alphabet):
        bits = np.int64(lengths[symbol])
        if bits == 0:
            continue
        code = following[bits]
        following[bits] += 1
        begin = _reversed(code, bits)
        if bits <= bits_of_table:
            for place in range(used[0] + begin, used[0] + size, 1 << bits):
                table[place] = symbol << 4 | bits
        else:
            table[used[0] + (begin & (size - 1))] = LONG
            longs[far + longs[far + MOST_BITS + 1 + bits] + code] = symbol
    used[0] += size
    return True


@kernel(nogil=True)
def _read_lengths(words, at, lengths, alphabet):
    """Reads the lengths of a code that is stored with the codes of its lengths; False if they are corrupt."""
    bit = at[0]
    v = np.int64(bits_at(words, bit) & np.uint64(15))
    bit += np.uint64(4)
    own = np.zeros(19, np.int64)
    for k in range(4 + v):
        own[ORDER[k]] = np.int64(bits_at(words, bit) & np.uint64(7))
        bit += np.uint64(3)
    table = np.zeros(1 << SHORT_BITS, np.int64)
    full, symbols, code = 0, 0, 0
    for bits in range(1, SHORT_BITS + 1):
        for symbol in range(19):
            if own[symbol] == bits:
                for place in range(_reversed(code, bits), 1 << SHORT_BITS, 1 << bits):
                    table[place] = symbol << 4 | bits
                code += 1
                symbols += 1
                full += 1 << (SHORT_BITS - bits)
                if full > 1 << SHORT_BITS:
                    return False
        code <<= 1
    if symbols == 1:
        for symbol in range(19):
            if own[symbol]:
                table[:] = symbol << 4
    elif full != 1 << SHORT_BITS:
        return False
    left = alphabet
    v = np.int64(bits_at(words, bit) & np.uint64(0xFFFFFF))
    bit += _ONE
    if v & 1:
        size = 2 + 2 * (v >> 1 & 7)
        left = 2 + (v >> 4 & ((1 << size) - 1))
        bit += np.uint64(3 + size)
        if left > alphabet:
            return False
    before, symbol = 8, 0
    while symbol < alphabet and left > 0:
        left -= 1
        v = np.int64(bits_at(words, bit) & np.uint64(0xFFFF))
        entry = table[v & ((1 << SHORT_BITS) - 1)]
        value = entry >> 4
        v >>= entry & 15
        bit += np.uint64(entry & 15)
        if value < 16:
            lengths[symbol] = value
            symbol += 1
            if value:
                before = value
            continue
        extra = 2 if value == 16 else 3 if value == 17 else 7
        repeats = (v & ((1 << extra) - 1)) + (11 if value == 18 else 3)
        bit += np.uint64(extra)
        if symbol + repeats > alphabet:
            return False
        for _ in range(repeats):
            lengths[symbol] = before if value == 16 else 0
            symbol += 1
    at[0] = bit
    return True


@kernel(nogil=True)
def read_codes(words, at, limit, tables, done, cache, most):
    """Reads the codes of groups until there are no more, or input or room runs out.

    Args:
        words: (W,) uint64 input, with room behind for the codes of a group.
        at: uint64, of which the first is the position in it, in bits, which is moved.
        limit: position beyond which no group is begun.
        tables: filled behind what is in use.
        done: number of groups that were read before.
        cache: number of colours of the cache.
        most: most bits of a table.

    Returns:
        what came of it, and the number of groups that have been read.
    """
    groups, table, longs, used = tables
    lengths = np.zeros(LARGEST, np.uint8)
    for group in range(done, len(groups)):
        if at[0] > np.uint64(limit):
            return INPUT, group
        if used[0] + (CODES << most) > len(table) or used[1] + CODES * ENDS + LARGEST + 1024 > len(longs):
            return ROOM, group
        for which in range(CODES):
            alphabet = VALUES + LENGTHS + cache if which == 0 else DISTANCES if which == 4 else VALUES
            lengths[:] = 0
            v = np.int64(bits_at(words, at[0]) & np.uint64(0xFFFFF))
            if v & 1:
                size = 8 if v & 4 else 1
                lengths[v >> 3 & ((1 << size) - 1)] = 1
                if v & 2:
                    lengths[v >> (3 + size) & 255] = 1
                at[0] += np.uint64(3 + size + (8 if v & 2 else 0))
            else:
                at[0] += _ONE
                if not _read_lengths(words, at, lengths, alphabet):
                    return CORRUPT, group
            if not _add_code(lengths, alphabet, most, table, longs, used, groups[group], which):
                return CORRUPT, group
    return DONE, len(groups)
