"""Text on pictures: a title with lines below it, and a colour scale that says what the colours mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..render.color_scales import Coloring
from ..support.printable import printable

#: Colours of all pictures with text: the ground, titles, other text, and thin lines.
BACKGROUND, INK, FAINT, LINE = "#0f141b", "#e6edf3", "#9aa7b4", "#7d8996"

#: Characters of a title: more do not fit into the width of a picture.
MAX_TITLE = 120

#: Least size of letters, pixels: below it Pillow's font cannot be read.
MIN_LETTERS = 7

Font = Any


def font(unit: float, size: float) -> Font:
    """Pillow's font, in a size given in thousandths of the picture's height."""
    return ImageFont.load_default(size=max(MIN_LETTERS, size * unit))


def write_title(draw: ImageDraw.ImageDraw, unit: float, title: str, lines: Sequence[tuple[str, str]]) -> None:
    """Writes a title, and lines below it, at the upper left of a picture.

    Args:
        draw: draws on the picture.
        unit: pixels in a thousandth of the picture's height; 1 for a picture of 1600 x 1000.
        title: cut to `MAX_TITLE` characters.
        lines: text and colour of each; not cut.
    """
    left, top = 40 * unit, 30 * unit
    draw.text((left, top), printable(title, MAX_TITLE), INK, font(unit, 32))
    for number, (line, color) in enumerate(lines):
        draw.text((left, top + (46 + 26 * number) * unit), line, color, font(unit, 19))


def write_scale(image: Image.Image, draw: ImageDraw.ImageDraw, unit: float, coloring: Coloring) -> None:
    """Draws a colour scale at the right of a picture: what the colours mean.

    Args:
        image, draw: the picture, and what draws on it.
        unit: pixels in a thousandth of the picture's height; 1 for a picture of 1600 x 1000.
        coloring: the scale's title, ramp and marks.
    """
    left, right = image.width - 170 * unit, image.width - 146 * unit
    top, bottom = 0.26 * image.height, 0.84 * image.height
    draw.text((left, top - 18 * unit), coloring.title, INK, font(unit, 21), anchor="ls")
    height = max(1, round(bottom - top))
    rows = np.arange(height)[::-1] * len(coloring.ramp) // height
    bar = np.broadcast_to(coloring.ramp[rows][:, None], (height, max(1, round(right - left)), 3))
    image.paste(Image.fromarray(np.ascontiguousarray(bar)), (round(left), round(top)))
    for place, text in coloring.marks:
        y = bottom - place * (bottom - top)
        draw.line([(right, y), (right + 6 * unit, y)], LINE, max(1, round(unit)))
        draw.text((right + 12 * unit, y), text, FAINT, font(unit, 17), anchor="lm")
