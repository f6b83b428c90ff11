"""Codings shared by Spark's memory layouts: rotations as axis and angle, rounding, alpha, and checks of arrays.

The formulas are those of Spark 2.2.0's encoders in Rust, in float32 and in the same order of operations, because the
last bit decides between two codes. Only functions that libraries round differently (arc cosine, sine, logarithm,
exponential) are computed in float64 and rounded once, so that every machine gives the same codes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import linear_opacity, lod_opacity
from ..model.splats import FloatArray
from ..support.errors import FormatError

Words = NDArray[np.uint32]

#: Largest codes of the axis's two numbers and of the angle, in PackedSplats and in ExtSplats.
STEPS_8_8_8 = (255, 255)
STEPS_10_10_12 = (1023, 4095)

#: Units of the last place by which the logarithm, the exponential and the square root of an alpha may miss it together.
_STEPS_TO_STORED = (0, 1, -1, 2, -2, 3, -3, 4, -4)

_PI = np.float32(np.pi)
#: Sine of half the angle below which the axis is noise: Spark uses the x axis instead.
_NO_ROTATION = np.float32(1e-6)
#: Added before truncation, this rounds ties up; unlike 1 / 2 itself it does not round the float32 below 1 / 2 up to 1.
ALMOST_HALF = np.nextafter(np.float32(0.5), np.float32(0))


def round_half_away(values: FloatArray) -> FloatArray:
    """Round float32 to whole numbers, ties away from zero, as Rust's `round` does and numpy's does not."""
    return np.trunc(values + np.copysign(ALMOST_HALF, values))


def to_code(values: FloatArray, most: int) -> NDArray[np.uint32]:
    """Round float32 numbers in units of codes to whole codes, clamped to 0..most, ties up."""
    return (np.clip(values, 0, np.float32(most)) + ALMOST_HALF).astype(np.uint32)


def encode_axis_angle(quat_xyzw: FloatArray, steps: tuple[int, int]) -> tuple[Words, Words, Words]:
    """Encode (N, 4) unit quaternions as (N,) u and v of the axis, 0..steps[0], and the angle, 0..steps[1].

    The axis is that of the rotation by 0..pi. It is projected onto the octahedron |x| + |y| + |z| = 1, whose lower half
    is folded outward into the corners of the square that the upper half covers in x and y: u and v are x and y of the
    result, -1..1. A rotation by 0 gets the x axis.
    """
    axis_steps, angle_steps = steps
    x, y, z, w = np.ascontiguousarray(quat_xyzw.T)
    angle = 2 * np.arccos(np.minimum(np.abs(w), 1).astype(np.float64)).astype(np.float32)
    sine = np.sin((angle * np.float32(0.5)).astype(np.float64)).astype(np.float32)
    still = sine < _NO_ROTATION
    signed_sine = np.where(w < 0, -sine, sine)
    signed_sine[still] = 1
    x, y, z = x / signed_sine, y / signed_sine, z / signed_sine
    x[still], y[still], z[still] = 1, 0, 0
    length = np.abs(x) + np.abs(y) + np.abs(z)
    u, v = x / length, y / length
    below = z < 0
    u, v = (
        np.where(below, np.where(u >= 0, 1 - np.abs(v), np.abs(v) - 1), u),
        np.where(below, np.where(v >= 0, 1 - np.abs(u), np.abs(u) - 1), v),
    )
    half, scale = np.float32(0.5), np.float32(axis_steps)
    return (
        to_code((u * half + half) * scale, axis_steps),
        to_code((v * half + half) * scale, axis_steps),
        to_code(angle / _PI * np.float32(angle_steps), angle_steps),
    )


def decode_axis_angle(u: NDArray[Any], v: NDArray[Any], angle: NDArray[Any], steps: tuple[int, int]) -> FloatArray:
    """Decode three codes, (N,) each, to (N, 4) unit quaternions x y z w with w >= 0.

    Largest error: 1.94 degrees of rotation for `STEPS_8_8_8`, 0.476 for `STEPS_10_10_12`. x and y of the axis lie
    within 1 / steps[0], which is sqrt(6) / steps[0] along a face of the octahedron and sqrt(18) / steps[0] radians
    seen from the middle, sqrt(1 / 3) away; a turn by pi has twice that. The angle lies within pi / 2 / steps[1], and
    that error is about another axis, at a right angle.
    """
    axis_steps, angle_steps = steps
    x, y = u * np.float64(2 / axis_steps) - 1, v * np.float64(2 / axis_steps) - 1
    z = 1 - np.abs(x) - np.abs(y)
    fold = np.maximum(-z, 0)
    x, y = np.where(x >= 0, x - fold, x + fold), np.where(y >= 0, y - fold, y + fold)
    half = angle * np.float64(np.pi / 2 / angle_steps)
    scale = np.sin(half) / np.sqrt(x * x + y * y + z * z)
    return np.stack([x * scale, y * scale, z * scale, np.cos(half)], axis=1).astype(np.float32)


def encode_lod_alpha(opacity: FloatArray) -> FloatArray:
    """Encode linear opacity A as Spark's alpha: A up to 1; above, (D + 3) / 4, which maps D = 1..5 to 1..2."""
    d = lod_opacity(opacity)
    return np.where(d > 1, (d + 3) * np.float32(0.25), d)


def decode_lod_alpha(alpha: FloatArray) -> FloatArray:
    """Decode Spark's alpha to linear opacity A; above 1, D is 4 * alpha - 3. Largest error: that of float32."""
    return linear_opacity(lod_opacity_of_alpha(alpha))


def lod_opacity_of_alpha(alpha: FloatArray) -> FloatArray:
    """Return the LoD opacity D of Spark's alpha: alpha up to 1, 4 * alpha - 3 above."""
    return np.where(alpha > 1, 4 * alpha - 3, alpha)


def stored_lod_alpha(opacity: FloatArray) -> FloatArray:
    """Return the alpha that linear opacity A was decoded from, to the last bit.

    `encode_lod_alpha` may miss it by some units of the last place, and then another number nearby decodes to A. Where
    none does, A was not decoded from an alpha, and has that of `encode_lod_alpha`.
    """
    alpha = encode_lod_alpha(opacity)
    left = np.flatnonzero(alpha > 1)  # usually few
    for steps in _STEPS_TO_STORED:
        if not left.size:
            break
        near = (alpha[left].view(np.int32) + np.int32(steps)).view(np.float32)
        found = decode_lod_alpha(near) == opacity[left]
        alpha[left[found]] = near[found]
        left = left[~found]
    return alpha


def checked_words(arrays: Mapping[str, NDArray[Any]], columns: Mapping[str, int]) -> dict[str, Words]:
    """Return the arrays of these names, each (N, columns) uint32 with the same N, C-contiguous.

    Raises:
        FormatError: an array is missing, or has another shape or type.
    """
    found = {}
    rows = None
    for name, width in columns.items():
        array = arrays.get(name)
        if array is None:
            raise FormatError(f"there is no array {name}, only {', '.join(arrays) or 'none'}")
        rows = len(array) if rows is None and array.ndim else rows
        if array.dtype != np.uint32 or array.shape != (rows, width):
            raise FormatError(f"{name} is {array.dtype}{list(array.shape)}, expected uint32[{rows}, {width}]")
        found[name] = np.ascontiguousarray(array)
    return found
