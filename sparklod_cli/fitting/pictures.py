"""Training and held-out cameras, their pictures of full detail, the errors of cuts, and what nodes must keep."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.framing import framing
from ..cameras.sources import CameraPath
from ..images.metrics import on_background, psnr_of
from ..lod.kernels.tree_links import add_weighted, fill_weights, find_parents
from ..model.gaussian import linear_opacity
from ..model.splats import FloatArray
from ..render.rasterizer import Image, draw
from .kernels.adam import Columns
from .kernels.view import by_image, squared_differences
from .nodes import FittedNodes, Index

Vector = NDArray[np.float64]

#: Pixels of a picture. Larger ones gain less in the same time. Measured (benchmarks/notes/refining.md).
SIZE = (480, 270)

#: Cameras around the scene: their distances in radii, and the share of them that stand near the horizon.
DISTANCES, NEAR_HORIZON = (0.5, 5.0), 0.5

#: Largest sine of the elevation of those near the horizon.
HORIZON = 0.5

#: Share of the cameras that stand among the splats.
INSIDE = 0.25

#: Vertical fields of view, degrees.
FOVS = (35.0, 75.0)

#: Cameras look at a point this far from the middle at most, in radii, and in distances.
ASIDE_RADII, ASIDE_DISTANCES = 0.4, 0.25

#: Training cameras at most. Their pictures, 1 MB each, are drawn once. Measured (benchmarks/notes/refining.md).
TRAINING = 300

#: Held-out cameras; of a path, one in so many, and at most so many.
HELD_OUT, OF_PATH = 16, 8

#: Longest side of a picture of a path's camera, pixels.
LONGEST = 640

#: Which way is up, in the axes of scenes as training leaves them.
UP = np.array([0.0, -1.0, 0.0])

#: Steps of the R2 sequence (Roberts 2018): the generalized golden ratio in three dimensions.
_PLASTIC = 1.22074408460575947536
R3 = np.array([1 / _PLASTIC, 1 / _PLASTIC**2, 1 / _PLASTIC**3])


@dataclass(frozen=True)
class Place:
    """Extent of a scene: (N, 3) centres of splats, world units, and the middle and radius of a ball around most."""

    center: NDArray[np.floating]
    middle: Vector
    radius: float

    @classmethod
    def of(cls, center: NDArray[np.floating]) -> Place:
        return cls(center, *framing(center))


def placed(place: Place, seed: np.random.SeedSequence) -> Iterator[Camera]:
    """Yield cameras around a scene and inside it, without end; directions of those around it spread evenly."""
    random = np.random.Generator(np.random.PCG64(seed))
    start = random.random(3)
    number = 0
    while True:
        if random.random() < INSIDE:
            yield _inside(place, random)
        else:
            number += 1
            yield _around(place, (start + number * R3) % 1, random)


def _around(place: Place, spread: Vector, random: np.random.Generator) -> Camera:
    """Return a camera outside, by three numbers 0..1 for its direction and distance."""
    near, far = np.log(DISTANCES)
    distance = float(np.exp(near + (far - near) * spread[2])) * place.radius
    sine = 2 * spread[1] - 1
    if random.random() < NEAR_HORIZON:
        sine *= HORIZON
    turn, cosine = 2 * np.pi * spread[0], np.sqrt(1 - sine * sine)
    direction = np.array([cosine * np.cos(turn), sine, cosine * np.sin(turn)])
    aside = min(ASIDE_RADII * place.radius, ASIDE_DISTANCES * distance) * random.uniform(-1, 1, 3)
    return _looking(place.middle + distance * direction, place.middle + aside, random)


def _inside(place: Place, random: np.random.Generator) -> Camera:
    """Return a camera between two splats that looks at a third one, all of them in the ball."""
    target = _some(place, random)
    eye = (_some(place, random) + _some(place, random)) / 2
    if np.linalg.norm(target - eye) < 1e-3 * place.radius:
        return _around(place, random.random(3), random)
    return _looking(eye, target, random)


def _some(place: Place, random: np.random.Generator) -> Vector:
    """Return the (3,) centre of a random splat, pulled into the ball."""
    away: Vector = place.center[random.integers(len(place.center))] - place.middle
    return place.middle + away * min(1.0, place.radius / max(float(np.linalg.norm(away)), 1e-30))


def _looking(eye: Vector, target: Vector, random: np.random.Generator) -> Camera:
    up = UP
    ahead = (target - eye) / np.linalg.norm(target - eye)
    if abs(ahead @ UP) > 0.99:  # straight up or down
        up = np.array([0.0, 0.0, 1.0])
    return Camera.look_at(eye.tolist(), target.tolist(), up=up.tolist(), fov_y=random.uniform(*FOVS), size=SIZE)


def split_path(path: CameraPath) -> tuple[tuple[Camera, ...], tuple[Camera, ...]]:
    """Return the training and the held-out cameras of a path, at most `LONGEST` pixels a side; one camera is both."""
    cameras = tuple(map(smaller, path.cameras))
    every = max(OF_PATH, -(-len(cameras) // HELD_OUT))
    held_out = cameras[every // 2 :: every] or cameras[-1:]
    chosen = set(map(id, held_out))
    training = tuple(camera for camera in cameras if id(camera) not in chosen)
    return training[:: max(1, -(-len(training) // TRAINING))] or cameras, held_out


def smaller(camera: Camera) -> Camera:
    """Return the same camera with a picture of at most `LONGEST` pixels a side."""
    share = LONGEST / max(camera.width, camera.height)
    if share >= 1:
        return camera
    width, height = max(1, round(camera.width * share)), max(1, round(camera.height * share))
    across, down = width / camera.width, height / camera.height
    (fx, fy), (cx, cy) = camera.focal, camera.principal
    return dataclasses.replace(
        camera, width=width, height=height, focal=(fx * across, fy * down), principal=(cx * across, cy * down)
    )


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
