"""Colours for numbers: perceptually even ramps, and scales that explain them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray

#: Stops of matplotlib's ramps (CC0), evenly spaced, without the darkest, which are lost on a dark ground.
VIRIDIS = ("414487", "355f8d", "2a788e", "21918c", "22a884", "44bf70", "7ad151", "bddf26", "fde725")
PLASMA = ("5c01a6", "8606a6", "a92395", "c5407e", "db5c68", "ed7953", "f99a3e", "fdc527", "f0f921")
MAGMA = ("51127c", "721f81", "952c80", "b73779", "d8456c", "f1605d", "fc8961", "feb078", "fed799", "fcfdbf")

#: The share of the numbers, in percent, beyond either end of a scale: those have the colour of that end.
CLIPPED = 1

Mark = tuple[float, str]

#: The least span of a logarithmic scale, in powers of ten.
LEAST_DECADES = 0.1


@dataclass(frozen=True)
class Coloring:
    """Colours of N splats, with the scale that explains them.

    Attributes:
        title: the quantity, for display.
        rgb: (N, 3) uint8.
        ramp: (S, 3) uint8 colours of the scale, from its low to its high end; few and distinct for whole numbers.
        marks: positions on the scale, 0..1, and their labels.
    """

    title: str
    rgb: NDArray[np.uint8]
    ramp: NDArray[np.uint8]
    marks: tuple[Mark, ...]


def ramp(stops: tuple[str, ...], count: int) -> NDArray[np.uint8]:
    """Return (count, 3) colours, evenly spaced along a ramp; a single one is from its middle."""
    table = np.array([list(bytes.fromhex(stop)) for stop in stops], np.float64)
    at = np.linspace(0, len(table) - 1, count) if count > 1 else np.array([(len(table) - 1) / 2])
    channels = [np.interp(at, np.arange(len(table)), channel) for channel in table.T]
    return np.stack(channels, 1).round().astype(np.uint8)


def range_of(values: NDArray[Any]) -> tuple[int, int]:
    """Return the ends of a scale for some whole numbers: few of them at either end take no colours from the others."""
    low, high = np.percentile(values, [CLIPPED, 100 - CLIPPED]) if np.ptp(values) > 1 else (values.min(), values.max())
    return int(low), int(high)


def whole_numbers(title: str, values: NDArray[Any], low: int, high: int) -> Coloring:
    """Return a colour for each whole number from low to high; (N,) values beyond have the colour of that end."""
    count = high - low + 1
    colors = ramp(VIRIDIS, count)
    every = math.ceil(count / 12)
    labelled = [*range(low, high - every // 2, every), high] if count > 1 else [low]
    text = {value: f"{value}" for value in labelled}
    if values.min() < low:
        text[low] += " or less"
    if values.max() > high:
        text[high] += " or more"
    marks = [((value - low + 0.5) / count, text[value]) for value in labelled]
    return Coloring(title, colors[np.clip(values - low, 0, count - 1)], colors, tuple(marks))


def smooth(title: str, at: FloatArray, stops: tuple[str, ...], marks: list[Mark]) -> Coloring:
    """Return a ramp without steps, for (N,) places on it, 0..1; those beyond have the colour of that end."""
    colors = ramp(stops, 256)
    return Coloring(title, colors[np.rint(255 * np.clip(at, 0, 1)).astype(np.intp)], colors, tuple(marks))


def top_opacity(values: FloatArray) -> float:
    """Return where a scale of D ends: at 1, or above it at the next tenth."""
    return max(1.0, math.ceil(10 * float(np.percentile(values, 100 - CLIPPED))) / 10)


def log_range(logs: FloatArray) -> tuple[float, float]:
    """Return the ends of a logarithmic scale, in powers of ten, at least LEAST_DECADES apart."""
    low, high = (float(end) for end in np.percentile(logs, [CLIPPED, 100 - CLIPPED]))
    if high - low < LEAST_DECADES:
        low, high = (low + high - LEAST_DECADES) / 2, (low + high + LEAST_DECADES) / 2
    return low, high


def log_marks(low: float, high: float) -> list[Mark]:
    """Return round numbers on a scale between two powers of ten."""
    span = high - low
    factors = (1,) if span > 2.5 else (1, 2, 5) if span > 0.8 else (1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 8)
    decades = range(math.floor(low), math.ceil(high) + 1)
    every = [math.log10(factor) + decade for decade in decades for factor in factors]
    return [((at - low) / span, f"{10**at:.3g}") for at in every if low <= at <= high]


def with_ends(marks: list[Mark], low: str | None, high: str | None, apart: float) -> list[Mark]:
    """Return the marks of a scale and its ends, without marks nearer to the ends than `apart`."""
    ends = [(place, text) for place, text in ((0.0, low), (1.0, high)) if text is not None]
    return [mark for mark in marks if all(abs(mark[0] - place) > apart for place, _ in ends)] + ends


def nice_step(least: float) -> float:
    """Return the smallest number of the form 1, 2 or 5 times a power of ten that is not below `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(step for step in (power, 2 * power, 5 * power, 10 * power, 20 * power) if step >= least * (1 - 1e-9))


def ticks(low: float, high: float, least: float) -> list[tuple[float, str]]:
    """Return round numbers from `low` to `high`, at least `least` apart, and their texts."""
    step = nice_step(least)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    plain = step > 1e-5 and max(abs(low), abs(high)) < 1e7
    return [(step * n, f"{step * n:.{digits}f}" if plain else f"{step * n:.6g}") for n in range(first, last + 1)]
