"""Contact sheets: several pictures in one, each with a caption below it."""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from .pixels import BACKGROUND, FAINT, Font, Pixels

#: Pixels between and around the pictures; height of a caption and of its letters below a picture 720 pixels high.
GAP, CAPTION, LETTERS = 8, 34, 20

#: Width over height that a sheet comes close to: that of most screens.
ASPECT = 1.6


def grid(count: int, size: tuple[int, int]) -> tuple[int, int]:
    """Columns and rows for `count` pictures of a size: the grid without an empty row that is closest to `ASPECT`."""
    shapes = [(columns, math.ceil(count / columns)) for columns in range(1, count + 1)]
    return min(shapes, key=lambda shape: abs(math.log(shape[0] * size[0] / (shape[1] * size[1]) / ASPECT)))


def cells(count: int, size: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the upper left pixel of each picture of a sheet."""
    columns, _ = grid(count, size)
    width, height = size[0] + GAP, size[1] + GAP + _caption_height(size)
    return [(GAP + number % columns * width, GAP + number // columns * height) for number in range(count)]


def sheet(pictures: Sequence[Pixels], captions: Sequence[str]) -> Pixels:
    """One picture of several of the same size, which are not scaled.

    Args:
        pictures: at least one; the sheet has alpha if any of them has.
        captions: one for each picture; cut to its width.
    """
    height, width = pictures[0].shape[:2]
    size = (width, height)
    columns, rows = grid(len(pictures), size)
    below = _caption_height(size)
    whole = (columns * (width + GAP) + GAP, rows * (height + GAP + below) + GAP)
    channels = max(picture.shape[2] for picture in pictures)
    image = Image.new("RGB" if channels == 3 else "RGBA", whole, BACKGROUND)
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=max(12, LETTERS * below / CAPTION))
    places = cells(len(pictures), size)
    for (x, y), caption in zip(places, captions, strict=True):
        draw.text((x, y + height + below / 2), _fitting(caption, width, draw, font), FAINT, font, anchor="lm")
    pixels = np.array(image)
    for (x, y), picture in zip(places, pictures, strict=True):
        pixels[y : y + height, x : x + width, : picture.shape[2]] = picture
    return pixels


def _caption_height(size: tuple[int, int]) -> int:
    return max(18, round(CAPTION * min(1.5, size[1] / 720)))


def _fitting(text: str, width: int, draw: ImageDraw.ImageDraw, font: Font) -> str:
    # No letter is narrower than a pixel, so no more can fit; measuring longer texts would take long.
    marks = text[: width + 1]
    text = "".join(mark if mark.isprintable() else "\N{REPLACEMENT CHARACTER}" for mark in marks)

    def cut(length: int) -> str:
        return text if length == len(text) else text[:length].rstrip() + "…"

    def fits(length: int) -> bool:
        return bool(draw.textlength(cut(length), font=font) <= width)

    if fits(len(text)):
        return text
    longest = bisect.bisect_left(range(1, len(text)), True, key=lambda length: not fits(length))
    return cut(longest) if longest else ""
