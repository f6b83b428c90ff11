"""Fitted nodes, cameras, pictures of full detail, laws of fitted nodes, and steps of the optimiser."""

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
    """The nodes of a tree while its merged splats are fitted.

    Attributes:
        columns: current columns of the nodes, changed in place.
        old: the original columns.
        leaves: indices of full detail, ascending.
        fitted: indices of the nodes that may change, ascending: the merged splats.
        shares: sizes of the cuts that are scored, as shares of the leaves.
    """

    shares: Sequence[float] = SHARES

    #: Bounds of changes. Feature sizes decide which nodes a cut refines, and those of the builder are good.
    #: Measured (benchmarks/notes/refining.md).
    bounds = FitBounds(MOST_D, np.float32(1.06))

    #: Least ratio of a node's feature size to the mean of its children's, weighted by opacity times surface. `inspect
    #: --check` warns below a third, which the rounding of a format must not reach.
    least_ratio = 0.38

    def __init__(self, nodes: Splats, tree: LodTree, raster: RasterSettings, threads: int) -> None:
        self.original, self.tree, self.raster = nodes, tree, raster
        self.old = columns_of(nodes)
        self.columns = Columns(*(column.copy() for column in self.old))
        self.leaves: Index = np.flatnonzero(tree.is_leaf)
        self.fitted: Index = np.flatnonzero(~tree.is_leaf)
        self._forest = Forest([nodes_of(nodes, tree, None, precision="float16", threads=threads)])
        self._viewer = SparkViewer(self._forest, [TreeInstance(foveation=Cones())])

    def cut(self, camera: Camera, share: float) -> Index:
        """Return the nodes, ascending, of a cut with a share of the leaves, without pixel-scale limit or foveation."""
        budget = max(1, int(share * len(self.leaves)))
        return self._viewer.cut(camera, budget=budget).indices()[0].astype(np.int64)

    def visible(self, index: Index, camera: Camera) -> tuple[Index, ShadedSplats]:
        """Return the nodes of `index` that may be visible to a camera, and their shaded splats."""
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
        """Update the nodes that cuts are found with from the current columns."""
        self.place(index, self.columns.center[index], self.sizes(index))

    @np.errstate(over="ignore")  # numbers beyond float16 become infinite, as in Spark
    def place(self, index: Index, center: FloatArray, sizes: FloatArray) -> None:
        """Set (M, 3) centres and (M,) feature sizes of the nodes that cuts are found with."""
        rows = self._forest.nodes
        rows["x"][index], rows["y"][index], rows["z"][index] = center.astype(np.float16).T
        rows["size"][index] = sizes.astype(np.float16)

    def sizes(self, index: Index, columns: Columns | None = None) -> FloatArray:
        """Return feature sizes by the current or other columns; see `gaussian.spark_size`."""
        columns = columns or self.columns
        x, y, z = columns.scale[index].T
        size: FloatArray = size_factor(columns.lod_opacity[index]) * 2 * ((x + y + z) / np.float32(3))
        return size

    def restore(self, index: Index, columns: Columns | None = None) -> None:
        """Set nodes to the values of other columns; to the original values by default."""
        for now, other in zip(self.columns, columns or self.old, strict=True):
            now[index] = other[index]
        self.renew(index)

    def halve(self, index: Index) -> None:
        """Move nodes halfway back to their original values."""
        for now, old in zip(self.columns, self.old, strict=True):
            now[index] = (now[index] + old[index]) / 2
        turned = index[(self.columns.quat_xyzw[index] != self.old.quat_xyzw[index]).any(axis=1)]
        self.columns.quat_xyzw[turned] = normalized_quat(self.columns.quat_xyzw[turned])
        self.renew(index)

    def copy(self) -> Columns:
        """Return a copy of the current columns."""
        return Columns(*(column.copy() for column in self.columns))

    def changed(self) -> NDArray[np.bool_]:
        """Return a (N,) mask of the nodes that differ from their original values."""
        pairs = zip(self.columns, self.old, strict=True)
        return np.logical_or.reduce([(a != b).reshape(len(a), -1).any(axis=1) for a, b in pairs])

    def result(self) -> Splats:
        """Return all nodes; unchanged values are the original ones bit for bit."""
        now = self.columns
        opacity = np.where(
            now.lod_opacity == self.old.lod_opacity, self.original.opacity, linear_opacity(now.lod_opacity)
        )
        return Splats(now.center, now.scale, now.quat_xyzw, opacity, now.rgb, now.sh)


