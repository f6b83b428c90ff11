"""Number codings: pairs of functions that encode and decode arrays. Each decode states its largest error.

Encoders take finite numbers and clamp them to the range of the code.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import normalized_quat
from ..model.sh import COEFFICIENTS, SH_C0
from ..model.splats import FloatArray

Bytes = NDArray[np.uint8]

#: Bytes of logarithmic scales in SPZ: steps per factor of e, and minus the smallest logarithm.
SCALE_STEPS, SCALE_OFFSET = 16, 10

#: Bytes of colours in SPZ: factor of SH DC coefficients, around one half.
COLOR_GAIN = 0.15

#: Fewest bits of the SH bytes of degrees above 1, and of degree 1, those of Niantic's library.
LEAST_SH_BITS, LEAST_SH_BITS_1 = 4, 5

#: All bits of a byte.
ALL_BITS = 8

#: Largest code of signed 24-bit fixed point.
FIXED24_MAX = 2**23 - 1

#: Smallest and largest value of each column of `Splats` that SPZ rounds to a code instead of clamping it.
CLAMPS = {
    "scale": (float(np.exp(-0.5 / SCALE_STEPS - SCALE_OFFSET)), float(np.exp(255.5 / SCALE_STEPS - SCALE_OFFSET))),
    "rgb": (0.5 - 128 * SH_C0 / (255 * COLOR_GAIN), 0.5 + 128 * SH_C0 / (255 * COLOR_GAIN)),
    "sh": (-128.5 / 128, 127.5 / 128),
}

_SQRT_HALF = np.float32(np.sqrt(0.5))
#: Indices of the three other components of a quaternion, by the index of the largest.
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])

#: Below this w of a unit quaternion, a neighbour of the codes of x y z may decode to a nearer rotation.
_SMALL_W = 0.25
#: Steps from the codes of x y z to their neighbours; no step comes first.
_STEPS = sorted(itertools.product((0, -1, 1), repeat=3), key=lambda step: sum(map(abs, step)))

#: Replaces infinite logarithms and logits: its exponential and sigmoid in float32 are exactly those of infinity, and
#: readers that refuse infinite numbers accept it.
FAR = np.float32(110)

#: Euler's constant, of the harmonic numbers.
EULER = 0.5772156649015329

#: Largest float32.
LARGEST = np.finfo(np.float32).max

#: Largest float32 whose exponential is finite in float32: the logarithm of `LARGEST`, rounded down.
LARGEST_LOG = np.nextafter(np.float32(np.log(np.float64(LARGEST))), np.float32(0))


def decode_log(values: FloatArray) -> FloatArray:
    """Decode natural logarithms. Exact up to float32 arithmetic."""
    with np.errstate(over="ignore"):
        return np.exp(values)


def encode_log(values: FloatArray) -> FloatArray:
    """Encode values of 0 or more as natural logarithms, which are finite, as are their exponentials."""
    with np.errstate(divide="ignore"):
        return np.clip(np.log(values), -FAR, LARGEST_LOG)


def decode_logit(logit: FloatArray) -> FloatArray:
    """Decode logits to 0..1. Exact up to float32 arithmetic."""
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-logit))


def encode_logit(values: FloatArray) -> FloatArray:
    """Encode 0..1 as logits, which are finite for 0 and 1, too."""
    wide = values.astype(np.float64)
    with np.errstate(divide="ignore"):
        return np.clip(np.log(wide) - np.log1p(-wide), -FAR, FAR).astype(np.float32)


def decode_dc(dc: FloatArray) -> FloatArray:
    """Decode SH DC coefficients to display-referred colours. Exact up to float32 arithmetic."""
    return dc * np.float32(SH_C0) + np.float32(0.5)


def encode_dc(rgb: FloatArray) -> FloatArray:
    """Encode display-referred colours as SH DC coefficients, clamped to the range of float32."""
    with np.errstate(over="ignore"):
        return np.clip((rgb - np.float32(0.5)) / np.float32(SH_C0), -LARGEST, LARGEST)


def _to_byte(values: NDArray[Any]) -> Bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def encode_fixed24(values: FloatArray, fractional_bits: int) -> Bytes:
    """Encode (..., n) as (..., n, 3): little-endian 24-bit fixed point."""
    fixed = np.rint(np.ldexp(values.astype(np.float64), fractional_bits))
    clamped = np.clip(fixed, -FIXED24_MAX - 1, FIXED24_MAX).astype("<i4")
    return clamped.view(np.uint8).reshape(*values.shape, 4)[..., :3]


def decode_fixed24(codes: Bytes, fractional_bits: int) -> FloatArray:
    """Decode (..., n, 3) to (..., n). Largest error: half of 2 ** -fractional_bits."""
    wide = np.zeros((*codes.shape[:-1], 4), np.uint8)
    wide[..., 1:] = codes
    signed = wide.view("<i4")[..., 0] >> 8
    return np.ldexp(signed.astype(np.float32), -fractional_bits)


def encode_log_scale(scale: FloatArray) -> Bytes:
    """Encode linear scales as bytes, for e ** -10 to e ** 5.94."""
    with np.errstate(divide="ignore"):
        return _to_byte((np.log(scale) + SCALE_OFFSET) * SCALE_STEPS)


def decode_log_scale(codes: Bytes) -> FloatArray:
    """Decode bytes to linear scales. Largest error: a factor of e ** (1 / 32), 3.2 %."""
    return np.exp(codes.astype(np.float32) / SCALE_STEPS - SCALE_OFFSET)


def encode_unorm8(values: FloatArray) -> Bytes:
    """Encode 0..1 as a byte."""
    with np.errstate(over="ignore"):
        return _to_byte(values * 255)


def decode_unorm8(codes: Bytes) -> FloatArray:
    """Decode bytes to 0..1. Largest error: 1 / 510."""
    return codes.astype(np.float32) / 255


def encode_lod_opacity(lod_opacity: FloatArray) -> Bytes:
    """Encode Spark's D, 0..5, as bytes: the lower half for 0..1, the upper half for 1..5.

    Ties round down, so that D = 1, half-way between two codes, remains an opacity (code 127, 0.996) and does not become
    that of a merged splat (code 128, D = 1.016).
    """
    half = np.where(lod_opacity <= 1, lod_opacity, (lod_opacity + 3) / 4) / 2
    return _to_byte(np.ceil(half * 255 - 0.5))


def decode_lod_opacity(codes: Bytes) -> FloatArray:
    """Decode bytes to Spark's D. Largest error: 1 / 255 up to 1, 4 / 255 above."""
    value = codes.astype(np.float32) * np.float32(2 / 255)
    return np.where(value <= 1, value, 4 * value - 3)


