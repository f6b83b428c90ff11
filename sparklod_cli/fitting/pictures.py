"""Pictures of full detail, and how far those of cuts are from them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..cameras.camera import Camera
from ..images.metrics import on_background
from ..render.rasterizer import Image, draw
from .kernels.difference import by_image, squared_differences
from .nodes import FittedNodes

#: Least mean alpha of a picture, and least standard deviation of its colours over grey: else there is nothing to see.
COVERED, VARIED = 0.02, 0.01

#: Added to the mean squared error of a picture, that of 50 dB: what is better already hardly counts.
LEAST_ERROR = 1e-5

#: Cameras in a row that see too little, after which no more are tried.
MOST_MISSES = 64


@dataclass(frozen=True)
class Picture:
    """What a camera sees of full detail.

    Attributes:
        camera: that sees it.
        full: (H, W, 4) float32, of full detail.
    """

    camera: Camera
    full: Image

    def errors(self, image: Image) -> tuple[float, float]:
        """Mean squared errors of a picture on black and on white."""
        sums = np.empty((len(image), 2))
        squared_differences(image, self.full, sums)
        black, white = sums.sum(axis=0) / (image.shape[0] * image.shape[1] * 3)
        return float(black), float(white)

    def gradient(self, image: Image) -> tuple[Image, float]:
        """How to change a picture of a cut.

        Returns:
            the derivative of the mean of the logarithms of `errors`, which is what PSNR is a mean of; and the root of
            the mean squared error.
        """
        result = np.empty_like(image)
        pixels = image.shape[0] * image.shape[1] * 3
        errors = [error + LEAST_ERROR for error in self.errors(image)]
        by_image(image, self.full, *(np.float32(1 / (pixels * error)) for error in errors), result)
        return result, math.sqrt(sum(errors) / 2)


def pictures(cameras: Iterator[Camera], nodes: FittedNodes) -> Iterator[Picture]:
    """Pictures of full detail of those cameras that see enough to compare cuts by; ends if hardly any does."""
    misses = 0
    for camera in cameras:
        full = draw(nodes.seen(nodes.leaves, camera)[1], camera, nodes.raster)
        if full[..., 3].mean() >= COVERED and on_background(full, 0.5).std(axis=(0, 1)).max() >= VARIED:
            misses = 0
            yield Picture(camera, full)
        misses += 1
        if misses > MOST_MISSES:
            return