class FittedSet(FittedNodes):
    """The nodes of one cut, `fixed`, drawn for all cameras: leaves change, too, and opacities stay at most 1."""

    #: Cuts do not depend on sizes here; single scales are limited, see `adam.MOST_CHANGE`.
    bounds, least_ratio = FitBounds(np.float32(1), np.float32(np.inf)), 0.0

    def __init__(self, nodes: Splats, tree: LodTree, fixed: Index, raster: RasterSettings, threads: int) -> None:
        super().__init__(nodes, tree, raster, threads)
        self._fixed = fixed
        self.fitted = fixed[: None if (~tree.is_leaf[fixed]).any() else 0]  # leaves alone are full detail
        self.shares = (len(fixed) / len(self.leaves),)

    def cut(self, camera: Camera, share: float) -> Index:
        return self._fixed


def columns_of(nodes: Splats) -> Columns:
    """Return the columns of nodes that fitting changes."""
    return Columns(nodes.center, nodes.scale, nodes.quat_xyzw, lod_opacity(nodes.opacity), nodes.rgb, nodes.sh)


Vector = NDArray[np.float64]

#: Pixels of a picture. Larger ones gain less in the same time. Measured (benchmarks/notes/refining.md).
SIZE = (480, 270)

#: Cameras around the scene: their distances in radii, and the share of cameras near the horizon.
DISTANCES, NEAR_HORIZON = (0.5, 5.0), 0.5

#: Largest sine of the elevation of cameras near the horizon.
HORIZON = 0.5

#: Share of the cameras inside the scene, among the splats.
INSIDE = 0.25

#: Vertical fields of view, degrees.
FOVS = (35.0, 75.0)

#: Largest distance of the target of a camera from the middle, in radii, and in distances of the camera.
ASIDE_RADII, ASIDE_DISTANCES = 0.4, 0.25

#: Maximum number of training cameras. Their pictures, 1 MB each, are drawn once. Measured
#: (benchmarks/notes/refining.md).
TRAINING = 300

#: Largest number of held-out cameras, and the smallest interval at which cameras of a path are held out.
HELD_OUT, OF_PATH = 16, 8

#: Longest side of a picture of a path's camera, pixels.
LONGEST = 640

#: Up direction of scenes from training.
UP = np.array([0.0, -1.0, 0.0])

#: Steps of the R2 sequence (Roberts 2018): the generalized golden ratio in three dimensions.
_PLASTIC = 1.22074408460575947536
R3 = np.array([1 / _PLASTIC, 1 / _PLASTIC**2, 1 / _PLASTIC**3])


@dataclass(frozen=True)
class Place:
    """Extent of a scene: (N, 3) centres of splats, world units; middle and radius of a ball with most of them."""

    center: NDArray[np.floating]
    middle: Vector
    radius: float

    @classmethod
    def of(cls, center: NDArray[np.floating]) -> Place:
        """Return the extent of centres."""
        return cls(center, *framing(center))


def placed(place: Place, seed: np.random.SeedSequence) -> Iterator[Camera]:
    """Yield cameras around a scene, in evenly spread directions, and cameras inside it, without end."""
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
    """Return a camera around the scene; `spread` are three numbers 0..1 for its direction and distance."""
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
    """Return a camera midway between two random splats that looks at a third."""
    target = _some(place, random)
    eye = (_some(place, random) + _some(place, random)) / 2
    if np.linalg.norm(target - eye) < 1e-3 * place.radius:
        return _around(place, random.random(3), random)
    return _looking(eye, target, random)


