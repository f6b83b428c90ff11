"""Colour scales: perceptually uniform ramps with labels, and their ranges for what cameras see."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..model.gaussian import lod_opacity, moved, spark_size
from ..model.splats import FloatArray
from ..system.errors import SparklodError
from ..system.progress import Progress, silent
from ..viewers.loaded_scene import TREE, Index, LoadedScene
from ..viewers.scenes import CutFinder, Part
from .render_settings import RasterSettings

#: Evenly spaced stops of matplotlib's ramps (CC0), without the darkest, which are invisible on a dark background.
VIRIDIS = ("414487", "355f8d", "2a788e", "21918c", "22a884", "44bf70", "7ad151", "bddf26", "fde725")
PLASMA = ("5c01a6", "8606a6", "a92395", "c5407e", "db5c68", "ed7953", "f99a3e", "fdc527", "f0f921")
MAGMA = ("51127c", "721f81", "952c80", "b73779", "d8456c", "f1605d", "fc8961", "feb078", "fed799", "fcfdbf")

#: Percentage of outliers beyond either end of a scale, which have the colour of that end.
CLIPPED = 1

#: Least span of a logarithmic scale, in powers of ten.
LEAST_DECADES = 0.1

#: Position on a scale, 0..1, and its label.
Mark = tuple[float, str]


@dataclass(frozen=True)
class Coloring:
    """A colour scale for numbers, with labels.

    Attributes:
        title: the quantity, for display.
        ramp: (S, 3) uint8 colours from low to high; few and distinct for whole numbers.
        low, high: values of the first and of the last colour; values beyond have the same colours.
        log: `low` and `high` are decimal logarithms.
    """

    title: str
    ramp: NDArray[np.uint8]
    marks: tuple[Mark, ...]
    low: float
    high: float
    log: bool = False

    def rgb(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """Return (..., 3) colours of values; NaN has the first colour."""
        values = np.asarray(values, np.float64)
        if self.log:
            values = np.log10(np.clip(values, 1e-30, 1e30))
        at = np.nan_to_num((values - self.low) / ((self.high - self.low) or 1))
        return self.ramp[np.rint(np.clip(at, 0, 1) * (len(self.ramp) - 1)).astype(np.intp)]


def ramp(stops: tuple[str, ...], count: int) -> NDArray[np.uint8]:
    """Return (count, 3) colours, evenly spaced along a ramp; a single colour is from its middle."""
    table = np.array([list(bytes.fromhex(stop)) for stop in stops], np.float64)
    at = np.linspace(0, len(table) - 1, count) if count > 1 else np.array([(len(table) - 1) / 2])
    return np.stack([np.interp(at, np.arange(len(table)), each) for each in table.T], 1).round().astype(np.uint8)


def whole_numbers(title: str, low: int, high: int, *, less: bool = False, more: bool = False) -> Coloring:
    """Return a scale with a colour for each whole number; `less` and `more` say that values lie beyond its ends."""
    count = high - low + 1
    every = math.ceil(count / 12)
    labelled = [*range(low, high - every // 2, every), high] if count > 1 else [low]
    text = {value: f"{value}" for value in labelled}
    text[low] += " or less" * less
    text[high] += " or more" * more
    marks = tuple(((value - low + 0.5) / count, text[value]) for value in labelled)
    return Coloring(title, ramp(VIRIDIS, count), marks, low, high)


def depth_scale(title: str, values: NDArray[Any]) -> Coloring:
    """Return a scale of whole numbers without outliers at either end."""
    least, most = int(values.min()), int(values.max())
    low, high = map(int, np.percentile(values, [CLIPPED, 100 - CLIPPED]) if most - least > 1 else (least, most))
    return whole_numbers(title, low, high, less=least < low, more=most > high)


def smooth(title: str, stops: tuple[str, ...], marks: list[Mark], low: float, high: float) -> Coloring:
    """Return a scale with a continuous ramp."""
    return Coloring(title, ramp(stops, 256), tuple(marks), low, high)


def linear(title: str, stops: tuple[str, ...], low: float, high: float, apart: float | None) -> Coloring:
    """Return a scale labelled with round numbers and, unless `apart` is None, its ends, see `with_ends`."""
    marks = [((tick - low) / (high - low), text) for tick, text in ticks(low, high, (high - low) / 6)]
    if apart is not None:
        marks = with_ends(marks, f"{low:.3g} or less" if low else None, f"{high:.3g} or more", apart)
    return smooth(title, stops, marks, low, high)


def opacity_scale(title: str, values: FloatArray, apart: float) -> Coloring:
    """Return the scale of LoD opacity D, from 0 to 1, or to the tenth above nearly all values."""
    top = max(1.0, math.ceil(10 * float(np.percentile(values, 100 - CLIPPED))) / 10)
    return linear(title, MAGMA, 0.0, top, apart if values.max() > top else None)


def size_scale(values: FloatArray, apart: float, *, sampled: bool) -> Coloring:
    """Return the logarithmic scale of sizes; values of a sample imply that others lie beyond its ends."""
    logs = np.log10(np.clip(values, 1e-30, 1e30).astype(np.float64))
    low, high = (float(end) for end in np.percentile(logs, [CLIPPED, 100 - CLIPPED]))
    if high - low < LEAST_DECADES:
        low, high = (low + high - LEAST_DECADES) / 2, (low + high + LEAST_DECADES) / 2
    less = f"{10**low:.2g} or less" if sampled or logs.min() < low else None
    more = f"{10**high:.2g} or more" if sampled or logs.max() > high else None
    span = high - low
    factors = (1,) if span > 2.5 else (1, 2, 5) if span > 0.8 else (1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 8)
    decades = range(math.floor(low), math.ceil(high) + 1)
    every = [math.log10(factor) + decade for decade in decades for factor in factors]
    marks = [((at - low) / span, f"{10**at:.3g}") for at in every if low <= at <= high]
    scale = smooth("feature size", PLASMA, with_ends(marks, less, more, apart), low, high)
    return replace(scale, log=True)


def with_ends(marks: list[Mark], low: str | None, high: str | None, apart: float) -> list[Mark]:
    """Add marks at the ends of a scale, unless None, and drop marks nearer to them than `apart`."""
    ends = [(place, text) for place, text in ((0.0, low), (1.0, high)) if text is not None]
    return [mark for mark in marks if all(abs(mark[0] - place) > apart for place, _ in ends)] + ends


def nice_step(least: float) -> float:
    """Return the smallest number not below `least` that is 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(step for step in (power, 2 * power, 5 * power, 10 * power, 20 * power) if step >= least * (1 - 1e-9))


