"""Images of SOG: codings of numbers in texels, codebooks of 256 values, and WebP files."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.WebPImagePlugin import WebPImageFile

from ..model.splats import FloatArray
from ..system.errors import FormatError
from ..system.untrusted import quoted_value
from . import quantize
from .merging import PIECE

Bytes = NDArray[np.uint8]
Texels = NDArray[np.uint8]
Words = NDArray[np.uint16]
Wide = NDArray[np.float64]

#: Entries in a row of the image of SH centroids.
PALETTE_WIDTH = 64

#: Largest word of a coordinate.
LAST_WORD = 0xFFFF

#: Alpha of a rotation's texel minus the index, in w x y z, of the largest component.
FIRST_TAG = 252

#: Codes of a book: a channel of a texel has 8 bits.
CODES = 256

#: Bins of the histogram that weighs numbers, each with the power CROWDING of its count, so that the few numbers far
#: from all others, such as the scales of a background, get codes, too. Chosen.
BINS, CROWDING = 4096, 0.5

#: Passes of k-means; more change nothing visible. Measured.
PASSES = 20

#: Halvings of the width of the intervals of `even_codebook`, to a millionth of the range. Chosen.
BISECTIONS = 20


def sign_log(values: FloatArray) -> Wide:
    """Return sign(x) * log(1 + abs(x)) of coordinates, in float64."""
    wide = values.astype(np.float64)
    return np.copysign(np.log1p(np.abs(wide)), wide)


def encode_center(center: FloatArray, low: Wide, high: Wide) -> Words:
    """Encode (N, 3) coordinates as words in equal steps of `sign_log` from (3,) `low` to `high`."""
    words = np.empty(center.shape, np.uint16)
    for axis, extent in enumerate(high - low):
        steps = LAST_WORD / extent if extent > 0 else 0.0
        words[:, axis] = np.rint((sign_log(center[:, axis]) - low[axis]) * steps)
    return words


def center_table(low: Wide, high: Wide) -> FloatArray:
    """Return the (3, 65536) coordinates of words between (3,) ends of `sign_log`; error at most half a step of that."""
    logs = quantize.range_table(low, high, LAST_WORD + 1)
    with np.errstate(over="ignore"):
        return np.copysign(np.expm1(np.abs(logs)), logs).astype(np.float32, order="C")


def encode_quat(quat_xyzw: FloatArray) -> Bytes:
    """Encode (N, 4) unit quaternions as (N, 4) bytes: the three smaller components of w x y z, and a tag."""
    wxyz = quat_xyzw[:, [3, 0, 1, 2]]
    largest = np.abs(wxyz).argmax(axis=1)[:, None]
    flip = np.where(np.take_along_axis(wxyz, largest, axis=1) < 0, np.float32(-1), np.float32(1))
    others = np.take_along_axis(wxyz, quantize.OTHERS[largest[:, 0]], axis=1) * flip
    codes = np.empty((len(wxyz), 4), np.uint8)
    codes[:, :3] = np.clip(np.rint(others * np.float32(127.5 * np.sqrt(2)) + np.float32(127.5)), 0, 255)
    codes[:, 3] = largest[:, 0] + FIRST_TAG
    return codes


def quat_components() -> FloatArray:
    """Return the (256,) components of rotations by their bytes. Largest error: 1.1 degrees of rotation."""
    return (np.arange(256, dtype=np.float32) / np.float32(127.5) - 1) * np.float32(np.sqrt(0.5))


def codebook(values: FloatArray, tilt: float = 0) -> FloatArray:
    """Choose a codebook for numbers.

    If at most 256 of them differ, the book has just these. Otherwise it has the least and the largest number, so that
    the range stays, and between them means of k-means in one dimension, which needs only sums up to the boundaries of
    its cells. It starts from a density of codes in proportion to the cube root of that of the weight, which has the
    least squared error for many codes (P. F. Panter and W. Dite, 1951).

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


def even_codebook(values: FloatArray) -> FloatArray:
    """Choose the book with the least maximum error: the middles of equally wide intervals that cover all numbers.

    The first of the (256,) ascending float32 is the least value, such as the logarithm of 0; the last one is repeated
    if fewer suffice. More than 256 of the finite `values` must differ.
    """
    least, *rest = np.unique(values).astype(np.float64)
    ordered = np.array(rest)
    narrow, wide = 0.0, float(np.ptp(ordered))
    for _ in range(BISECTIONS):
        width = (narrow + wide) / 2
        narrow, wide = (narrow, width) if len(_starts(ordered, width)) < CODES else (width, wide)
    first = _starts(ordered, wide)
    last = np.append(first[1:], len(ordered)) - 1
    middles = (ordered[first] + ordered[last]) / 2
    return np.concatenate([[least], middles, np.full(CODES - 1 - len(middles), middles[-1])]).astype(np.float32)


