"""Splats and the boxes that manifests give for them: which lie outside, but for what codes change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import covariance
from ..model.splats import Splats
from ..system.threads import blocks_of

#: By how much a splat may lie outside of its bound: a share of its own extent, by which codes of 8 bits change it; of
#: its largest scale, since they turn it by up to 1.1 degrees; of the bound; and, for codes of logarithms of 16 bits, of
#: the distance from the origin plus 1, or half a step of these codes where that is more.
LOOSE_EXTENT, LOOSE_TURN, LOOSE_BOUND, LOOSE_CENTER = 0.25, 0.02, 1e-3, 2e-4


def count_outside(
    splats: Splats,
    bound: NDArray[np.float64],
    steps: NDArray[np.float64] | float = 0.0,
    directions: NDArray[np.float64] | None = None,
) -> int:
    """Count the splats that lie outside of a bound with the ellipsoids of one standard deviation.

    Args:
        bound: (2, 3) lowest and highest coordinates along the directions.
        steps: (3,) those of the codes of centres, as shares of the distance from the origin plus 1.
        directions: (3, 3) unit vectors as rows, those of the sides of a box; None for the axes.
    """
    loose, step = LOOSE_BOUND * np.abs(bound[1] - bound[0]), np.maximum(LOOSE_CENTER, np.expm1(steps) / 2)
    count = 0
    for block in blocks_of(len(splats)):
        center = splats.center[block].astype(np.float64)
        shape = covariance(splats.scale[block], splats.quat_xyzw[block])
        if directions is None:
            variance = shape[:, [0, 3, 5]]
        else:
            center = center @ directions.T
            full = shape[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
            variance = np.maximum(np.einsum("da,nab,db->nd", directions, full, directions), 0)
        turned = LOOSE_TURN * np.maximum.reduce(splats.scale[block].T)[:, None]
        reach = (1 - LOOSE_EXTENT) * np.sqrt(variance) - turned - loose - step * (1 + np.abs(center))
        count += int(np.count_nonzero(np.any((center - reach < bound[0]) | (center + reach > bound[1]), axis=1)))
    return count
