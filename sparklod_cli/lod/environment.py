"""The environment of a scene: splats far outside, such as a sky, which are drawn whatever the detail levels are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.splats import Splats
from ..support.errors import InvalidSplatsError


def middle_of(splats: Splats) -> NDArray[np.float64]:
    """(3,) the median of the centres along each axis, which few splats far outside do not move.

    Args:
        splats: at least one; all count the same.
    """
    return np.asarray(np.median(splats.center.astype(np.float64), axis=0))


def beyond(splats: Splats, radius: float) -> NDArray[np.bool_]:
    """(N,) the splats whose centres are farther than a radius from the middle of the scene.

    Args:
        splats: of the whole scene, finite.
        radius: world units.

    Raises:
        InvalidSplatsError: all are.
    """
    middle = middle_of(splats)
    offset = splats.center - middle
    far: NDArray[np.bool_] = np.einsum("ij,ij->i", offset, offset) > float(radius) ** 2
    if far.all():
        x, y, z = middle
        raise InvalidSplatsError(
            f"no splat is within {radius:g} of the middle of the scene ({x:.4g}, {y:.4g}, {z:.4g}); "
            "give --environment-beyond a larger radius"
        )
    return far
