"""The falloff of a splat: alpha by the distance from its centre, its slopes, end and coverage.

A splat of D up to 1 has the alpha D exp(-z^2 / 2), z being the distance in standard deviations; one of linear opacity A
above 1, or D = sqrt(1 + e ln A), has 1 - (1 - exp(-z^2 / 2)) ** A, which is that of A equal splats on top of each other
and flat on top. Spark's LoD design has exp(-D / 2 * max(0, z - (D - 1)) ** 2) instead.

Kernels take the exponent t of 2 ** t, which is D exp(-z^2 / 2) up to D = 1, and exp(-z^2 / 2) above. Pictures are drawn
with `plain`, `merged` and `shifted`, approximations that LLVM vectorizes; `alpha_at` has the same formulas in libm's
functions, and `render.gl.osmesa` in those of OpenGL.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..system.fast_math import exp2, log2
from ..system.jit import kernel

f32 = np.float32

#: log2(e), and half of it: exp(-z^2 / 2) = 2 ** (-HALF_LOG2E * z^2).
LOG2E, HALF_LOG2E = f32(1.442695040888963), f32(0.7213475204444817)

LN2 = f32(np.log(2))

#: Least argument of `log2`, which must be a normal number. Differences of float32 near 1 are 0 or at least 6e-8, so
#: only 0 is raised to it.
LEAST_REST = f32(1e-30)

#: Least argument of `exp2`, which is exact down to -126. 1 + 2 ** -120 is 1 in float32.
LEAST_EXPONENT = f32(-120)

#: Radius to which a splat is drawn, in standard deviations, and its square: Spark's `maxStdDev`, sqrt(8); that of a
#: merged one is larger, by STD_DEV_PER_D per unit of D above 1.
SQUARE_STD_DEV = 8
MAX_STD_DEV, STD_DEV_PER_D = SQUARE_STD_DEV**0.5, 0.7

#: Least alpha that is drawn, half a step of 8 bits: Spark's `minAlpha`.
MIN_ALPHA = 0.5 / 255

#: Area that a splat covers out to MAX_STD_DEV, over the square of its feature size, 2 standard deviations.
DRAWN_AREA = np.float64(np.pi / 4 * SQUARE_STD_DEV)

#: Terms of the harmonic sums that are added one by one; the rest is an integral. With 64 the sums are exact to 1e-7.
TERMS = 64


# Alpha


@kernel(inline=True)
def plain(t):
    """Return alpha of a splat with D up to 1: 2 ** t."""
    return exp2(t)


@kernel(inline=True)
def merged_parts(t, power):
    """Return g = 2 ** t, r = 1 - g, log2(r), and r ** power, which is 1 - alpha of a splat with D above 1."""
    g = exp2(t)
    rest = max(f32(1) - g, LEAST_REST)
    # The power multiplies the rounding error of 1 - g, which is therefore added: it is 0 where g is 1/2 or more.
    log = log2(rest) + LOG2E * ((f32(1) - rest) - g)
    return g, rest, log, exp2(max(power * log, LEAST_EXPONENT))


@kernel(inline=True)
def merged(t, power):
    """Return alpha of a splat with D above 1: 1 - (1 - exp(-z^2 / 2)) ** power."""
    _, _, _, through = merged_parts(t, power)
    return f32(1) - through


@kernel(inline=True)
def shifted(t, opacity):
    """Return alpha of a splat with D above 1 in Spark's LoD design: exp(-D / 2 * max(0, z - (D - 1)) ** 2)."""
    beyond = max(np.sqrt(max(-t / HALF_LOG2E, f32(0))) - (opacity - f32(1)), f32(0))
    return exp2(-HALF_LOG2E * opacity * beyond * beyond)


@kernel(inline=True)
def alpha_at(t, opacity, power, design):
    """Return alpha of a splat; `shifted` if `design` and D is above 1."""
    if opacity <= 1:
        alpha = 2.0**t
    elif design:
        beyond = max(math.sqrt(max(-t / HALF_LOG2E, f32(0))) - (opacity - f32(1)), f32(0))
        alpha = math.exp(f32(-0.5) * opacity * beyond * beyond)
    else:
        alpha = 1.0 - (1.0 - 2.0**t) ** power
    return alpha


# Slopes: derivatives of alpha by z^2, and by D up to 1 or the power above


@kernel(inline=True)
def plain_slopes(t, inverse):
    """Return alpha of a splat with D up to 1, and its derivatives by z^2 and D; `inverse` is 1 / D."""
    alpha = plain(t)
    return alpha, f32(-0.5) * alpha, alpha * inverse


@kernel(inline=True)
def merged_slopes(t, power):
    """Return alpha of a splat with D above 1, and its derivatives by z^2 and the power."""
    g, rest, log, through = merged_parts(t, power)
    return f32(1) - through, f32(-0.5) * g * power * (through / rest), -LN2 * through * log


# The end


@kernel(inline=True)
def deviations_of(d, std_devs, std_devs_per_d):
    """Return the radius to which a splat is drawn, in standard deviations, if its alpha suffices."""
    return std_devs + std_devs_per_d * max(d - f32(1), f32(0))


@kernel(inline=True)
def end_of(d, log, deviations, min_alpha):
    """Return the z^2 where a splat ends: up to D = 1, whose log2 is `log`, where its alpha is least."""
    faint = min(deviations * deviations, (log - log2(min_alpha)) / HALF_LOG2E)
    return max(faint if d <= f32(1) else deviations * deviations, f32(0))


# Coverage: the integral of alpha over the plane is 2 pi sigma^2 H(A), H(A) = 1 + 1/2 + ... + 1/A the harmonic number


def harmonic(a: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return H(a) and H2(a) of real numbers a >= 1, to 1e-7: sums of 1/k - 1/(k + a) and of 1/k^2 - 1/(k + a)^2.

    The variance of a splat along an axis is sigma^2 * (H(A) + H2(A) / H(A)) / 2.
    """
    k = np.arange(1, TERMS + 1, dtype=np.float64)[:, None]
    start = TERMS + 0.5  # midpoint rule for the remaining terms
    first = (1 / k - 1 / (k + a)).sum(axis=0) + np.log((start + a) / start)
    second = (1 / k**2 - 1 / (k + a) ** 2).sum(axis=0) + 1 / start - 1 / (start + a)
    return first, second
