"""What a builder cannot build a tree of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import Splats, describe_invalid
from ..support.errors import InvalidSplatsError
from ..support.jit import threads_for
from .kernels.geometry import extremes


@dataclass(frozen=True)
class Extremes:
    """How far splats reach.

    Attributes:
        low, high: (3,) float64, the box of their centres.
        smallest, largest: size, 2 * max(scale).
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    smallest: float
    largest: float


def check(splats: Splats) -> Extremes:
    """How far splats reach that a tree can be built of.

    Raises:
        InvalidSplatsError: there is none, or one that is invalid or cannot be seen.
    """
    if len(splats) == 0:
        raise InvalidSplatsError("no splat is left to build a tree of")
    if invalid := splats.invalid():
        raise InvalidSplatsError(f"{describe_invalid(invalid)}: see Selection.apply")
    with threads_for(len(splats)) as threads:
        low, high, smallest, largest = extremes(splats.center, splats.scale, threads)
    if not (smallest > 0 and splats.opacity.min() > 0):
        raise InvalidSplatsError("a splat is without opacity or scale: see Selection.apply")
    return Extremes(low, high, smallest, largest)