def encode_color(rgb: FloatArray) -> Bytes:
    """Encode display-referred colours as bytes of their SH DC coefficients; the range is -0.44..1.44."""
    with np.errstate(over="ignore"):
        return _to_byte((rgb - np.float32(0.5)) * np.float32(COLOR_GAIN * 255 / SH_C0) + np.float32(127.5))


def decode_color(codes: Bytes) -> FloatArray:
    """Decode bytes to display-referred colours. Largest error: SH_C0 / (2 * 0.15 * 255) = 0.0037."""
    return (codes.astype(np.float32) / 255 - np.float32(0.5)) * np.float32(SH_C0 / COLOR_GAIN) + np.float32(0.5)


def encode_sh(sh: FloatArray, bits: int = LEAST_SH_BITS) -> Bytes:
    """Encode (N, K, 3) coefficients as bytes, rounded to multiples of 2 ** (8 - bits) codes; the range is -1..0.99.

    The number of bits is `LEAST_SH_BITS` to 8; degree 1 has at least `LEAST_SH_BITS_1`. The codes of fewer bits are
    among those of more.
    """
    bucket: np.float32 | FloatArray = np.float32(2 ** (8 - bits))
    if bits < LEAST_SH_BITS_1:
        first = np.arange(3 * sh.shape[1]) < 3 * COEFFICIENTS[1]
        bucket = np.where(first, np.float32(2 ** (8 - LEAST_SH_BITS_1)), bucket)
    # In place, and in rows of all coefficients, which is four times as fast as loops over three channels.
    with np.errstate(over="ignore"):
        scaled = sh.reshape(len(sh), 3 * sh.shape[1]) * (np.float32(128) / bucket)
        np.rint(scaled, out=scaled)
        scaled *= bucket
        scaled += np.float32(128)
    return np.clip(scaled, 0, 255, out=scaled).astype(np.uint8).reshape(sh.shape)


def decode_sh(codes: Bytes) -> FloatArray:
    """Decode bytes to coefficients. Largest error: 2 ** -bits, with the bits of `encode_sh`."""
    return (codes.astype(np.float32) - 128) / 128


def encode_quat_first_three(quat_xyzw: FloatArray) -> Bytes:
    """Encode (N, 4) unit quaternions as (N, 3) bytes of x y z, of q or -q with w >= 0.

    A small w is the root of a small difference, and sensitive to x y z. For those, neighbouring codes are compared, and
    the codes of the nearest rotation are chosen.
    """
    sign = np.where(quat_xyzw[:, 3:] < 0, np.float32(-1), np.float32(1))
    codes = _to_byte(quat_xyzw[:, :3] * (sign * np.float32(127.5)) + np.float32(127.5))
    rows = np.flatnonzero(np.abs(quat_xyzw[:, 3]) < _SMALL_W)
    if rows.size:
        exact, first = quat_xyzw[rows] * sign[rows], codes[rows].astype(np.int16)
        nearest = np.full(len(rows), -np.inf, np.float32)
        for step in _STEPS:
            tried = np.clip(first + step, 0, 255).astype(np.uint8)
            cosine = np.einsum("ij,ij->i", decode_quat_first_three(tried), exact)
            better = cosine > nearest
            nearest[better] = cosine[better]
            codes[rows[better]] = tried[better]
    return codes


