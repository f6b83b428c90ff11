"""Decodes the pixels of lossless WebP (RFC 9649, section 3.6) as they are before its transforms are undone."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...support.jit import kernel
from .webp_codes import CORRUPT, DONE, FAR, INPUT, LONG, MASK, MOST_BITS, bits_at

#: Distances of the first 120 codes, as (columns to the left, rows up): the nearest pixels first.
NEAR = np.array(
    sorted(
        ((x, y) for y in range(8) for x in range(-7, 9) if y or x > 0),
        key=lambda each: (each[0] ** 2 + each[1] ** 2, abs(each[0]), -each[0]),
    ),
    np.int64,
)

#: The multiplier of the hash by which a colour finds its place in the cache.
HASH = np.uint64(0x1E35A7BD)

_0, _1, _4, _15 = np.uint64(0), np.uint64(1), np.uint64(4), np.uint64(15)
_8, _16, _24 = np.uint64(8), np.uint64(16), np.uint64(24)
_VALUES, _CACHED = np.uint64(256), np.uint64(280)
_ALL = np.uint64(0xFFFFFFFF)
_LONG = np.uint64(LONG)


class Codes(NamedTuple):
    """The codes of an image, and which of them each of its tiles has.

    Attributes:
        groups, table, longs: of `webp_codes.read_codes`.
        tiles: (T,) uint16 group of each tile, row by row; one if all pixels have the same.
        across: tiles of a row.
        shift: binary logarithm of the side of a tile, in pixels; 0 for a single one of all pixels.
        cache: (2 ** n,) uint32 colours by their hash; one colour if there is no cache.
        cache_shift: 32 - n; 32 if there is none.
        width, total: pixels of a row and of the image.
    """

    groups: Any
    table: Any
    longs: Any
    tiles: Any
    across: int
    shift: int
    cache: Any
    cache_shift: int
    width: int
    total: int


@kernel(nogil=True)
def _long_symbol(longs, far, v):
    """The symbol of a long code, and its bits."""
    code = 0
    for k in range(MOST_BITS):
        code = code << 1 | np.int64(v >> np.uint64(k) & _1)
    begin = np.int64(far)
    for bits in range(1, MOST_BITS + 1):
        if code < longs[begin + bits]:
            place = begin + longs[begin + MOST_BITS + 1 + bits] + (code >> (MOST_BITS - bits))
            return np.uint64(longs[place]) << _4 | np.uint64(bits)
    return _0  # not reached: a code is complete


@kernel(nogil=True, inline=True)
def _extended(symbol, v):
    """A length or distance from its symbol and the bits behind it; and the number of these."""
    if symbol < _4:
        return symbol + _1, _0
    extra = (symbol - np.uint64(2)) >> _1
    offset = (np.uint64(2) + (symbol & _1)) << extra
    return offset + (v & ((_1 << extra) - _1)) + _1, extra


@kernel(nogil=True)
def read_pixels(words, at, limit, codes, pixels, begin, stop):
    """Decodes pixels until `stop` is reached, or input runs out.

    Args:
        words: (W,) uint64 input, with two words behind the last bit.
        at: (3,) uint64, all moved: the position in it in bits, the number of the next pixel, and that of the first
            pixel that is not in the cache.
        limit: position beyond which no pixel is begun.
        codes: of the image.
        pixels: (P,) uint32 of A R G B from the most significant byte, filled; with room for 4096 beyond `stop`.
        begin: number of the first of `pixels`.
        stop: number of a pixel.

    Returns:
        what came of it; `stop` may be passed.
    """
    groups, table, longs, tiles, across, shift, cache, cache_shift, width, total = codes
    first, last, end = np.uint64(begin), np.uint64(stop), np.uint64(limit)
    bit, pixel, cached = at[0], at[1] - first, at[2] - first
    last -= first
    full = np.uint64(total) - first
    row, hashed = np.uint64(width), np.uint64(cache_shift)
    inside = (_1 << np.uint64(shift)) - _1
    answer = DONE
    while pixel < last:
        if bit > end:
            answer = INPUT
            break
        run_end, g = last, np.int64(0)
        if shift:
            y, x = (pixel + first) // row, (pixel + first) % row
            g = np.int64(tiles[(y >> np.uint64(shift)) * np.uint64(across) + (x >> np.uint64(shift))])
            run_end = min(last, pixel + min(inside + _1 - (x & inside), row - x))
        group = groups[g]
        green, red, blue = np.uint64(group[0]), np.uint64(group[1]), np.uint64(group[2])
        alpha = np.uint64(group[3])
        green_mask, red_mask = np.uint64(group[MASK]), np.uint64(group[MASK + 1])
        blue_mask, alpha_mask = np.uint64(group[MASK + 2]), np.uint64(group[MASK + 3])
        same = _0  # the channels of a single value
        if not blue_mask:
            same = np.uint64(table[blue]) >> _4
        if not alpha_mask:
            same |= np.uint64(table[alpha]) >> _4 << _24
        while pixel < run_end and bit <= end:
            v = bits_at(words, bit)
            entry = np.uint64(table[green + (v & green_mask)])
            if entry == _LONG:
                entry = _long_symbol(longs, group[FAR], v)
            size = entry & _15
            v >>= size
            symbol = entry >> _4
            if symbol < _VALUES:
                color = symbol << _8 | same
                entry = np.uint64(table[red + (v & red_mask)])
                if entry == _LONG:
                    entry = _long_symbol(longs, group[FAR + 1], v)
                v >>= entry & _15
                size += entry & _15
                color |= (entry >> _4) << _16
                if blue_mask:
                    entry = np.uint64(table[blue + (v & blue_mask)])
                    if entry == _LONG:
                        entry = _long_symbol(longs, group[FAR + 2], v)
                    v >>= entry & _15
                    size += entry & _15
                    color |= entry >> _4
                if alpha_mask:
                    entry = np.uint64(table[alpha + (v & alpha_mask)])
                    if entry == _LONG:
                        entry = _long_symbol(longs, group[FAR + 3], v)
                    size += entry & _15
                    color |= (entry >> _4) << _24
                bit += size
                pixels[pixel] = color
                pixel += _1
            elif symbol < _CACHED:
                length, extra = _extended(symbol - _VALUES, v)
                v >>= extra
                bit += size + extra
                entry = np.uint64(table[np.uint64(group[4]) + (v & np.uint64(group[MASK + 4]))])
                if entry == _LONG:
                    entry = _long_symbol(longs, group[FAR + 4], v)
                v >>= entry & _15
                code, extra = _extended(entry >> _4, v)
                bit += (entry & _15) + extra
                if code > np.uint64(len(NEAR)):
                    distance = code - np.uint64(len(NEAR))
                else:
                    near = np.int64(code) - 1
                    distance = np.uint64(max(1, NEAR[near, 0] + NEAR[near, 1] * width))
                if distance > pixel + first or length > full - pixel:
                    return CORRUPT
                for k in range(pixel, pixel + length):
                    pixels[k] = pixels[k - distance]
                pixel += length
            else:
                while cached < pixel:
                    color = np.uint64(pixels[cached])
                    cache[(HASH * color & _ALL) >> hashed] = color
                    cached += _1
                bit += size
                pixels[pixel] = cache[symbol - _CACHED]
                pixel += _1
    if cache_shift < 32:
        while cached < pixel:
            color = np.uint64(pixels[cached])
            cache[(HASH * color & _ALL) >> hashed] = color
            cached += _1
    at[0], at[1], at[2] = bit, pixel + first, pixel + first
    return answer
