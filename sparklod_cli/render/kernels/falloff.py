"""The falloff: alpha of a splat at a distance from its centre.

z is the distance in standard deviations, and z2 its square, which may be rounded to less than 0. Pictures are drawn
with `plain`, `merged` and `shifted`, approximations that LLVM vectorizes; `alpha_at` has the same formulas in libm's
functions.
"""

from __future__ import annotations

import math

import numpy as np

from ...support.fast_math import exp2, log2
from ...support.jit import kernel

f32 = np.float32

#: -log2(e) / 2: exp(-z^2 / 2) = 2 ** (MINUS_HALF_LOG2E * z^2).
MINUS_HALF_LOG2E = f32(-0.7213475204444817)

#: Least argument of `log2`, which must be a normal number. Differences of float32 near 1 are 0 or at least 6e-8, so
#: only 0 is raised to it.
LEAST_REST = f32(1e-30)

#: Least argument of `exp2`, which is exact down to -126. 1 + 2 ** -120 is 1 in float32.
LEAST_EXPONENT = f32(-120)


@kernel(inline=True)
def gauss(z2):
    """exp(-z^2 / 2)."""
    return exp2(MINUS_HALF_LOG2E * z2)


@kernel(inline=True)
def plain(z2, opacity):
    """Alpha of a splat with D up to 1: D * exp(-z^2 / 2)."""
    return opacity * gauss(z2)


@kernel(inline=True)
def merged_parts(z2, power):
    """g = exp(-z^2 / 2), r = 1 - g, log2(r), and r ** power, which is 1 - alpha of a splat with D above 1."""
    g = gauss(z2)
    rest = max(f32(1) - g, LEAST_REST)
    log = log2(rest)
    return g, rest, log, exp2(max(power * log, LEAST_EXPONENT))


@kernel(inline=True)
def merged(z2, power):
    """Alpha of a splat with D above 1: 1 - (1 - exp(-z^2 / 2)) ** power."""
    _, _, _, through = merged_parts(z2, power)
    return f32(1) - through


@kernel(inline=True)
def shifted(z2, opacity):
    """Alpha of a splat with D above 1 in Spark's LoD design: exp(-D / 2 * max(0, z - (D - 1)) ** 2)."""
    beyond = max(np.sqrt(max(z2, f32(0))) - (opacity - f32(1)), f32(0))
    return exp2(MINUS_HALF_LOG2E * opacity * beyond * beyond)


@kernel(inline=True)
def alpha_at(z2, opacity, power, design):
    """Alpha of a splat; `shifted` if `design` and D is above 1."""
    if opacity <= 1:
        alpha = opacity * math.exp(f32(-0.5) * z2)
    elif design:
        beyond = max(math.sqrt(max(z2, f32(0))) - (opacity - f32(1)), f32(0))
        alpha = math.exp(f32(-0.5) * opacity * beyond * beyond)
    else:
        alpha = f32(1) - (f32(1) - math.exp(f32(-0.5) * z2)) ** power
    return alpha
