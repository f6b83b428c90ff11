"""Colours for numbers: perceptually even ramps, and the scale that tells what a colour means."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..gaussian import lod_opacity, spark_size
from ..splats import FloatArray, Splats
from .shapes import ticks
from .tree import CHUNK_SPLATS

#: Stops of matplotlib's ramps (CC0), evenly spaced, without the darkest, which are lost on a dark ground.
VIRIDIS = ("414487", "355f8d", "2a788e", "21918c", "22a884", "44bf70", "7ad151", "bddf26", "fde725")
PLASMA = ("5c01a6", "8606a6", "a92395", "c5407e", "db5c68", "ed7953", "f99a3e", "fdc527", "f0f921")
MAGMA = ("51127c", "721f81", "952c80", "b73779", "d8456c", "f1605d", "fc8961", "feb078", "fed799", "fcfdbf")

#: The share of the numbers, in percent, beyond either end of a scale: those have the colour of that end.
CLIPPED = 1

#: The least span of the scale of sizes, in powers of ten.
LEAST_DECADES = 0.1

Mark = tuple[float, str]


@dataclass(frozen=True)
class Coloring:
    """What the colours of N splats mean.

    Attributes:
        title: the quantity, for people.
        rgb: (N, 3) uint8.
        ramp: (S, 3) uint8 colours of the scale, from its low to its high end; few and distinct for whole numbers.
        marks: places on the scale, 0..1, and what they stand for.
    """

    title: str
    rgb: NDArray[np.uint8]
    ramp: NDArray[np.uint8]
    marks: tuple[Mark, ...]


def ramp(stops: tuple[str, ...], count: int) -> NDArray[np.uint8]:
    """(count, 3) colours, evenly spaced along a ramp; a single one is from its middle."""
    table = np.array([list(bytes.fromhex(stop)) for stop in stops], np.float64)
    at = np.linspace(0, len(table) - 1, count) if count > 1 else np.array([(len(table) - 1) / 2])
    channels = [np.interp(at, np.arange(len(table)), channel) for channel in table.T]
    return np.stack(channels, 1).round().astype(np.uint8)


def color_by(by: str, splats: Splats, index: NDArray[np.int64], depth: NDArray[np.int32] | None) -> Coloring:
    """The colours of some splats.

    Args:
        by: "level", which wants a depth, "opacity", "size" or "chunk".
        splats: N of them.
        index: (M,) of those that are coloured; at least one.
        depth: (N,) edges from the root, where there is a tree.
    """
    if by == "level" and depth is not None:
        level = depth[index]
        if level.min() == level.max():  # the colour tells where in the tree it is
            return _whole_numbers("level", level, 0, int(depth.max()))
        return _whole_numbers("level", level, *_range(level))
    if by == "chunk":
        chunk = index // CHUNK_SPLATS
        return _whole_numbers("chunk", chunk, 0, (len(splats) - 1) // CHUNK_SPLATS)
    if by == "opacity":
        return _opacity(lod_opacity(np.maximum(splats.opacity[index], 0)))
    return _size(np.clip(spark_size(splats)[index], 1e-30, 1e30))


def _range(values: NDArray[Any]) -> tuple[int, int]:
    low, high = np.percentile(values, [CLIPPED, 100 - CLIPPED]) if np.ptp(values) > 1 else (values.min(), values.max())
    return int(low), int(high)


def _whole_numbers(title: str, values: NDArray[Any], low: int, high: int) -> Coloring:
    count = high - low + 1
    colors = ramp(VIRIDIS, count)
    every = math.ceil(count / 12)
    shown = [*range(low, high - every // 2, every), high] if count > 1 else [low]
    text = {value: f"{value}" for value in shown}
    if values.min() < low:
        text[low] += " or less"
    if values.max() > high:
        text[high] += " or more"
    marks = [((value - low + 0.5) / count, text[value]) for value in shown]
    return Coloring(title, colors[np.clip(values - low, 0, count - 1)], colors, tuple(marks))


def _opacity(values: FloatArray) -> Coloring:
    top = max(1.0, math.ceil(10 * float(np.percentile(values, 100 - CLIPPED))) / 10)
    marks = [(tick / top, text) for tick, text in ticks(0, top, top / 6)]
    if values.max() > top:
        marks = _with_ends(marks, None, f"{top:g} or more")
    return _smooth("opacity" if values.max() <= 1 else "opacity (D)", values / top, MAGMA, marks)


def _size(values: FloatArray) -> Coloring:
    logs = np.log10(values.astype(np.float64))
    low, high = np.percentile(logs, [CLIPPED, 100 - CLIPPED])
    if high - low < LEAST_DECADES:  # as good as all the same: no more contrast than there is
        low, high = (low + high - LEAST_DECADES) / 2, (low + high + LEAST_DECADES) / 2
    factors = (1,) if high - low > 2.5 else (1, 2, 5) if high - low > 0.8 else (1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 8)
    decades = range(math.floor(low), math.ceil(high) + 1)
    every = [math.log10(factor) + decade for decade in decades for factor in factors]
    marks = [((at - low) / (high - low), f"{10**at:.3g}") for at in every if low <= at <= high]
    less = f"{10**low:.2g} or less" if logs.min() < low else None
    more = f"{10**high:.2g} or more" if logs.max() > high else None
    return _smooth("feature size", (logs - low) / (high - low), PLASMA, _with_ends(marks, less, more))


def _with_ends(marks: list[Mark], low: str | None, high: str | None) -> list[Mark]:
    """The marks of a scale with those of its ends, and without those that would touch them."""
    ends = [(place, text) for place, text in ((0.0, low), (1.0, high)) if text is not None]
    return [mark for mark in marks if all(abs(mark[0] - place) > 0.04 for place, _ in ends)] + ends


def _smooth(title: str, at: FloatArray, stops: tuple[str, ...], marks: list[Mark]) -> Coloring:
    colors = ramp(stops, 256)
    return Coloring(title, colors[np.rint(255 * np.clip(at, 0, 1)).astype(np.intp)], colors, tuple(marks))