def _some(place: Place, random: np.random.Generator) -> Vector:
    """Return the (3,) centre of a random splat, moved into the ball if outside."""
    away: Vector = place.center[random.integers(len(place.center))] - place.middle
    return place.middle + away * min(1.0, place.radius / max(float(np.linalg.norm(away)), 1e-30))


def _looking(eye: Vector, target: Vector, random: np.random.Generator) -> Camera:
    """Return a camera of a random field of view at a point, directed at another."""
    up = UP
    ahead = (target - eye) / np.linalg.norm(target - eye)
    if abs(ahead @ UP) > 0.99:  # straight up or down
        up = np.array([0.0, 0.0, 1.0])
    return Camera.look_at(eye.tolist(), target.tolist(), up=up.tolist(), fov_y=random.uniform(*FOVS), size=SIZE)


def split_path(path: CameraPath) -> tuple[tuple[Camera, ...], tuple[Camera, ...]]:
    """Divide the cameras of a path, resized by `smaller`, into training and held-out ones; a single camera is both."""
    cameras = tuple(map(smaller, path.cameras))
    every = max(OF_PATH, -(-len(cameras) // HELD_OUT))
    held_out = cameras[every // 2 :: every] or cameras[-1:]
    chosen = set(map(id, held_out))
    training = tuple(camera for camera in cameras if id(camera) not in chosen)
    return training[:: max(1, -(-len(training) // TRAINING))] or cameras, held_out


def smaller(camera: Camera) -> Camera:
    """Return the camera with its picture reduced to at most `LONGEST` pixels a side."""
    share = LONGEST / max(camera.width, camera.height)
    if share >= 1:
        return camera
    width, height = max(1, round(camera.width * share)), max(1, round(camera.height * share))
    across, down = width / camera.width, height / camera.height
    (fx, fy), (cx, cy) = camera.focal, camera.principal
    return dataclasses.replace(
        camera, width=width, height=height, focal=(fx * across, fy * down), principal=(cx * across, cy * down)
    )


#: Least mean alpha of a picture, and least standard deviation of its colours over grey, for pictures worth comparing.
COVERED, VARIED = 0.02, 0.01

#: Added to the mean squared error of a picture: the error at 50 dB, so that better pictures hardly count.
LEAST_ERROR = 1e-5

#: Number of successive cameras that see too little, after which no more are tried.
MOST_MISSES = 64

#: Share of the leaves -> mean PSNR, dB.
Scores = dict[float, float]

#: Number of times that changes are halved before they are undone.
HALVES = 12


@dataclass(frozen=True)
class FullDetailPicture:
    """Picture of full detail from one camera.

    Attributes:
        full: (H, W, 4) uint16, colours multiplied by alpha, and alpha, in units of 1 / 65535.
    """

    camera: Camera
    full: NDArray[np.uint16]

    def errors(self, image: Image) -> tuple[float, float]:
        """Return the mean squared errors of another picture, on black and on white."""
        sums = np.empty((len(image), 2))
        squared_differences(len(image), image, self.full, sums)
        black, white = sums.sum(axis=0) / (image.shape[0] * image.shape[1] * 3)
        return float(black), float(white)

    def gradient(self, image: Image) -> Image:
        """Return the derivative of the mean logarithm of `errors`, by each value of the other picture."""
        result, pixels = np.empty_like(image), image.shape[0] * image.shape[1] * 3
        errors = [error + LEAST_ERROR for error in self.errors(image)]
        by_image(len(image), image, self.full, *(np.float32(1 / (pixels * error)) for error in errors), result)
        return result


def pictures(cameras: Iterator[Camera], nodes: FittedNodes) -> Iterator[FullDetailPicture]:
    """Yield the pictures of the cameras that see enough; end after too many that do not."""
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
    """Return the `mean_psnr` of the cut of each share; empty without pictures."""
    return {
        share: mean_psnr(nodes, functools.partial(nodes.cut, share=share), held_out)
        for share in (nodes.shares if held_out else ())
    }


def mean_psnr(nodes: FittedNodes, cut: Callable[[Camera], Index], compared: Sequence[FullDetailPicture]) -> float:
    """Return the mean PSNR, dB, of each camera's cut over pictures, on a black and on a white background."""
    psnr: list[float] = []
    for picture in compared:
        _, shaded = nodes.visible(cut(picture.camera), picture.camera)
        psnr += map(psnr_of, picture.errors(draw(shaded, picture.camera, nodes.raster)))
    return float(np.mean(psnr))


def gain(before: Scores, after: Scores) -> float:
    """Return the mean gain of PSNR over all budgets, dB."""
    return float(np.mean([after[share] - before[share] for share in before]))


def keep_sizes(nodes: FittedNodes) -> bool:
    """Restore nodes that became too small for their children, unless they were so originally; return True if any.

    A parent is refined before its children if it is larger; a small parent is drawn in their place for too long
    (docs/decisions/11-quality-builder.md).
    """
    parent, _ = find_parents(nodes.tree.child_count, nodes.tree.child_start)
    at_first = _ratios(nodes.old, nodes, parent)
    restored = np.zeros(len(parent), np.bool_)
    while True:
        small = _ratios(nodes.columns, nodes, parent) < np.minimum(nodes.least_ratio, at_first)
        if not small.any():
            break
        # If the node itself is restored already, its children have grown.
        grown = np.flatnonzero((parent >= 0) & (small & restored)[parent] & ~nodes.tree.is_leaf)
        back = np.union1d(np.flatnonzero(small & ~restored), grown)
        back = back[~restored[back]]
        if not back.size:
            break
        restored[back] = True
        nodes.restore(back)
    return bool(restored.any())


def _ratios(columns: Columns, nodes: FittedNodes, parent: Index) -> FloatArray:
    """Return the (N,) ratios of each node's feature size to the mean of its children's; infinite for leaves."""
    every = np.arange(len(parent))
    size, weight = nodes.sizes(every, columns), np.empty(len(parent))
    fill_weights(parent, size, columns.scale, linear_opacity(columns.lod_opacity), weight)
    sums, weights = np.zeros(len(parent)), np.zeros(len(parent))
    add_weighted(parent, size, weight, sums, weights)
    return np.divide(size * weights, sums, out=np.full(len(parent), np.inf), where=sums > 0)


def keep_gains(nodes: FittedNodes, held_out: Sequence[FullDetailPicture], before: Scores) -> Scores:
    """Halve the changes of the nodes in cuts that score less than before, until none does; return the scores."""
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
        self._slots, self._moments = initial_state(nodes)

    def step(self, picture: FullDetailPicture, index: Index, rates: adam.Rates) -> None:
        """Move the nodes of a cut towards a picture of full detail."""
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
        """Update the nodes that cuts are found with by the steps since the last call."""
        for seen in self._moved:
            self.nodes.renew(seen)
        self._moved.clear()

    def synchronize(self) -> None:
        """Update the columns of the nodes; here they are always current."""


def initial_state(nodes: FittedNodes) -> tuple[NDArray[np.int32], adam.Moments]:
    """Return the (N,) row of each node in `Moments`, -1 for nodes that do not change, and moments of 0."""
    slots, count = np.full(len(nodes.tree), -1, np.int32), len(nodes.fitted)
    slots[nodes.fitted] = np.arange(count, dtype=np.int32)
    shapes = (count, adam.FIRST), (count, *nodes.columns.sh.shape[1:]), (count, adam.SECOND)
    first, first_sh, second = (np.zeros(shape, np.float32) for shape in shapes)
    return slots, adam.Moments(first, first_sh, second, np.zeros(count, np.int32))
