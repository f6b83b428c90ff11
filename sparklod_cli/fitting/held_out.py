"""Held-out cameras: how far cuts of a tree are from full detail in pictures that it was not fitted to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..images.metrics import psnr_of
from ..render.rasterizer import draw
from .nodes import FittedNodes
from .pictures import Picture
from .settings import SHARES

#: Share of the leaves -> mean PSNR, dB.
Scores = dict[float, float]


def scores_of(nodes: FittedNodes, held_out: Sequence[Picture]) -> Scores:
    """Means of pictures and of a black and a white background; of no pictures there are none."""
    return {share: _mean(nodes, held_out, share) for share in SHARES if held_out}


def _mean(nodes: FittedNodes, held_out: Sequence[Picture], share: float) -> float:
    found: list[float] = []
    for picture in held_out:
        _, shaded = nodes.seen(nodes.cut(picture.camera, share), picture.camera)
        found += map(psnr_of, picture.errors(draw(shaded, picture.camera, nodes.raster)))
    return float(np.mean(found))


def gain(before: Scores, after: Scores) -> float:
    """Mean gain in dB."""
    return float(np.mean([after[share] - before[share] for share in before]))
