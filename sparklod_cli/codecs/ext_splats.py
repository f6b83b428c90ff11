"""ExtSplats, Spark's layout of 32 bytes per splat, with its arrays of spherical harmonics.

Words, rounding and clamping are those of the encoder in Spark 2.2.0's worker; its page on LoD rendering describes the
layout.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray, Splats
from ..system.threads import for_blocks
from . import spark_codings
from .spark_codings import STEPS_10_10_12, Words

SPLAT_0 = np.dtype(
    [
        ("center", "<f4", 3),  # 0: world units
        ("alpha", "<f2"),  # 12: opacity up to 1, above it (D + 3) / 4
        ("unused", "<u2"),  # 14: 0
    ]
)
SPLAT_1 = np.dtype(
    [
        ("rgb", "<f2", 3),  # 0: display-referred
        ("log_scale", "<f2", 3),  # 6: natural logarithms, minus infinity for a scale of 0
        ("rotation", "<u4"),  # 12: bits 0-9 and 10-19 u and v of the axis, -1..1; 20-31 the angle, 0..pi
    ]
)
assert SPLAT_0.itemsize == SPLAT_1.itemsize == 16

#: SH arrays, each of 4 words per splat, and the lowest degree that has them. A word is a coefficient; coefficients run
#: through the arrays in this order, and unused words at the end are 0.
SH_ARRAYS = {"sh1": 1, "sh2": 2, "sh3a": 3, "sh3b": 3}

#: Shared exponent of an SH coefficient's channels: stored plus this bias, and the largest stored exponent.
EXPONENT_BIAS, EXPONENT_MOST = 15, 31
#: Bit positions in a word of SH: byte of magnitude and sign of r, g and b, and the exponent.
_BITS = tuple((np.uint32(byte), np.uint32(sign)) for byte, sign in ((0, 24), (8, 25), (16, 26)))
_EXPONENT = np.uint32(27)


def pack(splats: Splats, *, threads: int = 1) -> dict[str, Words]:
    """Pack splats in Spark's layout: "ext0", "ext1" (N, 4) uint32, and by SH degree "sh1", "sh2", "sh3a", "sh3b".

    A colour of 65520 or more becomes infinite, as in Spark. The formulas are those of Spark's `encode_ext_splat` and
    `encode_ext_rgb`.
    """
    sh_names = _sh_names(splats.sh_degree)
    arrays = {name: np.zeros((len(splats), 4), np.uint32) for name in ("ext0", "ext1", *sh_names)}

    @np.errstate(over="ignore", divide="ignore")
    def encode(part: slice) -> None:
        first, second = arrays["ext0"][part].view(SPLAT_0)[:, 0], arrays["ext1"][part].view(SPLAT_1)[:, 0]
        first["center"] = splats.center[part]
        first["alpha"] = spark_codings.encode_lod_alpha(splats.opacity[part])
        second["rgb"] = splats.rgb[part]
        # Rounded to float32 first, as in Spark, which decides ties.
        second["log_scale"] = np.log(splats.scale[part].astype(np.float64)).astype(np.float32)
        u, v, angle = spark_codings.encode_axis_angle(splats.quat_xyzw[part], STEPS_10_10_12)
        second["rotation"] = u | v << np.uint32(10) | angle << np.uint32(20)
        words = encode_sh(splats.sh[part])
        for index, name in enumerate(sh_names):
            some = words[:, 4 * index : 4 * index + 4]
            arrays[name][part, : some.shape[1]] = some

    for_blocks(encode, len(splats), threads)
    return arrays


def unpack(arrays: Mapping[str, NDArray[Any]], *, threads: int = 1) -> Splats:
    """Return the splats of the arrays of `pack`; the SH arrays present determine the degree.

    Largest errors, apart from that of float32:

    - center: exact.
    - scale: a factor of e ** (2 ** -11 * abs(ln(scale))), at most 0.4 % from e ** -16 to e ** 16; exact for 0.
    - quat_xyzw: 0.476 degrees of rotation.
    - opacity: 2 ** -11 of itself, or 2 ** -25 if that is more; above 1, 2 ** -9 of D.
    - rgb: 2 ** -11 of each channel, or 2 ** -25 if that is more.
    - sh: see `decode_sh`.

    Raises:
        FormatError: an array is missing, or has another shape or type.
    """
    degree = max((degree for name, degree in SH_ARRAYS.items() if name in arrays), default=0)
    sh_names = _sh_names(degree)
    found = spark_codings.checked_words(arrays, dict.fromkeys(("ext0", "ext1", *sh_names), 4))
    first, second = found["ext0"].view(SPLAT_0)[:, 0], found["ext1"].view(SPLAT_1)[:, 0]
    splats = Splats.empty(len(first), degree)

    @np.errstate(over="ignore", invalid="ignore")  # arbitrary words may overflow
    def decode(part: slice) -> None:
        splats.center[part] = first["center"][part]
        splats.opacity[part] = spark_codings.decode_lod_alpha(first["alpha"][part].astype(np.float32))
        splats.rgb[part] = second["rgb"][part]
        splats.scale[part] = np.exp(second["log_scale"][part].astype(np.float64))
        rotation = second["rotation"][part]
        u, v = rotation & np.uint32(1023), rotation >> np.uint32(10) & np.uint32(1023)
        splats.quat_xyzw[part] = spark_codings.decode_axis_angle(u, v, rotation >> np.uint32(20), STEPS_10_10_12)
        for index, name in enumerate(sh_names):
            some = splats.sh[part, 4 * index : 4 * index + 4]
            some[:] = decode_sh(found[name][part, : some.shape[1]])

    for_blocks(decode, len(splats), threads)
    return splats


def _sh_names(degree: int) -> list[str]:
    return [name for name, least in SH_ARRAYS.items() if least <= degree]


def encode_sh(sh: FloatArray) -> Words:
    """Encode (N, K, 3) SH as (N, K) words: a byte of magnitude and a sign per channel, and a shared exponent.

    The exponent is that of the largest channel rounded down, between -15 and 16, and the bytes are 0..2 ** exponent in
    255 steps. So a magnitude above that power of two is clamped to it, which loses up to half of the largest channel.
    Spark does the same.
    """
    channels = np.ascontiguousarray(np.moveaxis(sh, 2, 0))
    magnitudes = np.abs(channels)
    with np.errstate(divide="ignore"):
        log = np.log2(magnitudes.max(axis=0).astype(np.float64)).astype(np.float32)
    exponent = np.clip(np.floor(log) + EXPONENT_BIAS, 0, EXPONENT_MOST).astype(np.int32)
    step = np.ldexp(np.float32(1), exponent - EXPONENT_BIAS) / np.float32(255)
    words = exponent.astype(np.uint32) << _EXPONENT
    for channel, magnitude, (byte, sign) in zip(channels, magnitudes, _BITS, strict=True):
        words |= spark_codings.to_code(magnitude / step, 255) << byte
        words |= (channel < 0).astype(np.uint32) << sign
    return words


def decode_sh(words: Words) -> FloatArray:
    """Decode (N, K) words to (N, K, 3) SH coefficients.

    Largest error: let m be the largest channel of a coefficient, between 2 ** -15 and 2 ** 17, and p the power of two
    not above it. A channel up to p is off by at most p / 510; one above p becomes p, which is off by less than m / 2.
    """
    step = np.ldexp(np.float32(1), (words >> _EXPONENT).astype(np.int32) - EXPONENT_BIAS) / np.float32(255)
    sh = np.empty((*words.shape, 3), np.float32)
    for channel, (byte, sign) in enumerate(_BITS):
        magnitude = (words >> byte & np.uint32(255)).astype(np.float32) * step
        sh[..., channel] = np.where(words >> sign & np.uint32(1), -magnitude, magnitude)
    return sh