def decode_quat_first_three(codes: Bytes) -> FloatArray:
    """Decode (N, 3) bytes to (N, 4) unit quaternions. Largest error: 8 degrees of rotation, where w is near 0."""
    return quat_of_xyz(codes.astype(np.float32) / np.float32(127.5) - 1)


def quat_of_xyz(xyz: FloatArray) -> FloatArray:
    """Return the (N, 4) unit quaternions with these (N, 3) x y z and w >= 0; x y z that are too long are shortened."""
    w = np.sqrt(np.maximum(0, 1 - np.einsum("ij,ij->i", xyz, xyz)))
    return normalized_quat(np.concatenate([xyz, w[:, None]], axis=1))


def encode_quat_smallest_three(quat_xyzw: FloatArray) -> Bytes:
    """Encode (N, 4) unit quaternions as (N, 4) bytes, a little-endian uint32.

    The upper 2 bits are the index of the largest component. The other components follow in order, each with a sign and
    9 bits of magnitude in units of sqrt(1 / 2) / 511.
    """
    largest = np.abs(quat_xyzw).argmax(axis=1)[:, None]
    others = np.take_along_axis(quat_xyzw, OTHERS[largest[:, 0]], axis=1)
    flip = np.take_along_axis(quat_xyzw, largest, axis=1) < 0
    sign = ((others < 0) ^ flip).astype(np.uint32)
    magnitude = np.minimum(np.abs(others) * (511 / _SQRT_HALF) + np.float32(0.5), 511).astype(np.uint32)
    part = (sign << np.uint32(9)) | magnitude
    shift = np.array([20, 10, 0], np.uint32)
    code = (largest[:, 0].astype(np.uint32) << np.uint32(30)) | np.bitwise_or.reduce(part << shift, axis=1)
    return code.astype("<u4").view(np.uint8).reshape(-1, 4)


def decode_quat_smallest_three(codes: Bytes) -> FloatArray:
    """Decode (N, 4) bytes to (N, 4) unit quaternions. Largest error: 0.35 degrees of rotation."""
    code = np.ascontiguousarray(codes).view("<u4")[:, 0]
    others = []
    for low in (20, 10, 0):
        magnitude = (code >> np.uint32(low) & np.uint32(511)).astype(np.float32) * (_SQRT_HALF / 511)
        others.append(np.where(code & np.uint32(512 << low), -magnitude, magnitude))
    return quat_of_others(code >> np.uint32(30), *others)


