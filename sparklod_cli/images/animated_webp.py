"""Animated WebPs, written some frames at a time. Pillow alone holds all frames before it writes the first.

Container: https://developers.google.com/speed/webp/docs/riff_container.
"""

from __future__ import annotations

import io
import itertools
import struct
import tempfile
from collections.abc import Iterable, Iterator
from typing import IO, Any

from PIL import Image

from ..support.errors import SparklodError

#: Frames that Pillow encodes together, each as what has changed since the one before. libwebp writes every third to
#: fifth frame whole, so that a beginning after this many costs little (docs/decisions/2026-11-22-render-speed.md).
RUN = 10

#: Longest duration of a frame, ms, and most bytes of a file after its first 8.
LONGEST, MOST_BYTES = 0xFFFFFF, 0xFFFFFFFE

#: Bytes of encoded frames that are held in memory; more are kept in a temporary file until the file's size is known.
IN_MEMORY = 1 << 25

#: Bytes that are read of it at once.
PIECE = 1 << 20

#: Flags of the file: it is animated, it has alpha. Flags of a frame: it replaces what is there, it is cleared after it.
ANIMATED, ALPHA = 0x02, 0x10
REPLACES, CLEARED = 0x02, 0x01


def written(pictures: Iterable[Image.Image], times: Iterable[int], **options: Any) -> Iterator[bytes]:
    """The bytes of an animation in an endless loop.

    Args:
        pictures: at least one, all of one size.
        times: duration of each, ms.
        options: of Pillow's encoder.

    Raises:
        SparklodError: it has more bytes than a WebP can have.
    """
    every = zip(pictures, times, strict=False)
    run = list(itertools.islice(every, RUN))
    following = list(itertools.islice(every, RUN))
    first = run[0][0]
    flags = ANIMATED | (ALPHA if first.mode == "RGBA" else 0)
    if not following:
        whole = bytearray(_saved(run, options))
        if whole[12:16] == b"VP8X":
            # libwebp leaves ALPHA out where only what is cut off at the edges of frames is transparent.
            whole[20] |= flags & ALPHA
        yield bytes(whole)
        return
    with tempfile.SpooledTemporaryFile(IN_MEMORY) as spool:
        while run:
            for frame in _frames(run, options):
                spool.write(frame)
            run, following = following, list(itertools.islice(every, RUN))
        yield from _file(first.size, flags, spool)


def _file(size: tuple[int, int], flags: int, frames: IO[bytes]) -> Iterator[bytes]:
    whole = struct.pack("<I", flags) + _u24(size[0] - 1) + _u24(size[1] - 1)
    head = b"WEBP" + _chunk(b"VP8X", whole) + _chunk(b"ANIM", bytes(6))  # transparent behind it, without an end
    count = len(head) + frames.tell()
    if count > MOST_BYTES:
        raise SparklodError(f"a .webp has at most {MOST_BYTES:,} bytes, not {count:,}; write .mp4, or fewer frames")
    yield b"RIFF" + struct.pack("<I", count) + head
    frames.seek(0)
    yield from iter(lambda: frames.read(PIECE), b"")


def _frames(run: list[tuple[Image.Image, int]], options: dict[str, Any]) -> Iterator[bytes]:
    """Frames of some pictures, of which the first replaces all that was there before."""
    picture, size = run[0][0], run[0][0].size
    chunks = list(_chunks(_saved(run, options)))
    frames = [bytearray(data) for name, data in chunks if name == b"ANMF"]
    if not frames:  # they are all the same, and this is a still picture
        total = sum(time for _, time in run)
        for time in [total] if total <= LONGEST else [time for _, time in run]:
            yield _chunk(b"ANMF", _whole(size, time, 0, chunks))
        return
    left_top, sides = bytes(frames[0][:6]), bytes(frames[0][6:12])
    if left_top == bytes(6) and sides == _u24(size[0] - 1) + _u24(size[1] - 1):
        frames[0][15] |= REPLACES
    else:  # what is transparent at its edges was left out
        still = list(_chunks(_saved(run[:1], options)))
        time = int.from_bytes(frames[0][12:15], "little")
        frames[0] = bytearray(_whole(picture.size, time, frames[0][15] & CLEARED, still))
    for frame in frames:
        yield _chunk(b"ANMF", bytes(frame))


def _whole(size: tuple[int, int], time: int, flags: int, still: list[tuple[bytes, bytes]]) -> bytes:
    """A frame that replaces everything, of the chunks of a still picture."""
    place = bytes(6) + _u24(size[0] - 1) + _u24(size[1] - 1) + _u24(time) + bytes([REPLACES | flags])
    return place + b"".join(_chunk(name, data) for name, data in still if name in (b"ALPH", b"VP8 ", b"VP8L"))


def _saved(run: list[tuple[Image.Image, int]], options: dict[str, Any]) -> bytes:
    (first, *others), times = zip(*run, strict=True)
    out = io.BytesIO()
    first.save(out, "WEBP", save_all=True, append_images=others, duration=list(times), loop=0, **options)
    return out.getvalue()


def _chunks(webp: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 12
    while at < len(webp):
        (size,) = struct.unpack_from("<I", webp, at + 4)
        yield webp[at : at + 4], webp[at + 8 : at + 8 + size]
        at += 8 + size + size % 2


def _chunk(name: bytes, data: bytes) -> bytes:
    return name + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)


def _u24(value: int) -> bytes:
    return value.to_bytes(3, "little")