def ticks(low: float, high: float, least: float) -> list[tuple[float, str]]:
    """Return round numbers from `low` to `high`, at least `least` apart, with their texts."""
    step = nice_step(least)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    plain = step > 1e-5 and max(abs(low), abs(high)) < 1e7
    return [(step * n, f"{step * n:.{digits}f}" if plain else f"{step * n:.6g}") for n in range(first, last + 1)]


#: Largest samples that determine the ends of a scale: of splats, of cameras, and of cameras whose cuts are computed.
SAMPLE, CAMERAS, CUTS = 1 << 18, 64, 16

#: Least distance of a mark from the ends of a scale, as a share of it; nearer labels would touch.
APART = 0.05


def values_of(by: str, part: Part) -> FloatArray:
    """Return (M,) values of a quantity of the splats in a part: "level", "lod-opacity", "size" or "chunk".

    A level is a depth in a tree or a detail level, and 0 in other files. Sizes are in world units.
    """
    if by in ("level", "chunk"):
        return numbers_of(by, part.scene, part.index).astype(np.float64)
    if by == "lod-opacity":
        return lod_opacity(np.maximum(part.splats.opacity, 0))
    return spark_size(part.splats) * np.float32(np.cbrt(np.linalg.det(part.object_to_world[:3, :3])))


