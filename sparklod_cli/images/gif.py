"""Animated GIFs, written frame by frame. Pillow alone holds all frames before it writes the first."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from PIL import Image

#: GIF counts time in steps of 10 ms, up to 16 bits of them; players slow down frames of fewer steps than this.
STEP, LEAST_STEPS, MOST_STEPS = 10, 2, 0xFFFF

#: Bytes of a file's header, with the size of the picture, and of a frame's header, with its place.
HEADER, FRAME_HEADER = 13, 10

#: First bytes of an extension, of the one that has a frame's duration, and of the end of the file.
EXTENSION, GRAPHIC_CONTROL, TRAILER = 0x21, 0xF9, 0x3B


class Frames(NamedTuple):
    """A GIF in parts.

    Attributes:
        header: what stands before the first frame.
        frames: of each the extension that has its duration, and its picture.
    """

    header: bytes
    frames: list[bytes]


def written(pictures: Iterable[Image.Image], times: Iterable[int]) -> Iterator[bytes]:
    """The bytes of an animation in an endless loop, the same that Pillow makes of all frames together.

    No more than two frames are held: Pillow writes each frame as what has changed since the one before.

    Args:
        pictures: at least one, all of one size, with a palette.
        times: duration of each, ms, whole steps.
    """
    every = zip(pictures, times, strict=False)
    before, lasting = next(every)
    waiting = b""  # the last frame, until it is known that the next one differs
    for picture, time in every:
        parts = _parts(_saved([before, picture], [STEP, STEP]))
        if len(parts.frames) == 1:  # nothing has changed
            lasting += time
            continue
        if not waiting:
            waiting = parts.frames[0]
            yield parts.header
        yield from _timed(waiting, lasting)
        before, waiting, lasting = picture, parts.frames[1], time
    if waiting:
        yield from _timed(waiting, lasting)
        yield bytes([TRAILER])
    else:
        yield _saved([before], [min(lasting, STEP * MOST_STEPS)])


def _saved(pictures: list[Image.Image], times: list[int]) -> bytes:
    out = io.BytesIO()
    pictures[0].save(out, "GIF", save_all=True, append_images=pictures[1:], duration=times, loop=0)
    return out.getvalue()


def _timed(frame: bytes, time: int) -> Iterator[bytes]:
    """A frame with its duration, ms; drawn over itself again if that is more than a frame can last."""
    steps = time // STEP
    while steps > 0:
        yield frame[:4] + min(steps, MOST_STEPS).to_bytes(2, "little") + frame[6:]
        steps -= MOST_STEPS


def _parts(gif: bytes) -> Frames:
    frames: list[bytes] = []
    at = HEADER + _table(gif[10])
    header = begin = 0
    while gif[at] != TRAILER:
        if gif[at] == EXTENSION:
            if gif[at + 1] == GRAPHIC_CONTROL:
                begin = at
                header = header or at
            at = _after_blocks(gif, at + 2)
        else:
            at = _after_blocks(gif, at + FRAME_HEADER + _table(gif[at + 9]) + 1)
            frames.append(gif[begin:at])
    return Frames(gif[:header], frames)


def _table(flags: int) -> int:
    """Bytes of a colour table."""
    return 3 << (flags & 7) + 1 if flags & 0x80 else 0


def _after_blocks(gif: bytes, at: int) -> int:
    """Where blocks end, each of which begins with its size; the last is empty."""
    while gif[at]:
        at += gif[at] + 1
    return at + 1
