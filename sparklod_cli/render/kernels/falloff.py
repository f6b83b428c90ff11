"""The falloff: alpha of a splat at a distance from its centre.

Functions take the exponent t of 2 ** t, which is D exp(-z^2 / 2) up to D = 1, and exp(-z^2 / 2) above, z being the
distance in standard deviations. Pictures are drawn with `plain`, `merged` and `shifted`, approximations that LLVM
vectorizes; `alpha_at` has the same formulas in libm's functions.
"""

from __future__ import annotations

import math

import numpy as np

from ...support.fast_math import exp2, log2
from ...support.jit import kernel

f32 = np.float32

#: log2(e), and half of it: exp(-z^2 / 2) = 2 ** (-HALF_LOG2E * z^2).
LOG2E, HALF_LOG2E = f32(1.442695040888963), f32(0.7213475204444817)

#: Least argument of `log2`, which must be a normal number. Differences of float32 near 1 are 0 or at least 6e-8, so
#: only 0 is raised to it.
LEAST_REST = f32(1e-30)

#: Least argument of `exp2`, which is exact down to -126. 1 + 2 ** -120 is 1 in float32.
LEAST_EXPONENT = f32(-120)


@kernel(inline=True)
def plain(t):
    """Alpha of a splat with D up to 1: 2 ** t."""
    return exp2(t)


@kernel(inline=True)
def merged_parts(t, power):
    """g = 2 ** t, r = 1 - g, log2(r), and r ** power, which is 1 - alpha of a splat with D above 1."""
    g = exp2(t)
    rest = max(f32(1) - g, LEAST_REST)
    # The power multiplies what 1 - g is rounded by, so that is added: it is 0 where g is 1/2 or more.
    log = log2(rest) + LOG2E * ((f32(1) - rest) - g)
    return g, rest, log, exp2(max(power * log, LEAST_EXPONENT))


@kernel(inline=True)
def merged(t, power):
    """Alpha of a splat with D above 1: 1 - (1 - exp(-z^2 / 2)) ** power."""
    _, _, _, through = merged_parts(t, power)
    return f32(1) - through


@kernel(inline=True)
def shifted(t, opacity):
    """Alpha of a splat with D above 1 in Spark's LoD design: exp(-D / 2 * max(0, z - (D - 1)) ** 2)."""
    beyond = max(np.sqrt(max(-t / HALF_LOG2E, f32(0))) - (opacity - f32(1)), f32(0))
    return exp2(-HALF_LOG2E * opacity * beyond * beyond)


@kernel(inline=True)
def alpha_at(t, opacity, power, design):
    """Alpha of a splat; `shifted` if `design` and D is above 1."""
    if opacity <= 1:
        alpha = 2.0**t
    elif design:
        beyond = max(math.sqrt(max(-t / HALF_LOG2E, f32(0))) - (opacity - f32(1)), f32(0))
        alpha = math.exp(f32(-0.5) * opacity * beyond * beyond)
    else:
        alpha = 1.0 - (1.0 - 2.0**t) ** power
    return alpha
