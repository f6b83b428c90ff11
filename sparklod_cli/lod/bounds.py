"""Bounds of the splats of a scene, and the check of a builder's input."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import Splats
from ..system.errors import InvalidSplatsError
from ..system.threads import BLOCK_ROWS, threads_for
from .kernels.geometry import find_bounds

#: Message on splats without an opacity or a size, which a selection should have dropped.
INVISIBLE = "a splat is without opacity or scale: see Selection.apply"


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

    @classmethod
    def of(cls, splats: Splats) -> Bounds:
        """Return the bounds of splats; without any, the box is from infinity to minus infinity."""
        low, high = np.empty((2, -(-len(splats) // BLOCK_ROWS), 4))
        find_bounds(len(low), splats.center, splats.scale, low, high)
        least, most = low.min(axis=0, initial=np.inf), high.max(axis=0, initial=-np.inf)
        return cls(least[:3], most[:3], 2 * float(least[3]), 2 * float(most[3]))


def check(splats: Splats) -> Bounds:
    """Return the bounds of valid splats; raise `InvalidSplatsError` if there are none, or one is invisible."""
    if len(splats) == 0:
        raise InvalidSplatsError("no splat is left to build a tree of")
    with threads_for(len(splats)):
        bounds = Bounds.of(splats)
    if not (bounds.smallest > 0 and splats.opacity.min() > 0):
        raise InvalidSplatsError(INVISIBLE)
    return bounds