def _starts(ordered: NDArray[np.float64], width: float) -> list[int]:
    """Return the starts of intervals that cover ascending numbers, at most `CODES` of them."""
    starts = [0]
    while len(starts) < CODES:
        end = int(np.searchsorted(ordered, ordered[starts[-1]] + width, "right"))
        if end == len(ordered):
            break
        starts.append(end)
    return starts


def nearest(values: FloatArray, book: FloatArray) -> NDArray[np.uint8]:
    """Return the nearest code of a book for each number, the first of equally near ones; any shape."""
    wide = book.astype(np.float64)
    return np.searchsorted((wide[1:] + wide[:-1]) / 2, values.ravel()).astype(np.uint8).reshape(values.shape)


def _means(ordered: NDArray[np.float64], codes: int, tilt: float) -> NDArray[np.float64]:
    """Return (codes,) ascending means of cells of ascending numbers; more than `codes` numbers must differ."""
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


#: Effort of the WebP encoder: quality sets how long it searches for repetitions, the method how many ways of coding it
#: tries. Measured: with more, files get smaller by less than 0.3 % and take up to ten times as long.
QUALITY, METHOD = 50, 1

#: Longest side of a WebP image, in texels.
MAX_SIDE = 16_383

#: (N,) A R G B from the most significant byte.
Pixels = NDArray[np.uint32]

#: Reads the next `size` bytes, or fewer; none at the end.
Read = Callable[[int], bytes]

#: Bytes that are read first: the headers of the file and of its first chunk, and the sides.
START = 30

#: Most chunks that are read before the pixels: a colour profile, alpha, and some unknown ones.
MOST_BEFORE = 16


class WebPHeader(NamedTuple):
    """First bytes of a WebP file, `start`, and their facts on its pixels."""

    start: bytes
    width: int
    height: int
    lossy: bool


def read_header(read: Read, name: str) -> WebPHeader:
    """Read the header of a still WebP image; in an extended file, all chunks up to the pixels."""
    data = read(START)
    kind = data[12:16] if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) == START else b""
    if kind == b"VP8X":  # 24 bits each, minus one
        if data[20] & 2:
            raise FormatError(f"{quoted_value(name)} is an animation, but SOG needs a still image")
        sides = int.from_bytes(data[24:27], "little"), int.from_bytes(data[27:30], "little")
        data, lossy = _up_to_pixels(data, read)
        return WebPHeader(data, 1 + sides[0], 1 + sides[1], lossy)
    if kind == b"VP8L":  # 14 bits each, minus one, after a byte of signature
        bits = int.from_bytes(data[21:25], "little")
        return WebPHeader(data, 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF), False)
    if kind == b"VP8 ":  # 14 bits each, after a frame tag and a start code
        width, height = struct.unpack_from("<HH", data, 26)
        return WebPHeader(data, width & 0x3FFF, height & 0x3FFF, True)
    raise FormatError(f"{quoted_value(name)} is not a WebP image")


def _up_to_pixels(data: bytes, read: Read) -> tuple[bytes, bool]:
    """Read the chunks up to the pixels; return all bytes read, and whether the pixels are lossy."""
    for _ in range(MOST_BEFORE):
        head = read(8)
        data += head
        if len(head) < 8 or head[:4] in (b"VP8L", b"VP8 "):
            return data, head[:4] == b"VP8 "
        size = int.from_bytes(head[4:], "little")
        data += read(size + size % 2)
    return data, False


def pixels_of(header: WebPHeader, read: Read, name: str) -> Pixels:
    """Decode (width * height,) pixels from the bytes after the header; libwebp allocates them: check sides before."""
    data = header.start + b"".join(iter(lambda: read(PIECE), b""))
    try:
        # Not by Image.open, which warns of large images and refuses larger ones.
        with WebPImageFile(io.BytesIO(data)) as image:
            texels = image if image.mode == "RGBA" else image.convert("RGBA")
            return np.frombuffer(texels.tobytes("raw", "BGRA"), "<u4")
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        raise FormatError(f"{quoted_value(name)} is a corrupt WebP image: {error}") from None


def encode_webp(image: Texels) -> bytes:
    """Encode (height, width, 3 or 4) texels without losses, even of colours with alpha 0."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "WEBP", lossless=True, exact=True, quality=QUALITY, method=METHOD)
    return file.getvalue()
