"""Codings of Spark's memory layouts and of RAD: rounding, rotations as axis and angle, alpha, and codes of 8 bits.

The formulas are those of Spark 2.2.0's encoders in Rust, in float32 and in the same order of operations, because the
last bit decides between two codes. Only functions that libraries round differently (arc cosine, sine, logarithm,
exponential) are computed in float64 and rounded once, so that every machine gives the same codes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import linear_opacity, lod_opacity
from ..model.splats import FloatArray
from . import quantize

Words = NDArray[np.uint32]

#: Largest codes of the axis's two numbers and of the angle, in PackedSplats and in ExtSplats.
STEPS_8_8_8 = (255, 255)
STEPS_10_10_12 = (1023, 4095)

_PI = np.float32(np.pi)
#: Sine of half the angle below which the axis is noise: Spark uses the x axis instead.
_NO_ROTATION = np.float32(1e-6)
#: Offset before truncation that rounds ties up. Unlike 1 / 2, it does not round the float32 below 1 / 2 up to 1.
ALMOST_HALF = np.nextafter(np.float32(0.5), np.float32(0))


def to_code(values: FloatArray, most: int) -> NDArray[np.uint32]:
    """Round float32 numbers to codes 0..most, ties up, and clamp others."""
    return (np.clip(values, 0, np.float32(most)) + ALMOST_HALF).astype(np.uint32)


def encode_axis_angle(quat_xyzw: FloatArray, steps: tuple[int, int]) -> tuple[Words, Words, Words]:
    """Encode (N, 4) unit quaternions as (N,) u and v of the axis, 0..steps[0], and the angle, 0..steps[1].

    The axis is that of the rotation by 0..pi, or the x axis for a rotation by 0. It is projected onto the octahedron
    |x| + |y| + |z| = 1, whose upper half covers a square in x and y, and whose lower half is folded outward into the
    corners of that square: u and v are x and y of the result, -1..1.
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

    Largest error: 1.94 degrees of rotation for `STEPS_8_8_8`, 0.476 for `STEPS_10_10_12`. Errors of x and y of the axis
    are at most 1 / steps[0], which is sqrt(6) / steps[0] along a face of the octahedron and sqrt(18) / steps[0] radians
    seen from the middle, sqrt(1 / 3) away, and twice that for a turn by pi. The error of the angle, at most
    pi / 2 / steps[1], is about another axis, at a right angle.
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


#: Scales below this are encoded as 0: e ** -30.
SCALE_ZERO = np.float32(np.exp(-30))


#: Largest end of a range: float32 holds the width of a range from minus this to this.
LARGEST_END = float(quantize.LARGEST) / 2


@dataclass(frozen=True)
class SplatEncoding:
    """Ranges of codes, with the names and defaults of Spark's `splatEncoding`.

    Attributes:
        rgb_min, rgb_max: colours of codes 0 and 255.
        ln_scale_min, ln_scale_max: logarithms of the scales of codes 1 and 255.
        sh1_max, sh2_max, sh3_max: largest SH coefficient of each degree.
        lod_opacity: alpha is 0..2, where 1..2 stands for D = 1..5, as in Spark for an LoD tree.
    """

    rgb_min: float = 0
    rgb_max: float = 1
    ln_scale_min: float = -12
    ln_scale_max: float = 9
    sh1_max: float = 1
    sh2_max: float = 1
    sh3_max: float = 1
    lod_opacity: bool = False

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "lod_opacity" and not isinstance(value, (int, float, np.integer, np.floating)):
                raise TypeError(f"{name} is {value!r}; give a number")
            if not abs(value) <= LARGEST_END:
                raise ValueError(f"{name} is {value}; give a number whose magnitude is at most {LARGEST_END:g}")
        for least, most in (("rgb_min", "rgb_max"), ("ln_scale_min", "ln_scale_max")):
            low, high = getattr(self, least), getattr(self, most)
            if not low < high:
                raise ValueError(f"{least} is {low:g}, which is not below {most}, {high:g}")
        for name in ("sh1_max", "sh2_max", "sh3_max"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name):g}; give a number above 0")

    @property
    def alpha_max(self) -> int:
        """Alpha of code 255."""
        return 2 if self.lod_opacity else 1

    def sh_max(self, degree: int) -> np.float32:
        """Return the largest SH coefficient of a degree."""
        return np.float32((self.sh1_max, self.sh2_max, self.sh3_max)[degree - 1])


#: Ranges that Spark uses unless a file sets others.
DEFAULT = SplatEncoding()


@np.errstate(over="ignore")
def encode_linear(values: FloatArray, low: float, high: float) -> Words:
    """Encode low..high as codes 0..255; other numbers are clamped."""
    first, width = np.float32(low), np.float32(high) - np.float32(low)
    return to_code((values - first) / width * np.float32(255), 255)


def decode_linear(codes: NDArray[np.uint8], low: float, high: float) -> FloatArray:
    """Decode codes 0..255 to low..high. Largest error: (high - low) / 510."""
    return quantize.of_range(codes.astype(np.float32) / np.float32(255), np.float32(low), np.float32(high))


def nearest_log(values: FloatArray) -> FloatArray:
    """Compute natural logarithms in float64, rounded to float32."""
    found: FloatArray = np.log(values.astype(np.float64)).astype(np.float32)
    return found


@np.errstate(over="ignore")  # files may have any range
def nearest_exp(values: FloatArray) -> FloatArray:
    """Compute exponentials in float64, rounded to float32."""
    found: FloatArray = np.exp(values.astype(np.float64)).astype(np.float32)
    return found


def encode_log_scale(
    scale: FloatArray,
    low: float,
    high: float,
    *,
    log: Callable[[FloatArray], FloatArray] = nearest_log,
    least: np.float32 = SCALE_ZERO,
) -> Words:
    """Encode linear scales: 0 for scales below e ** -30, 1..255 for logarithms from low to high.

    Args:
        log: natural logarithm, such as `spark_nodes.log`.
        least: smallest scale that is not encoded as 0.
    """
    first = np.float32(low)
    width = np.float32(high) - first
    zero = scale < least
    logs = log(np.where(zero, np.float32(1), scale))
    codes = 1 + to_code(np.clip((logs - first) / width, 0, 1) * np.float32(254), 254)
    codes[zero] = 0
    return codes


@np.errstate(over="ignore")  # files may have any range
def log_scale_table(low: float, high: float, *, exp: Callable[[FloatArray], FloatArray] = nearest_exp) -> FloatArray:
    """Return the (256,) linear scales of codes. Largest error: a factor of e ** ((high - low) / 508); none for 0."""
    first = np.float32(low)
    logs = first + np.arange(-1, 255, dtype=np.float32) * ((np.float32(high) - first) / np.float32(254))
    table = exp(logs)
    table[0] = 0
    return table
