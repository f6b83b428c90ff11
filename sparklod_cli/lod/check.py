"""Checks of the input of a builder, and of its setting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..codecs.validation import check_valid
from ..model.splats import Splats
from ..support.errors import InvalidSplatsError
from ..support.threads import threads_for
from .kernels.geometry import find_bounds


@dataclass(frozen=True)
class Bounds:
    """Bounds of a scene's splats.

    Attributes:
        low, high: (3,) float64 corners of the box of their centres, world units.
        smallest, largest: range of their sizes, 2 * max(scale), world units.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    smallest: float
    largest: float


def check_setting(name: str, value: float, least: float, most: float) -> None:
    """Raise a `ValueError` where the setting of a builder is out of its range."""
    if not least <= value <= most:
        raise ValueError(f"{name} {value} is not within {least} to {most}")


def check(splats: Splats) -> Bounds:
    """Return the bounds of splats; raise `InvalidSplatsError` without any, or if one is invalid or invisible."""
    if len(splats) == 0:
        raise InvalidSplatsError("no splat is left to build a tree of")
    with threads_for(len(splats)) as threads:
        check_valid(splats, threads)
        low, high, smallest, largest = find_bounds(splats.center, splats.scale, threads)
    check_visible(smallest, float(splats.opacity.min()))
    return Bounds(low, high, smallest, largest)


def check_visible(smallest: float, faintest: float = 1.0) -> None:
    """Raise `InvalidSplatsError` where the least size, or the least opacity, of splats is 0."""
    if not (smallest > 0 and faintest > 0):
        raise InvalidSplatsError("a splat is without opacity or scale: see Selection.apply")
