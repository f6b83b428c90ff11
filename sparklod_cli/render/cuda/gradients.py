"""Gradients of a picture that a card has drawn."""

from __future__ import annotations

import numpy as np

from ...model.falloff import MIN_ALPHA
from .. import rasterizer
from ..kernels.backward import GRADIENT_COLUMNS, SUMS
from . import backward, forward
from .card import CardArray
from .rasterizer import CardPicture, CardSplats, CardView


def gradients_on_card(splats: CardSplats, picture: CardPicture, view: CardView, by_image: CardArray) -> CardArray:
    """Return (M, GRADIENT_COLUMNS) derivatives of a loss by each of the splats that a picture was drawn of.

    They are the same every time; see `gradients.SplatGradients`. The splats are as they were when the picture was
    drawn, with the profile spark; `by_image` (height, width, 4) are the derivatives of the loss by the picture.
    """
    across, down = rasterizer.tiles_across(view.camera)
    seen, number, new = picture, picture.index.shape[0], splats.memory.array
    sums = new("sums", (seen.pairs.shape[0], SUMS))
    totals = new("totals", (number, SUMS), np.float64)
    gradients = new("gradients", (number, GRADIENT_COLUMNS))
    tiles = seen.boxes, seen.ends, seen.start, seen.pairs, across, np.float32(MIN_ALPHA)
    drawn = seen.screen, seen.keys, *tiles, seen.image, by_image, sums
    backward.weigh_tiles.launch(across * down, forward.PIXELS, *drawn)
    blocks = -(-number * backward.WARP // backward.ADDERS)
    backward.add_rows.launch(blocks, backward.ADDERS, seen.keys, seen.count, seen.ends, sums, totals)
    columns = splats.center, splats.scale, splats.quat_xyzw, splats.lod_opacity, splats.colors, seen.index
    results = view.matrix, view.view, seen.screen, seen.count, totals, gradients
    backward.carry_back.for_each(number, *columns, *results)
    return gradients
