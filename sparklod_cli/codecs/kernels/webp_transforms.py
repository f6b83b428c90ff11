"""Undoes the transforms of lossless WebP (RFC 9649, section 4). Pixels are uint32: A R G B from the top."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...support.jit import kernel

#: The transforms as they are numbered in files.
PREDICTOR, COLOR, GREEN, INDEXING = 0, 1, 2, 3

#: No transform of a file: an image without alpha has all of it.
OPAQUE = 4


class Transform(NamedTuple):
    """A transform that is undone.

    Attributes:
        kind: PREDICTOR, COLOR, GREEN, INDEXING or OPAQUE.
        width: of a row of the result.
        tiles, across, shift: the image of what it needs, (T,) uint32, its width, and the binary logarithm of the side
            of a tile; of indexing, (256,) colours, 0 behind the last, and the logarithm of the indices in a pixel.
        above: (width,) uint32, the finished row above, of the predictor.
    """

    kind: int
    width: int
    tiles: Any
    across: int
    shift: int
    above: Any


_ODD, _EVEN = np.uint64(0xFF00FF00), np.uint64(0x00FF00FF)
_HALVES = np.uint64(0xFEFEFEFE)
_BLACK = np.uint64(0xFF000000)
_1, _8, _9, _16, _24 = np.uint64(1), np.uint64(8), np.uint64(9), np.uint64(16), np.uint64(24)
_BYTE = np.uint64(255)

#: Four channels in 16 bits each: the low byte of each, two channels together, and some numbers for each.
_LANES, _PAIRS = np.uint64(0x00FF00FF00FF00FF), np.uint64(0x0000FFFF0000FFFF)
_ONES, _NINE_BITS = np.uint64(0x0001000100010001), np.uint64(0x01FF01FF01FF01FF)
_256, _128 = np.uint64(0x0100010001000100), np.uint64(0x0080008000800080)


@kernel(nogil=True, inline=True)
def _sum(a, b):
    """The sum of each channel, modulo 256."""
    return (((a & _ODD) + (b & _ODD)) & _ODD) | (((a & _EVEN) + (b & _EVEN)) & _EVEN)


@kernel(nogil=True, inline=True)
def _mean(a, b):
    """The mean of each channel, rounded down."""
    return (((a ^ b) & _HALVES) >> _1) + (a & b)


@kernel(nogil=True, inline=True)
def _spread(a):
    """The four channels in 16 bits each."""
    a = (a | a << _16) & _PAIRS
    return (a | a << _8) & _LANES


@kernel(nogil=True, inline=True)
def _clamped(lanes):
    """Packs lanes of a number + 256, each clamped to 0..255."""
    over = (lanes >> _9) & _ONES
    within = (lanes >> _8) & _ONES & ~over
    lanes = (lanes & ((within << _8) - within)) | ((over << _8) - over)
    lanes = (lanes | lanes >> _8) & _PAIRS
    return (lanes | lanes >> _16) & np.uint64(0xFFFFFFFF)


@kernel(nogil=True, inline=True)
def _away(a, b):
    """The sum of the distances of all channels."""
    out = np.int64(0)
    for k in range(4):
        shift = np.uint64(8 * k)
        out += abs(np.int64(a >> shift & _BYTE) - np.int64(b >> shift & _BYTE))
    return out


@kernel(nogil=True)
def _predict_run(mode, pixels, begin, stop, width):
    """Adds to some pixels of a row what is predicted of them by their neighbours."""
    left = np.uint64(pixels[begin - 1])
    if mode == 1:
        for i in range(begin, stop):
            left = _sum(np.uint64(pixels[i]), left)
            pixels[i] = left
    elif mode == 5:
        for i in range(begin, stop):
            up, right = np.uint64(pixels[i - width]), np.uint64(pixels[i - width + 1])
            left = _sum(np.uint64(pixels[i]), _mean(_mean(left, right), up))
            pixels[i] = left
    elif mode == 6:
        for i in range(begin, stop):
            left = _sum(np.uint64(pixels[i]), _mean(left, np.uint64(pixels[i - width - 1])))
            pixels[i] = left
    elif mode == 7:
        for i in range(begin, stop):
            left = _sum(np.uint64(pixels[i]), _mean(left, np.uint64(pixels[i - width])))
            pixels[i] = left
    elif mode == 10:
        for i in range(begin, stop):
            corner, up = np.uint64(pixels[i - width - 1]), np.uint64(pixels[i - width])
            mean = _mean(up, np.uint64(pixels[i - width + 1]))
            left = _sum(np.uint64(pixels[i]), _mean(_mean(left, corner), mean))
            pixels[i] = left
    elif mode == 11:
        for i in range(begin, stop):
            corner, up = np.uint64(pixels[i - width - 1]), np.uint64(pixels[i - width])
            guess = up if _away(left, corner) <= _away(up, corner) else left
            left = _sum(np.uint64(pixels[i]), guess)
            pixels[i] = left
    elif mode == 12:
        for i in range(begin, stop):
            corner, up = np.uint64(pixels[i - width - 1]), np.uint64(pixels[i - width])
            guess = _clamped(_spread(left) + _spread(up) + _256 - _spread(corner))
            left = _sum(np.uint64(pixels[i]), guess)
            pixels[i] = left
    elif mode == 13:
        for i in range(begin, stop):
            corner, up = np.uint64(pixels[i - width - 1]), np.uint64(pixels[i - width])
            mean = _spread(_mean(left, up))
            over = mean + _256 - _spread(corner)  # of the mean over the corner, + 256
            over += _ONES & ~(over >> _8)  # halves are rounded towards 0
            left = _sum(np.uint64(pixels[i]), _clamped(mean + ((over >> _1) & _NINE_BITS) + _128))
            pixels[i] = left
    else:  # without the left pixel
        for i in range(begin, stop):
            guess = _BLACK
            up = np.uint64(pixels[i - width])
            if mode == 2:
                guess = up
            elif mode == 3:
                guess = np.uint64(pixels[i - width + 1])
            elif mode == 4:
                guess = np.uint64(pixels[i - width - 1])
            elif mode == 8:
                guess = _mean(np.uint64(pixels[i - width - 1]), up)
            elif mode == 9:
                guess = _mean(up, np.uint64(pixels[i - width + 1]))
            pixels[i] = _sum(np.uint64(pixels[i]), guess)


@kernel(nogil=True)
def _predict(pixels, width, row, tiles, across, shift):
    """Undoes the prediction of rows, the first of `pixels` is the one above them."""
    for begin in range(width, len(pixels), width):
        y = row + begin // width - 1
        if y == 0:
            pixels[begin] = _sum(np.uint64(pixels[begin]), _BLACK)
            _predict_run(1, pixels, begin + 1, begin + width, width)
            continue
        pixels[begin] = _sum(np.uint64(pixels[begin]), np.uint64(pixels[begin - width]))
        x = 1
        while x < width:
            stop = min(width, (x >> shift) + 1 << shift)
            mode = np.int64(tiles[(y >> shift) * across + (x >> shift)]) >> 8 & 15
            _predict_run(mode, pixels, begin + x, begin + stop, width)
            x = stop


@kernel(nogil=True, inline=True)
def _share(factor, color):
    """What a channel adds to another: two signed bytes, multiplied, in units of 1 / 32."""
    return np.int64(np.int8(factor)) * np.int64(np.int8(color)) >> 5


@kernel(nogil=True)
def _add_shares(pixels, width, row, tiles, across, shift):
    """Adds what red and blue have of green, and blue of red."""
    for begin in range(0, len(pixels), width):
        y = row + begin // width
        x = 0
        while x < width:
            stop = min(width, (x >> shift) + 1 << shift)
            factors = np.int64(tiles[(y >> shift) * across + (x >> shift)])
            for i in range(begin + x, begin + stop):
                p = np.int64(pixels[i])
                green = p >> 8
                red = (p >> 16) + _share(factors, green)
                blue = p + _share(factors >> 8, green) + _share(factors >> 16, red)
                pixels[i] = (p & 0xFF00FF00) | (red & 255) << 16 | blue & 255
            x = stop


@kernel(nogil=True)
def _add_green(pixels):
    """Adds green to red and blue."""
    others = np.uint32(0x00FF00FF)
    for i in range(len(pixels)):
        p = pixels[i]
        green = p >> np.uint32(8) & np.uint32(255)
        pixels[i] = (p & np.uint32(0xFF00FF00)) | ((p & others) + (green << np.uint32(16) | green)) & others


@kernel(nogil=True)
def _look_up(pixels, out, width, colors, shift):
    """Fills rows of colours by the indices that stand in the green of pixels, 2 ** shift in each."""
    bits, last = 8 >> shift, (1 << (8 >> shift)) - 1
    across = (width + (1 << shift) - 1) >> shift
    for row in range(len(out) // width):
        for x in range(width):
            packed = np.int64(pixels[row * across + (x >> shift)]) >> 8 & 255
            place = bits * (x & (1 << shift) - 1)
            out[row * width + x] = colors[packed >> place & last]


@kernel(nogil=True)
def undo(transform, pixels, row, out):
    """Undoes a transform of some rows.

    Args:
        transform: which.
        pixels: (P,) uint32 of whole rows, changed in place; for the predictor, with room for the row above before them.
        row: number of the first row.
        out: (Q,) uint32 of whole rows, filled by INDEXING.
    """
    kind, width, tiles, across, shift, above = transform
    if kind == PREDICTOR:
        pixels[:width] = above
        _predict(pixels, width, row, tiles, across, shift)
        above[:] = pixels[len(pixels) - width :]
    elif kind == COLOR:
        _add_shares(pixels, width, row, tiles, across, shift)
    elif kind == INDEXING:
        _look_up(pixels, out, width, tiles, shift)
    elif kind == GREEN:
        _add_green(pixels)
    else:
        for i in range(len(pixels)):
            pixels[i] |= np.uint32(0xFF000000)
