"""Opacity profiles of merged splats: their coverage and variance on the screen, and the inverse.

Spark draws a splat of linear opacity A > 1 with the alpha 1 - (1 - exp(-t)) ** A, t = z^2 / 2, which is that of A equal
splats on top of each other. Its coverage, the integral over the plane, is 2 pi sigma^2 * H(A), where H(A) is the
harmonic number 1 + 1/2 + ... + 1/A. Its variance along an axis is sigma^2 * (H(A) + H2(A) / H(A)) / 2, with H2(A) = 1 +
1/4 + ... + 1/A^2. Both follow from integration by parts; for A up to 1 they are 2 pi sigma^2 * A and sigma^2.

The A of a splat of given coverage and variance therefore depends on the *density* alone, coverage / (2 pi * variance).
The density is A itself up to 1, and H / spread above, which tends to 2, the density of a disc with a sharp edge.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...model import gaussian
from ...model.falloff import harmonic
from ...model.gaussian import MIN_OPACITY, SIZE_PER_D, linear_opacity
from ...system.jit import kernel

#: The largest D of a merged splat; a sharper profile gains nothing (benchmarks/notes/quality-builder.md). A splat
#: whose density is higher than that of this profile is drawn larger instead.
MAX_D = 2.5

#: The same for needles, whose second axis is shorter than this share of the longest. They may be thinner than a pixel,
#: where the blur of the rasterizer takes more from a sharp profile than from the splats that it replaces: wires would
#: fade. Measured; between 0.25 and 0.4, and between 1.5 and 1.75, little changes
#: (benchmarks/notes/quality-builder.md).
NEEDLE, NEEDLE_D = 0.25, 1.5

#: Entries of the table of profiles by density, between which it is interpolated linearly. Chosen.
ENTRIES = 256

lod_opacity_above_1 = kernel(inline=True)(gaussian.lod_opacity_above_1)


def _profiles(lod_opacity: NDArray[np.float32]) -> tuple[NDArray[np.float64], ...]:
    """Return linear opacity, spread (variance / sigma^2) and density of profiles of D at least 1."""
    a = linear_opacity(lod_opacity).astype(np.float64)
    first, second = harmonic(a)
    spread = (first + second / first) / 2
    return a, spread, first / spread


#: Linear opacity and spread at ENTRIES densities from 1 to that of MAX_D.
_OPACITY, _SPREAD, _DENSITY = _profiles(np.linspace(1, MAX_D, 4096, dtype=np.float32))
MAX_DENSITY = float(_DENSITY[-1])
OPACITIES, SPREADS = (np.interp(np.linspace(1, MAX_DENSITY, ENTRIES), _DENSITY, each) for each in (_OPACITY, _SPREAD))
NEEDLE_OPACITY, NEEDLE_SPREAD, NEEDLE_DENSITY = (float(x[0]) for x in _profiles(np.array([NEEDLE_D], np.float32)))


@kernel(inline=True)
def is_needle(a, b, c):
    """Return whether the second of three variances along the axes is below NEEDLE squared of the largest."""
    return max(min(a, b), min(max(a, b), c)) < NEEDLE * NEEDLE * max(a, b, c)


@kernel(inline=True)
def profile_of(density, needle):
    """Return linear opacity and spread of a splat, or a needle, of a density; its variance is spread * sigma^2.

    Above the density of the largest D the spread is smaller than the profile's: a larger sigma keeps the coverage.
    """
    if density <= 1:
        return max(density, MIN_OPACITY), 1.0
    if needle and density >= NEEDLE_DENSITY:
        return NEEDLE_OPACITY, NEEDLE_SPREAD * NEEDLE_DENSITY / density
    if density >= MAX_DENSITY:
        return OPACITIES[-1], SPREADS[-1] * MAX_DENSITY / density
    at = (density - 1) * ((ENTRIES - 1) / (MAX_DENSITY - 1))
    low = min(int(at), ENTRIES - 2)
    part = at - low
    return (
        OPACITIES[low] + part * (OPACITIES[low + 1] - OPACITIES[low]),
        SPREADS[low] + part * (SPREADS[low + 1] - SPREADS[low]),
    )


@kernel(inline=True)
def size_factor(opacity):
    """Feature size over 2 * mean(scale) of a splat of linear opacity, float64; see `gaussian.size_factor`."""
    return 1 + SIZE_PER_D * (lod_opacity_above_1(opacity, 1.0, math.e) - 1) if opacity > 1 else 1.0
