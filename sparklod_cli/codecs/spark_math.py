"""Exponential and logarithm as Spark computes them, bit for bit.

Spark's worker is compiled to WebAssembly, which has neither; so both are those of Rust's `libm`, after FreeBSD's
msun: float32 throughout, and off by less than one unit of the last place, where numpy's differ from machine to machine.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray

_ONE, _TWO, _HALF = np.float32(1), np.float32(2), np.float32(0.5)

#: ln 2 in two parts, the first of which has few enough bits that its multiples by whole exponents are exact: msun has a
#: pair for each function.
_EXP_LN2: Final = np.float32(6.9314575195e-1), np.float32(1.4286067653e-6)
_LOG_LN2: Final = np.float32(6.9313812256e-1), np.float32(9.0580006145e-6)
_PER_LN2 = np.float32(1.4426950216)

#: Coefficients of r / 2 * (exp(r) + 1) / (exp(r) - 1) in r ** 2, for abs(r) up to ln(2) / 2.
_EXP_COEFFICIENTS: Final = np.float32(1.6666625440e-1), np.float32(-2.7667332906e-3)
#: Coefficients of (ln(1 + s) - ln(1 - s)) / s - 2 in s ** 2.
_LOG_COEFFICIENTS: Final = tuple(map(np.float32, (0.66666662693, 0.40000972152, 0.28498786688, 0.24279078841)))

#: Magnitudes up to which exp takes no multiple of ln 2, and up to which it takes one: ln(2) / 2 and 1.5 ln(2), as the
#: bits that msun compares.
_NO_MULTIPLE, _ONE_MULTIPLE = np.array([0x3EB17218, 0x3F851592], np.uint32).view(np.float32)

#: Numbers whose exponentials are 0 and infinity, as are those beyond them.
_BEYOND: Final = np.float32(-120), np.float32(100)

#: Mantissas are taken from sqrt(1 / 2) to sqrt(2): the bits of the former, and its distance from those of 1.
_SQRT_HALF, _ONE_BITS = 0x3F3504F3, 0x3F800000
#: Subnormal numbers are scaled by 2 to this first.
_SUBNORMAL = 25


@np.errstate(over="ignore", under="ignore", invalid="ignore")
def exp(values: FloatArray) -> FloatArray:
    """Compute e ** values, float32; infinity above 88.7, 0 below -104."""
    values = np.clip(values, *_BEYOND)
    magnitude = np.abs(values)
    one_or_none = np.where(magnitude > _NO_MULTIPLE, np.copysign(_ONE, values), np.float32(0))
    several = np.trunc(_PER_LN2 * values + np.copysign(_HALF, values))
    multiple = np.where(magnitude > _ONE_MULTIPLE, several, one_or_none)
    high, low = values - multiple * _EXP_LN2[0], multiple * _EXP_LN2[1]
    rest = high - low
    square = rest * rest
    first, second = _EXP_COEFFICIENTS
    curve = rest - square * (first + square * second)
    mantissa = _ONE + (rest * curve / (_TWO - curve) - low + high)
    found: FloatArray = np.ldexp(mantissa, np.nan_to_num(multiple).astype(np.int32))
    return found


@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def log(values: FloatArray) -> FloatArray:
    """Compute natural logarithms, float32; minus infinity for 0, NaN below it."""
    subnormal = values < np.finfo(np.float32).tiny
    scaled = np.where(subnormal, values * np.float32(2**_SUBNORMAL), values)
    bits = scaled.view(np.int32) + np.int32(_ONE_BITS - _SQRT_HALF)
    exponent = ((bits >> 23) - 127 - np.where(subnormal, _SUBNORMAL, 0)).astype(np.float32)
    mantissa: NDArray[Any] = ((bits & 0x7FFFFF) + np.int32(_SQRT_HALF)).view(np.float32)
    over_one = mantissa - _ONE
    s = over_one / (_TWO + over_one)
    z = s * s
    w = z * z
    l1, l2, l3, l4 = _LOG_COEFFICIENTS
    series = z * (l1 + w * l3) + w * (l2 + w * l4)
    half_square = _HALF * over_one * over_one
    found: FloatArray = (
        s * (half_square + series) + exponent * _LOG_LN2[1] - half_square + over_one + exponent * _LOG_LN2[0]
    )
    special = ~((values > 0) & (values < np.inf))
    found[special] = np.log(values[special])
    return found
