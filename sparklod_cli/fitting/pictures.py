"""Pictures of full detail, how far cuts are from them, and what fitted nodes must keep."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..images.metrics import on_background, psnr_of
from ..lod.kernels.tree_links import add_weighted, fill_weights, find_parents
from ..model.gaussian import linear_opacity
from ..model.splats import FloatArray
from ..render.rasterizer import Image, draw
from .kernels.adam import Columns
from .kernels.view import by_image, squared_differences
from .nodes import FittedNodes, Index

#: Least mean alpha of a picture, and least standard deviation of its colours over grey: else there is nothing to see.
COVERED, VARIED = 0.02, 0.01

#: Added to the mean squared error of a picture, that of 50 dB: what is better already hardly counts.
LEAST_ERROR = 1e-5

#: Cameras in a row that see too little, after which no more are tried.
MOST_MISSES = 64

#: Share of the leaves -> mean PSNR, dB.
Scores = dict[float, float]

#: Times that half of what was changed is taken back, before all is.
HALVES = 12


@dataclass(frozen=True)
class FullDetailPicture:
    """Picture of full detail from one camera.

    Attributes:
        camera: that sees it.
        full: (H, W, 4) uint16 of full detail in units of 1 / 65535: colours multiplied by alpha, and alpha.
    """

    camera: Camera
    full: NDArray[np.uint16]

    def errors(self, image: Image) -> tuple[float, float]:
        """Return the mean squared errors of a picture on black and on white."""
        sums = np.empty((len(image), 2))
        squared_differences(len(image), image, self.full, sums)
        black, white = sums.sum(axis=0) / (image.shape[0] * image.shape[1] * 3)
        return float(black), float(white)

    def gradient(self, image: Image) -> Image:
        """Return the derivative of the mean logarithm of `errors`, as in PSNR."""
        result, pixels = np.empty_like(image), image.shape[0] * image.shape[1] * 3
        errors = [error + LEAST_ERROR for error in self.errors(image)]
        by_image(len(image), image, self.full, *(np.float32(1 / (pixels * error)) for error in errors), result)
        return result


def pictures(cameras: Iterator[Camera], nodes: FittedNodes) -> Iterator[FullDetailPicture]:
    """Yield the pictures of full detail of cameras that see enough to compare cuts by; end if hardly any does."""
    misses = 0
    for camera in cameras:
        full = draw(nodes.visible(nodes.leaves, camera)[1], camera, nodes.raster)
        if shows_enough(full):
            misses = 0
            yield FullDetailPicture(camera, np.rint(full.clip(0, 1) * 65535).astype(np.uint16))
        misses += 1
        if misses > MOST_MISSES:
            return


def shows_enough(image: Image) -> bool:
    """Return True if a picture shows enough to compare others with."""
    return bool(image[..., 3].mean() >= COVERED and on_background(image, 0.5).std(axis=(0, 1)).max() >= VARIED)


def scores_of(nodes: FittedNodes, held_out: Sequence[FullDetailPicture]) -> Scores:
    """Return the means over held-out pictures and a black and a white background; empty without pictures."""
    return {
        share: mean_psnr(nodes, functools.partial(nodes.cut, share=share), held_out)
        for share in (nodes.shares if held_out else ())
    }


def mean_psnr(nodes: FittedNodes, cut: Callable[[Camera], Index], compared: Sequence[FullDetailPicture]) -> float:
    """Return the mean PSNR of a camera's cuts over pictures and a black and a white background, dB."""
    psnr: list[float] = []
    for picture in compared:
        _, shaded = nodes.visible(cut(picture.camera), picture.camera)
        psnr += map(psnr_of, picture.errors(draw(shaded, picture.camera, nodes.raster)))
    return float(np.mean(psnr))


def gain(before: Scores, after: Scores) -> float:
    """Return the mean gain in dB."""
    return float(np.mean([after[share] - before[share] for share in before]))


def keep_sizes(nodes: FittedNodes) -> bool:
    """Restore nodes that became too small for their children, unless they were so at first; return True if any were.

    A parent is refined before its children if it is larger; a small one is drawn in their place for too long
    (docs/decisions/11-quality-builder.md).
    """
    parent, _ = find_parents(nodes.tree.child_count, nodes.tree.child_start)
    at_first = _ratios(nodes.old, nodes, parent)
    restored = np.zeros(len(parent), np.bool_)
    while True:
        small = _ratios(nodes.columns, nodes, parent) < np.minimum(nodes.least_ratio, at_first)
        if not small.any():
            break
        # Where the node itself has its first values already, its children have grown.
        grown = np.flatnonzero((parent >= 0) & (small & restored)[parent] & ~nodes.tree.is_leaf)
        back = np.union1d(np.flatnonzero(small & ~restored), grown)
        back = back[~restored[back]]
        if not back.size:
            break
        restored[back] = True
        nodes.restore(back)
    return bool(restored.any())


def _ratios(columns: Columns, nodes: FittedNodes, parent: Index) -> FloatArray:
    """Return the (N,) feature size of each node over the mean of its children's; infinite for leaves."""
    every = np.arange(len(parent))
    size, weight = nodes.sizes(every, columns), np.empty(len(parent))
    fill_weights(parent, size, columns.scale, linear_opacity(columns.lod_opacity), weight)
    sums, weights = np.zeros(len(parent)), np.zeros(len(parent))
    add_weighted(parent, size, weight, sums, weights)
    return np.divide(size * weights, sums, out=np.full(len(parent), np.inf), where=sums > 0)


def keep_gains(nodes: FittedNodes, held_out: Sequence[FullDetailPicture], before: Scores) -> Scores:
    """Halve changes of the nodes that cuts of a share draw, while one scores less than before; return the scores."""
    for _ in range(HALVES):
        now = scores_of(nodes, held_out)
        worst = min(before, key=lambda share: now[share] - before[share])
        if not now[worst] < before[worst]:
            return now
        drawn = [nodes.cut(picture.camera, worst) for picture in held_out]
        nodes.halve(np.intersect1d(np.unique(np.concatenate(drawn)), nodes.fitted))
    nodes.restore(nodes.fitted)
    return before
