"""`Balls`: what splats cover, a ball each, by which cameras are framed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .splats import Splats

Matrix = NDArray[np.float64]

#: Standard deviations out to which an opaque splat counts. There an opacity of an eighth is left, exp(-2); fainter
#: splats count out to where as much is left of them.
SEEN = 2.0

#: Columns of `Splats` that `balls_of` reads.
USED = ("center", "scale", "opacity")


@dataclass(frozen=True)
class Balls:
    """N bounding spheres of splats.

    Attributes:
        center: (N, 3) float64 world units.
        radius: (N,) float64 world units.
        box: (2, 3) lowest and highest coordinates of all centres, where these are a sample; None where they are all.
        largest: radius, where these are a sample.
    """

    center: Matrix
    radius: Matrix
    box: Matrix | None = None
    largest: float | None = None

    def take(self, index: NDArray[np.bool_]) -> Balls:
        """Return the balls of a mask (N,)."""
        return Balls(self.center[index], self.radius[index])

    @classmethod
    def concat(cls, parts: Iterable[Balls]) -> Balls:
        """Concatenate the balls of several parts, at least one."""
        every = list(parts)
        return cls(np.concatenate([part.center for part in every]), np.concatenate([part.radius for part in every]))


def balls_of(splats: Splats, index: NDArray[Any] | slice, object_to_world: Matrix) -> Balls:
    """Return what some splats cover where they stand; those without finite numbers are left out.

    Args:
        splats: all of an object.
        index: which of them.
        object_to_world: (4, 4) a rotation, a uniform scale and a translation.
    """
    with np.errstate(all="ignore"):
        center = splats.center[index].astype(np.float64) @ object_to_world[:3, :3].T + object_to_world[:3, 3]
        times = float(np.cbrt(np.linalg.det(object_to_world[:3, :3])))
        seen = np.sqrt(np.clip(SEEN**2 + 2 * np.log(splats.opacity[index].astype(np.float64)), 0, SEEN**2))
        radius = seen * times * splats.scale[index].max(axis=1, initial=0).astype(np.float64)
        finite = np.isfinite(center).all(axis=1) & np.isfinite(radius)
    return Balls(center[finite], radius[finite])