def scale_of_splats(by: str, source: CutFinder, cameras: Sequence[Camera], progress: Progress = silent) -> Coloring:
    """Return the scale of a quantity of `values_of`, over the cuts of cameras for whole numbers, else over all splats.

    `SparklodError` by level if no file has levels.
    """
    candidates = source.candidates().parts
    if by == "level" and not any(part.scene.kind for part in candidates):
        raise SparklodError("there are no levels to colour by: no file is a Level-of-Detail tree, or Streamed SOG")
    if by in ("level", "chunk"):
        level = "tree depth" if any(part.scene.kind == TREE for part in candidates) else "detail level"
        return _scale_of_cuts(by, level if by == "level" else by, source, cameras, progress)
    every = max(1, sum(len(part.index) for part in candidates) // SAMPLE)
    values = np.concatenate([values_of(by, part)[::every] for part in candidates])
    if by == "lod-opacity":
        return opacity_scale("LoD opacity", values, APART)
    return size_scale(values, APART, sampled=True)


def scale_of_depth(source: CutFinder, cameras: Sequence[Camera], settings: RasterSettings) -> Coloring:
    """Return the scale of the depths of splats in the frusta of cameras, without outliers."""
    parts = source.candidates().parts
    every = max(1, sum(len(part.index) for part in parts) // SAMPLE)
    centers = np.concatenate([moved(part.splats.center[::every], part.object_to_world) for part in parts])
    seen = [np.empty(0)]
    for camera in cameras[:: max(1, len(cameras) // CAMERAS)]:
        local = (centers - camera.position) @ camera.camera_to_world[:3, :3]
        depth = -local[:, 2]
        with np.errstate(all="ignore"):
            inside = (depth > settings.near) & (depth < settings.far)
            inside &= abs(camera.focal[0] * local[:, 0] / depth) <= camera.width / 2
            inside &= abs(camera.focal[1] * local[:, 1] / depth) <= camera.height / 2
        seen.append(depth[inside])
    depths = np.concatenate(seen)
    low, high = np.percentile(depths, [CLIPPED, 100 - CLIPPED]) if len(depths) else (settings.near, settings.near + 1)
    # The depth of a nearly flat scene is not stretched over all colours.
    high = max(high, low + 1e-3 * abs(low))
    return linear("depth", tuple(reversed(PLASMA)), float(low), float(high), APART)


def scale_of_overdraw(counts: Sequence[FloatArray]) -> Coloring:
    """Return the scale from 0 to the overdraw of nearly all pixels."""
    most = max(float(np.percentile(count, 99.9)) for count in counts)
    return linear("overdraw", MAGMA, 0.0, max(1.0, float(math.ceil(most))), APART)


def _scale_of_cuts(by: str, title: str, source: CutFinder, cameras: Sequence[Camera], progress: Progress) -> Coloring:
    """Return the scale of the whole numbers that occur in the cuts of a sample of the cameras."""
    every = -(-len(cameras) // CUTS)
    some = cameras[::every]
    ends = []
    for done, camera in enumerate(some, 1):
        seen = (numbers_of(by, part.scene, part.index) for part in source.cut(camera).parts)
        ends += [(int(numbers.min()), int(numbers.max())) for numbers in seen if len(numbers)]
        progress("colours", done, len(some), "cut")
    low, high = min((low for low, _ in ends), default=0), max((high for _, high in ends), default=0)
    return whole_numbers(title, low, high, less=every > 1, more=every > 1)


def numbers_of(by: str, scene: LoadedScene, index: Index) -> NDArray[np.int64]:
    """Return the (M,) "level" or "chunk" of splats of a file; see `values_of`."""
    return scene.chunk_of(index) if by == "chunk" else scene.depth[index].astype(np.int64)
