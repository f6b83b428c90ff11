"""Held-out cameras: how far cuts of a tree are from full detail in pictures that it was not fitted to."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ..cameras.camera import Camera
from ..images.metrics import on_background, psnr
from ..render.rasterizer import Image, draw
from ..render.settings import RasterSettings
from .nodes import FittedNodes
from .settings import SHARES

#: Least mean alpha of a picture, and least standard deviation of its colours over grey: else there is nothing to see.
COVERED, VARIED = 0.02, 0.01


def worth_seeing(full: Image) -> bool:
    """Whether a picture of full detail shows enough to compare cuts by."""
    return bool(full[..., 3].mean() >= COVERED and on_background(full, 0.5).std(axis=(0, 1)).max() >= VARIED)


class HeldOut:
    """Pictures of full detail, and how far cuts are from them.

    Args:
        cameras: candidates, as many as are needed to find some that show enough.
        count: of cameras to take.
        nodes: whose leaves are full detail.
        settings: how they are drawn.

    Attributes:
        cameras: those that show something; may be none.
    """

    def __init__(self, cameras: Iterator[Camera], count: int, nodes: FittedNodes, settings: RasterSettings) -> None:
        self._settings = settings
        self.cameras: list[Camera] = []
        self._full: list[Image] = []
        for _, camera in zip(range(8 * count), cameras, strict=False):
            if len(self.cameras) == count:
                break
            full = draw(nodes.shaded(nodes.leaves, camera), camera, settings)
            if worth_seeing(full):
                self.cameras.append(camera)
                self._full.append(full)

    def psnr(self, nodes: FittedNodes, shares: Sequence[float] = SHARES) -> dict[float, float]:
        """Share of the leaves -> mean PSNR in dB of the cameras and of a black and a white background."""
        found: dict[float, list[float]] = {share: [] for share in shares}
        for camera, full in zip(self.cameras, self._full, strict=True):
            for share in shares:
                image = draw(nodes.shaded(nodes.cut(camera, share), camera), camera, self._settings)
                found[share] += [psnr(on_background(image, gray), on_background(full, gray)) for gray in (0.0, 1.0)]
        return {share: float(np.mean(values)) if values else math.nan for share, values in found.items()}
