"""PackedSplats, Spark's layout of 16 bytes per splat, with its arrays of spherical harmonics.

Words, rounding and clamping are those of the encoder in Spark 2.2.0's worker, with one exception: a scale between 0 and
e ** -30 becomes 0 here, as in Spark's documentation and its JavaScript, and e ** -12 in its worker.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..system.errors import FormatError
from ..system.threads import for_blocks
from . import spark_codings
from .spark_codings import (
    DEFAULT,
    STEPS_8_8_8,
    SplatEncoding,
    Words,
    decode_linear,
    encode_linear,
    encode_log_scale,
    log_scale_table,
)

SPLAT = np.dtype(
    [
        ("rgb", "u1", 3),  # 0: rgb_min..rgb_max in 255 steps
        ("alpha", "u1"),  # 3: opacity 0..1 in 255 steps, or 0..2 where the encoding has lod_opacity
        ("center", "<f2", 3),  # 4: world units
        ("axis", "u1", 2),  # 10: of the rotation, u and v on the octahedron, -1..1 in 255 steps
        ("log_scale", "u1", 3),  # 12: 0 for a scale of 0, else 1 + ln_scale_min..ln_scale_max in 254 steps
        ("angle", "u1"),  # 15: of the rotation, 0..pi in 255 steps
    ]
)
assert SPLAT.itemsize == 16

#: Words per splat and bits per number of the SH arrays of degree 1 to 3. The 3 * (2 * degree + 1) numbers, coefficient
#: by coefficient with r g b innermost, are packed bit by bit in two's complement: -sh_max..sh_max in 2 ** bits - 2
#: steps.
SH_WORDS = {1: 2, 2: 4, 3: 4}
SH_BITS = {1: 7, 2: 8, 3: 6}


def of_scene(scene: Scene) -> SplatEncoding:
    """Return the encoding that Spark sets up for a scene: an LoD tree has LoD opacities."""
    return SplatEncoding(lod_opacity=scene.tree is not None)


def pack(splats: Splats, encoding: SplatEncoding = DEFAULT, *, threads: int = 1) -> dict[str, Words]:
    """Pack splats in Spark's layout: "packed" (N, 4) uint32, and by degree "sh1" (N, 2), "sh2" and "sh3" (N, 4).

    Values are clamped to the ranges of their codes; a coordinate of 65520 or more becomes infinite, as in Spark. The
    formulas are those of Spark's `encode_packed_splat` and `encode_sh1` to `encode_sh3`, described on its page about
    PackedSplats.
    """
    degrees = range(1, splats.sh_degree + 1)
    arrays = {"packed": np.empty((len(splats), 4), np.uint32)}
    arrays |= {f"sh{degree}": np.empty((len(splats), SH_WORDS[degree]), np.uint32) for degree in degrees}
    log_range = encoding.ln_scale_min, encoding.ln_scale_max

    @np.errstate(over="ignore")
    def encode(part: slice) -> None:
        rows = arrays["packed"][part].view(SPLAT)[:, 0]
        rows["rgb"] = encode_linear(splats.rgb[part], encoding.rgb_min, encoding.rgb_max)
        opacity = splats.opacity[part]
        alpha = spark_codings.encode_lod_alpha(opacity) if encoding.lod_opacity else opacity
        rows["alpha"] = encode_linear(alpha, 0, encoding.alpha_max)
        rows["center"] = splats.center[part]
        rows["log_scale"] = encode_log_scale(splats.scale[part], *log_range)
        u, v, rows["angle"] = spark_codings.encode_axis_angle(splats.quat_xyzw[part], STEPS_8_8_8)
        rows["axis"][:, 0], rows["axis"][:, 1] = u, v
        for degree in degrees:
            sh = splats.sh[part, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]].reshape(len(rows), -1)
            arrays[f"sh{degree}"][part] = encode_sh(sh, SH_BITS[degree], encoding.sh_max(degree))

    for_blocks(encode, len(splats), threads)
    return arrays


def unpack(arrays: Mapping[str, NDArray[Any]], encoding: SplatEncoding = DEFAULT, *, threads: int = 1) -> Splats:
    """Return the splats of the arrays of `pack`; arrays of SH may be missing from the highest degree down.

    Largest errors inside the ranges, apart from that of float32:

    - center: 2 ** -11 of each coordinate, or 2 ** -25 if that is more.
    - scale: a factor of e ** ((ln_scale_max - ln_scale_min) / 508), 4.3 %; exact for 0.
    - quat_xyzw: 1.94 degrees of rotation.
    - opacity: 1 / 510; with lod_opacity 1 / 255, and from 1 on 4 / 255 of D.
    - rgb: (rgb_max - rgb_min) / 510.
    - sh: sh1_max / 126, sh2_max / 254 and sh3_max / 62.

    Raises:
        FormatError: an array is missing, or has another shape or type.
    """
    present = tuple(degree for degree in SH_WORDS if f"sh{degree}" in arrays)
    if present != tuple(range(1, len(present) + 1)):
        raise FormatError(f"SH arrays of degree {present}, but not of all lower degrees")
    found = spark_codings.checked_words(arrays, {"packed": 4} | {f"sh{degree}": SH_WORDS[degree] for degree in present})
    packed = found["packed"].view(SPLAT)[:, 0]
    splats = Splats.empty(len(packed), len(present))
    scales = log_scale_table(encoding.ln_scale_min, encoding.ln_scale_max)

    def decode(part: slice) -> None:
        rows = packed[part]
        splats.center[part] = rows["center"]
        splats.rgb[part] = decode_linear(rows["rgb"], encoding.rgb_min, encoding.rgb_max)
        alpha = decode_linear(rows["alpha"], 0, encoding.alpha_max)
        splats.opacity[part] = spark_codings.decode_lod_alpha(alpha)
        splats.scale[part] = scales[rows["log_scale"]]
        u, v = rows["axis"].T
        splats.quat_xyzw[part] = spark_codings.decode_axis_angle(u, v, rows["angle"], STEPS_8_8_8)
        for degree in present:
            sh = decode_sh(found[f"sh{degree}"][part], SH_BITS[degree], encoding.sh_max(degree), 3 * (2 * degree + 1))
            splats.sh[part, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]] = sh.reshape(len(rows), -1, 3)

    for_blocks(decode, len(splats), threads)
    return splats


def encode_sh(values: FloatArray, bits: int, most: np.float32) -> Words:
    """Encode (N, numbers) SH, clamped to -most..most, as (N, words), `bits` bits each in two's complement."""
    top = np.float32(2 ** (bits - 1) - 1)
    steps = np.clip(values * (top / most), -top, top)
    codes = spark_codings.round_half_away(steps).astype(np.int32).view(np.uint32) & np.uint32(2**bits - 1)
    words = np.zeros((-(-codes.shape[1] * bits // 32), len(codes)), np.uint32)
    for index, column in enumerate(np.ascontiguousarray(codes.T)):
        word, offset = divmod(index * bits, 32)
        words[word] |= column << np.uint32(offset)
        if offset + bits > 32:
            words[word + 1] |= column >> np.uint32(32 - offset)
    return words.T


def decode_sh(words: Words, bits: int, most: np.float32, numbers: int) -> FloatArray:
    """Decode (N, words) to (N, numbers), the inverse of `encode_sh`. Largest error: most / (2 ** bits - 2)."""
    columns = np.ascontiguousarray(words.T)
    codes = np.empty((numbers, len(words)), np.uint32)
    for index in range(numbers):
        word, offset = divmod(index * bits, 32)
        codes[index] = columns[word] >> np.uint32(offset)
        if offset + bits > 32:
            codes[index] |= columns[word + 1] << np.uint32(32 - offset)
    unused = np.int32(32 - bits)
    signed = codes.view(np.int32) << unused >> unused  # an arithmetic shift extends the sign
    return signed.T.astype(np.float32) * (most / np.float32(2 ** (bits - 1) - 1))
