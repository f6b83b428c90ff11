"""Compensates opacity for rounded scales, so that a splat covers as much as before.

A code of a scale is off by 3 % and more, so that a splat gets up to 7 % larger or smaller, and with it what it adds to
a picture. See docs/decisions/08-rounding.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.falloff import nearly_harmonic
from ..model.splats import FloatArray

#: Largest factor by which an opacity grows for an area that was lost, somewhat more than rounding can take. What loses
#: more is larger than any code, such as a sky, and shrinks: a denser middle would not be more like it.
MOST_GROWTH = 1.125

#: Smallest factor, of what is smaller than any code: a pixel shows it all the same.
LEAST_GROWTH = 1 / 16

#: The smallest float32 above 1.
_ABOVE_1 = np.nextafter(np.float32(1), np.float32(2))


def faces(scale: FloatArray, blur: float) -> NDArray[np.float64]:
    """Return (N,) sums of the products of two scales each, in proportion to the area that a splat shows on average.

    Args:
        scale: (N, 3) standard deviations, world units.
        blur: added to each, as a pixel does: what is far thinner than that covers no less for it.
    """
    planes = np.array(scale.T, np.float64, order="C")
    planes *= planes
    planes += blur * blur
    x, y, z = np.sqrt(planes, out=planes)
    found: NDArray[np.float64] = x * y + x * z + y * z
    return found


def compensated(opacity: FloatArray, scale: FloatArray, rounded: FloatArray, blur: float) -> FloatArray:
    """Return (N,) linear opacities with which splats of rounded scales cover as much as before.

    A splat of opacity A up to 1 covers A times its area, and keeps an opacity up to 1. A merged one of A above 1 covers
    H(A) times its area, where H are the harmonic numbers (see `model/falloff.py`). It stays above 1, for that is
    another falloff. Where nothing is rounded, the opacity stays as it is, bit for bit.

    Args:
        opacity: (N,) linear opacities.
        scale: (N, 3) standard deviations, world units.
        rounded: (N, 3) the same as a file holds them.
        blur: see `faces`; a step of the positions is a good one, for it is far below a small splat of the scene.
    """
    area = faces(rounded, blur)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(area > 0, np.clip(faces(scale, blur) / area, LEAST_GROWTH, MOST_GROWTH), 1)
    wide = opacity.astype(np.float64)
    grown = np.minimum(wide * ratio, 1)
    merged = np.flatnonzero(~(opacity <= 1))  # usually few
    most = wide[merged]
    covered, slope = nearly_harmonic(most)
    grown[merged] = np.maximum(most * np.exp(covered * (ratio[merged] - 1) / slope), _ABOVE_1)
    return np.where(ratio == 1, opacity, grown).astype(np.float32)
