"""What a merged splat covers on the screen: the moments of its opacity's profile, and the profile from the moments.

Spark draws a splat of linear opacity A > 1 with the opacity 1 - (1 - exp(-t)) ** A, t = z^2 / 2, which is what A equal
splats on top of each other make. Over the plane it sums to 2 pi sigma^2 * H(A), where H(A) is the harmonic number,
1 + 1/2 + ... + 1/A, and its variance on an axis is sigma^2 * (H(A) + H2(A) / H(A)) / 2, with H2(A) = 1 + 1/4 + ... +
1/A^2. Both come from integrating by parts; for A up to 1 they are 2 pi sigma^2 * A and sigma^2.

So a splat that is to cover so much with such a variance has an A that follows from the *density* alone, coverage over
2 pi * variance: A itself up to 1, H / spread above, which tends to 2, that of a disc with a sharp edge.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...model.gaussian import MIN_OPACITY, SIZE_PER_D, linear_opacity
from ...support.jit import kernel

#: The sharpest profile that a merged splat gets, D; more gains nothing (docs/decisions/2026-11-21-fidelity.md). What
#: covers more than it can is drawn larger.
SHARPEST = 2.5

#: Entries of the table of profiles by density.
ENTRIES = 256

#: Terms of the sums that are added one by one; the rest is an integral.
TERMS = 64


def harmonic(a: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """H and H2 of real numbers of at least 1, to 1e-7: sums of 1/k - 1/(k + a), and of their squares' differences."""
    k = np.arange(1, TERMS + 1, dtype=np.float64)[:, None]
    start = TERMS + 0.5  # midpoint rule for the terms that are left
    first = (1 / k - 1 / (k + a)).sum(axis=0) + np.log((start + a) / start)
    second = (1 / k**2 - 1 / (k + a) ** 2).sum(axis=0) + 1 / start - 1 / (start + a)
    return first, second


def _table() -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Linear opacity and spread (variance over sigma^2) at `ENTRIES` densities from 1 to the largest, which is last."""
    a = linear_opacity(np.linspace(1, SHARPEST, 4096, dtype=np.float32)).astype(np.float64)
    first, second = harmonic(a)
    spread = (first + second / first) / 2
    density = first / spread
    even = np.linspace(1, density[-1], ENTRIES)
    return np.interp(even, density, a), np.interp(even, density, spread), float(density[-1])


OPACITIES, SPREADS, DENSEST = _table()


@kernel(inline=True)
def profile_of(density):
    """Linear opacity and spread of a splat of a density: its variance is spread * sigma^2.

    Where it is denser than a profile can be, sigma is larger than the variance asks for, so that it covers as much.
    """
    if density <= 1:
        return max(density, MIN_OPACITY), 1.0
    if density >= DENSEST:
        return OPACITIES[-1], SPREADS[-1] * DENSEST / density
    at = (density - 1) * ((ENTRIES - 1) / (DENSEST - 1))
    low = min(int(at), ENTRIES - 2)
    part = at - low
    return (
        OPACITIES[low] + part * (OPACITIES[low + 1] - OPACITIES[low]),
        SPREADS[low] + part * (SPREADS[low + 1] - SPREADS[low]),
    )


@kernel(inline=True)
def size_factor(opacity):
    """How much larger the traversal sees a splat of a linear opacity than one of 1, see `gaussian.spark_size`."""
    return 1 + SIZE_PER_D * (math.sqrt(1 + math.e * math.log(opacity)) - 1) if opacity > 1 else 1.0
