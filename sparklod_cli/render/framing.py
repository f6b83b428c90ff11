"""Where a scene is, and how large, for cameras that are to look at it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidSplatsError

#: The share of the splats that must be in view: trained scenes have a few that are very far away.
SHARE = 0.9

#: So many splats are looked at; more make no difference that could be seen.
SAMPLE = 1 << 18


def framing(center: NDArray[np.floating]) -> tuple[NDArray[np.float64], float]:
    """The middle of a scene and the radius of a ball around it that most splats are in.

    Args:
        center: (N, 3) of the splats, world units. What is not finite is left out.

    Returns:
        (3,) the median of each coordinate, and a radius above 0.

    Raises:
        InvalidSplatsError: there are no finite centres.
    """
    sample = np.asarray(center[:: max(len(center) // SAMPLE, 1)], np.float64)
    sample = sample[np.isfinite(sample).all(axis=1)]
    if not len(sample):
        raise InvalidSplatsError("the scene has no finite centres for cameras to look at")
    middle = np.median(sample, axis=0)
    radius = float(np.quantile(np.linalg.norm(sample - middle, axis=1), SHARE))
    return middle, radius or 1.0
