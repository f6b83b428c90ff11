"""Labels of rendered figures: title, colour scale, and axes with ticks."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from ..images.text import FAINT, INK, LINE, font, write_scale, write_title
from ..render.color_scales import Coloring, ticks
from .ellipsoids import Points
from .viewpoint import Viewpoint

#: Smallest distance between the labels of an axis, in thousandths of the picture's height.
LABEL_DISTANCE = 62


def write_png(
    pixels: NDArray[np.uint8],
    title: str,
    lines: Sequence[str],
    coloring: Coloring,
    eye: Viewpoint,
    low: Points,
    high: Points,
) -> bytes:
    """The PNG of a picture with title, colour scale and axes.

    Args:
        pixels: (H, W, 3) of the scene.
        title, lines: texts for the upper left corner, which must fit into the width.
        coloring: the colour scale.
        eye: viewpoint of the picture.
        low, high: (3,) corners of the box along whose edges the axes run, world units.
    """
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image)
    unit = min(image.height / 1000, image.width / 1600)
    write_title(draw, unit, title, [(line, FAINT) for line in lines])
    write_scale(image, draw, unit, coloring)
    _axes(draw, unit, image.size, eye, low, high)
    out = io.BytesIO()
    image.save(out, "PNG", optimize=True)
    return out.getvalue()


def _axes(
    draw: ImageDraw.ImageDraw, unit: float, size: tuple[int, int], eye: Viewpoint, low: Points, high: Points
) -> None:
    """Draws axes along three edges of a box: the two near ones of its floor, and the upright one on the left."""
    upright = int(np.abs(eye.axes[1]).argmax())
    down = bool(eye.axes[1, upright] < 0)
    ends = np.stack([low, high])
    ground = ends[int(down), upright]
    near = np.where(eye.position > (low + high) / 2, high, low)
    near[upright] = ground
    middle = eye.project(((low + high) / 2)[None])[0] * size
    floor = np.array([[x, y, z] for x in ends[:, 0] for y in ends[:, 1] for z in ends[:, 2]])
    floor = floor[floor[:, upright] == ground]
    left = floor[np.argmin(eye.project(floor)[:, 0])]
    for axis in range(3):
        origin = left if axis == upright else near
        edge = np.stack([origin, origin])
        edge[:, axis] = ends[:, axis]
        first, last = eye.project(edge) * size
        length = float(np.linalg.norm(last - first))
        if length < LABEL_DISTANCE * unit:
            continue
        draw.line([tuple(first), tuple(last)], LINE, max(1, round(unit)))
        # Labels lie outside the box: on the side of the edge that faces away from its middle.
        along = (last - first) / length
        out = np.array([-along[1], along[0]])
        out *= -np.sign(out @ (middle - first)) or 1.0
        extent = float(high[axis] - low[axis])
        for value, text in ticks(float(low[axis]), float(high[axis]), extent * LABEL_DISTANCE * unit / length):
            point = origin.copy()
            point[axis] = value
            at = (eye.project(point[None]) * size)[0]
            draw.line([tuple(at), tuple(at + 7 * unit * out)], LINE, max(1, round(1.5 * unit)))
            draw.text(tuple(at + 24 * unit * out), text, FAINT, font(unit, 17), anchor="mm")
        name = "xyz"[axis]
        place = (first + last) / 2 + 62 * unit * out
        if axis == upright:  # the name lies beyond its upper end
            name += ", down" if down else ""
            place = first - 26 * unit * along if down else last + 26 * unit * along
        draw.text(tuple(place), name, INK, font(unit, 20), anchor="mm")