def quat_of_others(largest: NDArray[Any], a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return (N, 4) unit quaternions with components a b c, in order, and a positive one at index `largest`, (N,)."""
    square = a * a + b * b + c * c
    rest = np.sqrt(np.maximum(1 - square, 0))
    over = 1 / np.sqrt(np.maximum(square, 1))  # rounding may make a b c longer than 1
    quat = np.empty((len(a), 4), np.float32)
    quat[:, 0] = np.where(largest == 0, rest, a) * over
    quat[:, 1] = np.where(largest == 1, rest, np.where(largest < 1, a, b)) * over
    quat[:, 2] = np.where(largest == 2, rest, np.where(largest < 2, b, c)) * over
    quat[:, 3] = np.where(largest == 3, rest, c) * over
    return quat


def encode_quat_bytes(quat: FloatArray) -> Bytes:
    """Encode (N, 4) unit quaternions as (N, 4) bytes: 128 * c + 128 for each component c."""
    return _to_byte(quat * 128 + 128)


def decode_quat_bytes(codes: Bytes) -> FloatArray:
    """Decode (N, 4) bytes to unit quaternions. Largest error: 1.8 degrees of rotation."""
    return normalized_quat((codes.astype(np.float32) - 128) / 128)


def of_range(unit: FloatArray, low: Any, high: Any) -> FloatArray:
    """Map 0..1 to low..high as low + unit * (high - low), with the rounding of KSPLAT's and Spark's readers."""
    return low + unit * (high - low)


def between(unit: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Map 0..1 to low..high with the rounding of PlayCanvas's readers, which is exact at both ends."""
    return low * (1 - unit) + high * unit


def range_table(low: Any, high: Any, codes: int) -> NDArray[np.float64]:
    """Return the (..., codes) float64 values of codes 0..codes - 1, in equal steps from low to high, (...,)."""
    return np.ascontiguousarray(np.linspace(low, high, codes, axis=-1))


def _unorm(code: NDArray[np.uint32], low: int, bits: int) -> FloatArray:
    """Decode `bits` bits of words, from bit `low` up, to 0..1."""
    most = (1 << bits) - 1
    return (code >> np.uint32(low) & np.uint32(most)).astype(np.float32) / np.float32(most)


def decode_unorm_11_10_11(code: NDArray[np.uint32]) -> FloatArray:
    """Decode (N,) words to (N, 3) in 0..1, the first in the top bits. Largest error: half a step of each."""
    return np.stack([_unorm(code, 21, 11), _unorm(code, 11, 10), _unorm(code, 0, 11)], axis=1)


def decode_unorm_8888(code: NDArray[np.uint32]) -> FloatArray:
    """Decode (N,) words to (N, 4) in 0..1, the first in the top bits. Largest error: 1 / 510."""
    return np.stack([_unorm(code, low, 8) for low in (24, 16, 8, 0)], axis=1)


def decode_quat_2_10_10_10(code: NDArray[np.uint32]) -> FloatArray:
    """Decode (N,) words to (N, 4) unit quaternions w x y z.

    The upper 2 bits are the index of the largest component. The other components follow in order, each with 10 bits for
    -sqrt(1 / 2)..sqrt(1 / 2). Largest error: 0.28 degrees of rotation.
    """
    others = [(_unorm(code, low, 10) - np.float32(0.5)) * (2 * _SQRT_HALF) for low in (20, 10, 0)]
    return quat_of_others(code >> np.uint32(30), *others)


def decode_centred_8(codes: Bytes) -> FloatArray:
    """Decode bytes to the middles of 256 steps of -4..4, except 0 and 255 to -4 and 4. Largest error: 1 / 32."""
    unit = (np.arange(256) + 0.5) / 256
    unit[0], unit[255] = 0, 1
    return ((unit - 0.5) * 8).astype(np.float32)[codes]


#: Largest factor of an opacity that compensates for a lost area, somewhat more than rounding needs. A splat that loses
#: more is larger than any code, such as a sky: a higher opacity would not make it more similar.
MOST_GROWTH = 1.125

#: Smallest factor of an opacity, for splats smaller than any code, which stay visible in a pixel.
LEAST_GROWTH = 1 / 16

#: The smallest float32 above 1.
_ABOVE_1 = np.nextafter(np.float32(1), np.float32(2))


def faces(scale: FloatArray, blur: float) -> NDArray[np.float64]:
    """Return the (N,) sums of the products of two scales each, proportional to the mean projected area of a splat.

    Each scale is convolved with a blur, as a pixel does: a splat far thinner than a pixel covers as much as a thin one.
    """
    planes = np.array(scale.T, np.float64, order="C")
    planes *= planes
    planes += blur * blur
    x, y, z = np.sqrt(planes, out=planes)
    found: NDArray[np.float64] = x * y + x * z + y * z
    return found


def compensated(opacity: FloatArray, scale: FloatArray, rounded: FloatArray | None, blur: float) -> FloatArray:
    """Return (N,) linear opacities that compensate for the rounding of scales: splats cover as much as before.

    The code of a scale is off by 3 % or more, so that the area of a splat, and what it adds to a picture, changes by up
    to 7 % (docs/decisions/08-rounding.md). A splat of opacity A up to 1 covers A times its area, and its opacity stays
    at most 1. A merged splat of A above 1 covers H(A) times its area, where H are the harmonic numbers (see
    `model/falloff.py`), and its opacity stays above 1, since the falloff differs. If the scales are not rounded, the
    opacity stays the same to the last bit.

    Args:
        rounded: (N, 3) scales in the file; None for an SPZ file.
        blur: blur of `faces`, such as a step of positions, which is small for the splats of a scene.
    """
    area = faces(decode_log_scale(encode_log_scale(scale)) if rounded is None else rounded, blur)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(area > 0, np.clip(faces(scale, blur) / area, LEAST_GROWTH, MOST_GROWTH), 1)
    wide = opacity.astype(np.float64)
    grown = np.minimum(wide * ratio, 1)
    merged = np.flatnonzero(~(opacity <= 1))  # usually few
    most = wide[merged]
    covered = np.log(most) + EULER + (1 - EULER) / most  # H within 1.5 %, in a fraction of the time of `harmonic`
    slope = most / (most + 0.5)  # its derivative by ln(A), within 4 %
    grown[merged] = np.maximum(most * np.exp(covered * (ratio[merged] - 1) / slope), _ABOVE_1)
    return np.where(ratio == 1, opacity, grown).astype(np.float32)
