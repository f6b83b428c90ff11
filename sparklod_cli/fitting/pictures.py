"""Nodes while they are fitted, cameras, pictures of full detail, what nodes must keep, and steps of the optimiser."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.framing import framing
from ..cameras.sources import CameraPath
from ..images.metrics import on_background, psnr_of
from ..lod.kernels.tree_links import add_weighted, fill_weights, find_parents
from ..model.foveation import Cones
from ..model.gaussian import linear_opacity, lod_opacity, normalized_quat, size_factor
from ..model.lod_tree import LodTree
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..render import gradients, rasterizer
from ..render.kernels.shade import add_sh
from ..render.rasterizer import Image, ShadedSplats, draw
from ..render.render_settings import RasterSettings
from ..viewers.loaded_scene import Forest, TreeInstance, nodes_of
from ..viewers.spark import SparkViewer
from .fit_settings import SHARES
from .kernels import adam
from .kernels.adam import MOST_D, Columns, FitBounds
from .kernels.view import by_image, mark_seen, squared_differences

Index = NDArray[np.int64]


class FittedNodes:
    """The nodes of a tree while they change.

    Attributes:
        columns: of the nodes, as they are now; changed in place.
        old: the columns as they were at first.
        leaves: indices of full detail, ascending.
        fitted: indices of the nodes that may change, ascending: the merged splats.
        shares: of the leaves, of the cuts that nodes are judged by.
    """

    shares: Sequence[float] = SHARES

    #: Bounds of what fitting changes. Feature sizes decide which nodes a cut refines, and the builder chose them well.
    #: Measured (benchmarks/notes/refining.md).
    bounds = FitBounds(MOST_D, np.float32(1.06))

    #: Least feature size of a node, over the mean of its children's, weighted by opacity times surface. `inspect
    #: --check` warns below a third, also after rounding to the steps of a format.
    least_ratio = 0.38

    def __init__(self, nodes: Splats, tree: LodTree, raster: RasterSettings, threads: int) -> None:
        self.original, self.tree, self.raster = nodes, tree, raster
        self.old = columns_of(nodes)
        self.columns = _copied(self.old)
        self.leaves: Index = np.flatnonzero(tree.is_leaf)
        self.fitted: Index = np.flatnonzero(~tree.is_leaf)
        self._forest = Forest([nodes_of(nodes, tree, None, precision="float16", threads=threads)])
        self._viewer = SparkViewer(self._forest, [TreeInstance(foveation=Cones())])

    def cut(self, camera: Camera, share: float) -> Index:
        """Return the nodes, ascending, of a cut of a share of the leaves, without pixel-scale limit or foveation."""
        budget = max(1, int(share * len(self.leaves)))
        return self._viewer.cut(camera, budget=budget).indices()[0].astype(np.int64)

    def visible(self, index: Index, camera: Camera) -> tuple[Index, ShadedSplats]:
        """Return the nodes of `index` that a camera may see, and how it sees them."""
        now = self.columns
        whole = ShadedSplats(now.center, now.scale, now.quat_xyzw, now.lod_opacity, now.rgb)
        _, matrix, lens, limits = rasterizer.arguments(whole, camera, self.raster)
        marks = np.empty(len(index), np.bool_)
        mark_seen(len(index), now.center, now.lod_opacity, index, matrix, lens, limits, marks)
        seen = index[marks]
        found = Columns(*(column[seen] for column in now))
        if terms := found.sh.shape[1]:
            eye = camera.position.astype(np.float32)
            add_sh(len(seen), found.center, found.sh, eye, COEFFICIENTS.index(terms), found.rgb)
        np.maximum(found.rgb, 0, out=found.rgb)
        return seen, ShadedSplats(found.center, found.scale, found.quat_xyzw, found.lod_opacity, found.rgb)

    def renew(self, index: Index) -> None:
        self.place(index, self.columns.center[index], self.sizes(index))

    @np.errstate(over="ignore")  # what float16 cannot hold is infinite, as in Spark
    def place(self, index: Index, center: FloatArray, sizes: FloatArray) -> None:
        """Set centres, (M, 3), and feature sizes of the nodes that cuts are found with."""
        rows = self._forest.nodes
        rows["x"][index], rows["y"][index], rows["z"][index] = center.astype(np.float16).T
        rows["size"][index] = sizes.astype(np.float16)

    def sizes(self, index: Index, columns: Columns | None = None) -> FloatArray:
        """Return feature sizes of some nodes as they are now, or by other columns; see `gaussian.spark_size`."""
        columns = columns or self.columns
        x, y, z = columns.scale[index].T
        size: FloatArray = size_factor(columns.lod_opacity[index]) * 2 * ((x + y + z) / np.float32(3))
        return size

    def restore(self, index: Index, columns: Columns | None = None) -> None:
        """Set some nodes to the values of other columns, or to their first ones."""
        for now, other in zip(self.columns, columns or self.old, strict=True):
            now[index] = other[index]
        self.renew(index)

    def halve(self, index: Index) -> None:
        for now, old in zip(self.columns, self.old, strict=True):
            now[index] = (now[index] + old[index]) / 2
        turned = index[(self.columns.quat_xyzw[index] != self.old.quat_xyzw[index]).any(axis=1)]
        self.columns.quat_xyzw[turned] = normalized_quat(self.columns.quat_xyzw[turned])
        self.renew(index)

    def copy(self) -> Columns:
        return _copied(self.columns)

    def changed(self) -> NDArray[np.bool_]:
        """Return a (N,) mask of the nodes that differ from their first values."""
        pairs = zip(self.columns, self.old, strict=True)
        return np.logical_or.reduce([(a != b).reshape(len(a), -1).any(axis=1) for a, b in pairs])

    def result(self) -> Splats:
        """Return all nodes as they are now; what has not changed is the same bit for bit."""
        now = self.columns
        opacity = np.where(
            now.lod_opacity == self.old.lod_opacity, self.original.opacity, linear_opacity(now.lod_opacity)
        )
        return Splats(now.center, now.scale, now.quat_xyzw, opacity, now.rgb, now.sh)


class FittedSet(FittedNodes):
    """The nodes of one cut, `fixed`, for all cameras while they change, leaves too; none gets an opacity above 1."""

    #: No camera chooses among the nodes by their sizes; single scales are limited, see `adam.MOST_CHANGE`.
    bounds, least_ratio = FitBounds(np.float32(1), np.float32(np.inf)), 0.0

    def __init__(self, nodes: Splats, tree: LodTree, fixed: Index, raster: RasterSettings, threads: int) -> None:
        super().__init__(nodes, tree, raster, threads)
        self._fixed = fixed
        self.fitted = fixed[: None if (~tree.is_leaf[fixed]).any() else 0]  # leaves alone are full detail
        self.shares = (len(fixed) / len(self.leaves),)

    def cut(self, camera: Camera, share: float) -> Index:
        return self._fixed


def columns_of(nodes: Splats) -> Columns:
    """Return the columns of nodes as they are fitted."""
    return Columns(nodes.center, nodes.scale, nodes.quat_xyzw, lod_opacity(nodes.opacity), nodes.rgb, nodes.sh)


def _copied(columns: Columns) -> Columns:
    return Columns(*(column.copy() for column in columns))


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

#: Largest number of held-out cameras, and the smallest interval at which cameras of a path are held out.
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
        varies = on_background(full, 0.5).std(axis=(0, 1)).max() >= VARIED
        if varies and full[..., 3].mean() >= COVERED:
            misses = 0
            yield FullDetailPicture(camera, np.rint(full.clip(0, 1) * 65535).astype(np.uint16))
        misses += 1
        if misses > MOST_MISSES:
            return


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


class Optimiser:
    """Adam for the merged splats of a tree, each with its own count of steps."""

    def __init__(self, nodes: FittedNodes) -> None:
        self.nodes = nodes
        self._moved: list[Any] = []
        count, terms = len(nodes.fitted), nodes.columns.sh.shape[1]
        self._slots = slots_of(nodes)
        self._moments = adam.Moments(
            np.zeros((count, adam.FIRST), np.float32),
            np.zeros((count, terms, 3), np.float32),
            np.zeros((count, adam.SECOND), np.float32),
            np.zeros(count, np.int32),
        )

    def step(self, picture: FullDetailPicture, index: Index, rates: adam.Rates) -> None:
        nodes, camera = self.nodes, picture.camera
        seen, shaded = nodes.visible(index, camera)
        drawing = gradients.draw(shaded, camera, nodes.raster)
        found = drawing.gradients(picture.gradient(drawing.image))
        terms = nodes.columns.sh.shape[1]
        rgb, sh = gradients.by_sh(shaded.center, camera.position, terms, shaded.rgb, found.rgb)
        derivatives = found.center, found.log_scale, found.turn, found.lod_opacity, rgb, sh
        columns = adam.Gradients(*map(np.ascontiguousarray, derivatives))
        rates = adam.Rates(*map(np.float32, rates))
        adam.step(len(seen), nodes.columns, nodes.old, seen, self._slots, columns, rates, self._moments, nodes.bounds)
        self._moved.append(seen)

    def place(self) -> None:
        """Update the nodes that cuts are found with, by the steps since the last call."""
        for seen in self._moved:
            self.nodes.renew(seen)
        self._moved.clear()

    def synchronize(self) -> None:
        """Update the columns of the nodes, which are always up to date here."""


def slots_of(nodes: FittedNodes) -> NDArray[np.int32]:
    """Return the row of each node in `Moments`, -1 for those that do not change."""
    slots = np.full(len(nodes.tree), -1, np.int32)
    slots[nodes.fitted] = np.arange(len(nodes.fitted), dtype=np.int32)
    return slots
