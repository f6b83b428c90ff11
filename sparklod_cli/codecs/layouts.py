"""Layouts of splats in the memory of viewers, and files of arrays (.npz, .npy, or numbers without a header).

PackedSplats, ExtSplats and LodTree are those of Spark; its pages about PackedSplats and LoD rendering describe them.
Words, rounding and clamping are those of the encoders in Spark 2.2.0's worker (`encode_packed_splat`, `encode_sh1` to
`encode_sh3`, `encode_ext_splat`, `encode_ext_rgb`), with one exception: a scale between 0 and e ** -30 becomes 0 here,
as in Spark's documentation and its JavaScript, and e ** -12 in its worker. The data texture is that of antimatter15's
viewer and its descendants.
"""

from __future__ import annotations

import io
import math
import os
import tokenize
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from ..model.gaussian import covariance, spark_size
from ..model.lod_tree import MAX_CHILDREN, LodTree
from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..system.errors import FormatError, TruncatedError
from ..system.threads import for_blocks
from ..system.units import count_of
from ..system.untrusted import quoted, quoted_value
from . import quantize, spark_codings
from .merging import ZIP_ERRORS
from .spark_codings import DEFAULT, STEPS_8_8_8, STEPS_10_10_12, SplatEncoding, Words
from .spark_nodes import Nodes

Arrays = dict[str, NDArray[Any]]


def pack_layout(scene: Scene, encoding: str, threads: int = 1) -> Arrays:
    """Pack a scene in one of `formats.ENCODINGS`, see docs/formats/memory.md: uint32 arrays by name.

    Raises ValueError if the encoding is that of a tree and the scene has none.
    """
    if encoding == "packed":
        return pack_packed(scene.splats, SplatEncoding(lod_opacity=scene.tree is not None), threads=threads)
    if encoding == "ext":
        return pack_ext(scene.splats, threads=threads)
    if encoding == "texture":  # it has no room for the children of a tree
        return pack_texture(scene.splats, threads=threads)
    if scene.tree is None:
        raise ValueError("the scene has no tree")
    return pack_nodes(scene.splats, scene.tree, threads=threads)


def _checked(arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Words]:
    """Check that arrays are uint32, have rows of given shapes, and as many rows each; return them C-contiguous.

    Raises `FormatError` if an array is missing, or has another shape or type.
    """
    checked = {}
    rows: int | None = None
    for name, shape in shapes.items():
        array = arrays.get(name)
        if array is None:
            raise FormatError(f"there is no array {name}, only {', '.join(arrays) or 'none'}")
        rows = len(array) if rows is None and array.ndim else rows
        if array.dtype != np.uint32 or array.shape != (rows, *shape):
            expected = ", ".join(map(str, ("N" if rows is None else rows, *shape)))
            raise FormatError(f"{name} is {array.dtype}{list(array.shape)}, expected uint32[{expected}]")
        checked[name] = np.ascontiguousarray(array)
    return checked


# PackedSplats: 16 bytes per splat.

PACKED = np.dtype(
    [
        ("rgb", "u1", 3),  # 0: rgb_min..rgb_max in 255 steps
        ("alpha", "u1"),  # 3: opacity 0..1 in 255 steps, or 0..2 where the encoding has lod_opacity
        ("center", "<f2", 3),  # 4: world units
        ("axis", "u1", 2),  # 10: of the rotation, u and v on the octahedron, -1..1 in 255 steps
        ("log_scale", "u1", 3),  # 12: 0 for a scale of 0, else 1 + ln_scale_min..ln_scale_max in 254 steps
        ("angle", "u1"),  # 15: of the rotation, 0..pi in 255 steps
    ]
)
assert PACKED.itemsize == 16

#: Words per splat and bits per number of the SH arrays of degree 1 to 3. The 3 * (2 * degree + 1) numbers, coefficient
#: by coefficient with r g b innermost, are packed bit by bit in two's complement: -sh_max..sh_max in 2 ** bits - 2
#: steps.
SH_WORDS = {1: 2, 2: 4, 3: 4}
SH_BITS = {1: 7, 2: 8, 3: 6}


def pack_packed(splats: Splats, encoding: SplatEncoding = DEFAULT, *, threads: int = 1) -> dict[str, Words]:
    """Pack splats as PackedSplats: "packed" (N, 4) uint32, and by degree "sh1" (N, 2), "sh2" and "sh3" (N, 4).

    Values are clamped to the ranges of their codes; a coordinate of 65520 or more becomes infinite, as in Spark.
    """
    degrees = range(1, splats.sh_degree + 1)
    arrays = {"packed": np.empty((len(splats), 4), np.uint32)}
    arrays |= {f"sh{degree}": np.empty((len(splats), SH_WORDS[degree]), np.uint32) for degree in degrees}

    @np.errstate(over="ignore")
    def encode(part: slice) -> None:
        rows = arrays["packed"][part].view(PACKED)[:, 0]
        rows["rgb"] = spark_codings.encode_linear(splats.rgb[part], encoding.rgb_min, encoding.rgb_max)
        opacity = splats.opacity[part]
        alpha = spark_codings.encode_lod_alpha(opacity) if encoding.lod_opacity else opacity
        rows["alpha"] = spark_codings.encode_linear(alpha, 0, encoding.alpha_max)
        rows["center"] = splats.center[part]
        rows["log_scale"] = spark_codings.encode_log_scale(
            splats.scale[part], encoding.ln_scale_min, encoding.ln_scale_max
        )
        u, v, rows["angle"] = spark_codings.encode_axis_angle(splats.quat_xyzw[part], STEPS_8_8_8)
        rows["axis"][:, 0], rows["axis"][:, 1] = u, v
        for degree in degrees:
            sh = splats.sh[part, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]].reshape(len(rows), -1)
            arrays[f"sh{degree}"][part] = _encode_packed_sh(sh, SH_BITS[degree], encoding.sh_max(degree))

    for_blocks(encode, len(splats), threads)
    return arrays


def unpack_packed(arrays: Mapping[str, NDArray[Any]], encoding: SplatEncoding = DEFAULT, *, threads: int = 1) -> Splats:
    """Unpack PackedSplats; arrays of SH may be missing from the highest degree down.

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
    words = _checked(arrays, {"packed": (4,)} | {f"sh{degree}": (SH_WORDS[degree],) for degree in present})
    packed = words["packed"].view(PACKED)[:, 0]
    splats = Splats.empty(len(packed), len(present))
    scales = spark_codings.log_scale_table(encoding.ln_scale_min, encoding.ln_scale_max)

    def decode(part: slice) -> None:
        rows = packed[part]
        splats.center[part] = rows["center"]
        splats.rgb[part] = spark_codings.decode_linear(rows["rgb"], encoding.rgb_min, encoding.rgb_max)
        alpha = spark_codings.decode_linear(rows["alpha"], 0, encoding.alpha_max)
        splats.opacity[part] = spark_codings.decode_lod_alpha(alpha)
        splats.scale[part] = scales[rows["log_scale"]]
        u, v = rows["axis"].T
        splats.quat_xyzw[part] = spark_codings.decode_axis_angle(u, v, rows["angle"], STEPS_8_8_8)
        for degree in present:
            bits, numbers = SH_BITS[degree], 3 * (2 * degree + 1)
            sh = _decode_packed_sh(words[f"sh{degree}"][part], bits, encoding.sh_max(degree), numbers)
            splats.sh[part, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]] = sh.reshape(len(rows), -1, 3)

    for_blocks(decode, len(splats), threads)
    return splats


def _encode_packed_sh(values: FloatArray, bits: int, most: np.float32) -> Words:
    """Encode (N, numbers) SH, clamped to -most..most, as (N, words), `bits` bits each in two's complement."""
    top = np.float32(2 ** (bits - 1) - 1)
    steps = np.clip(values * (top / most), -top, top)
    steps = np.trunc(steps + np.copysign(spark_codings.ALMOST_HALF, steps))  # ties go away from zero, as in Rust
    codes = steps.astype(np.int32).view(np.uint32) & np.uint32(2**bits - 1)
    words = np.zeros((-(-codes.shape[1] * bits // 32), len(codes)), np.uint32)
    for index, column in enumerate(np.ascontiguousarray(codes.T)):
        word, offset = divmod(index * bits, 32)
        words[word] |= column << np.uint32(offset)
        if offset + bits > 32:
            words[word + 1] |= column >> np.uint32(32 - offset)
    return words.T


def _decode_packed_sh(words: Words, bits: int, most: np.float32, numbers: int) -> FloatArray:
    """Decode (N, words) to (N, numbers) SH of -most..most. Largest error: most / (2 ** bits - 2)."""
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


# ExtSplats: 32 bytes per splat.

EXT_0 = np.dtype(
    [
        ("center", "<f4", 3),  # 0: world units
        ("alpha", "<f2"),  # 12: opacity up to 1, above it (D + 3) / 4
        ("unused", "<u2"),  # 14: 0
    ]
)
EXT_1 = np.dtype(
    [
        ("rgb", "<f2", 3),  # 0: display-referred
        ("log_scale", "<f2", 3),  # 6: natural logarithms, minus infinity for a scale of 0
        ("rotation", "<u4"),  # 12: bits 0-9 and 10-19 u and v of the axis, -1..1; 20-31 the angle, 0..pi
    ]
)
assert EXT_0.itemsize == EXT_1.itemsize == 16

#: SH arrays, each of 4 words per splat, and the lowest degree that has them. A word is a coefficient; coefficients run
#: through the arrays in this order, and unused words at the end are 0.
SH_ARRAYS = {"sh1": 1, "sh2": 2, "sh3a": 3, "sh3b": 3}

#: Shared exponent of an SH coefficient's channels: stored plus this bias, and the largest stored exponent.
EXPONENT_BIAS, EXPONENT_MOST = 15, 31
#: Bit positions in a word of SH: byte of magnitude and sign of r, g and b, and the exponent.
_BITS = tuple((np.uint32(byte), np.uint32(sign)) for byte, sign in ((0, 24), (8, 25), (16, 26)))
_EXPONENT = np.uint32(27)


def pack_ext(splats: Splats, *, threads: int = 1) -> dict[str, Words]:
    """Pack splats as ExtSplats: "ext0", "ext1", and by SH degree "sh1", "sh2", "sh3a", "sh3b", (N, 4) uint32 each.

    A colour of 65520 or more becomes infinite, as in Spark.
    """
    sh_names = [name for name, least in SH_ARRAYS.items() if least <= splats.sh_degree]
    arrays = {name: np.zeros((len(splats), 4), np.uint32) for name in ("ext0", "ext1", *sh_names)}

    @np.errstate(over="ignore", divide="ignore")
    def encode(part: slice) -> None:
        first, second = arrays["ext0"][part].view(EXT_0)[:, 0], arrays["ext1"][part].view(EXT_1)[:, 0]
        first["center"] = splats.center[part]
        first["alpha"] = spark_codings.encode_lod_alpha(splats.opacity[part])
        second["rgb"] = splats.rgb[part]
        # Rounded to float32 first, as in Spark, which decides ties.
        second["log_scale"] = spark_codings.nearest_log(splats.scale[part])
        u, v, angle = spark_codings.encode_axis_angle(splats.quat_xyzw[part], STEPS_10_10_12)
        second["rotation"] = u | v << np.uint32(10) | angle << np.uint32(20)
        words = encode_ext_sh(splats.sh[part])
        for index, name in enumerate(sh_names):
            columns = words[:, 4 * index : 4 * index + 4]
            arrays[name][part, : columns.shape[1]] = columns

    for_blocks(encode, len(splats), threads)
    return arrays


def unpack_ext(arrays: Mapping[str, NDArray[Any]], *, threads: int = 1) -> Splats:
    """Unpack ExtSplats; the SH arrays that are present determine the degree.

    Largest errors, apart from that of float32:

    - center: exact.
    - scale: a factor of e ** (2 ** -11 * abs(ln(scale))), at most 0.4 % from e ** -16 to e ** 16; exact for 0.
    - quat_xyzw: 0.476 degrees of rotation.
    - opacity: 2 ** -11 of itself, or 2 ** -25 if that is more; above 1, 2 ** -9 of D.
    - rgb: 2 ** -11 of each channel, or 2 ** -25 if that is more.
    - sh: let m be the largest channel of a coefficient, between 2 ** -15 and 2 ** 17, and p the power of two not above
      it. A channel up to p is off by at most p / 510; one above p becomes p, which is off by less than m / 2.

    Raises:
        FormatError: an array is missing, or has another shape or type.
    """
    degree = max((degree for name, degree in SH_ARRAYS.items() if name in arrays), default=0)
    sh_names = [name for name, least in SH_ARRAYS.items() if least <= degree]
    words = _checked(arrays, dict.fromkeys(("ext0", "ext1", *sh_names), (4,)))
    first, second = words["ext0"].view(EXT_0)[:, 0], words["ext1"].view(EXT_1)[:, 0]
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
            sh = splats.sh[part, 4 * index : 4 * index + 4]
            sh[:] = _decode_ext_sh(words[name][part, : sh.shape[1]])

    for_blocks(decode, len(splats), threads)
    return splats


def encode_ext_sh(sh: FloatArray) -> Words:
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


def _decode_ext_sh(words: Words) -> FloatArray:
    """Decode (N, K) words to (N, K, 3) SH coefficients."""
    step = np.ldexp(np.float32(1), (words >> _EXPONENT).astype(np.int32) - EXPONENT_BIAS) / np.float32(255)
    sh = np.empty((*words.shape, 3), np.float32)
    for channel, (byte, sign) in enumerate(_BITS):
        magnitude = (words >> byte & np.uint32(255)).astype(np.float32) * step
        sh[..., channel] = np.where(words >> sign & np.uint32(1), -magnitude, magnitude)
    return sh


# LodTree: 16 bytes per node.

NODE = np.dtype(
    [
        ("center", "<f2", 3),  # 0: world units; x | y << 16 in word 0, z in word 1
        ("size", "<f2"),  # 6: world units, see `spark_size`; the upper half of word 1
        ("child_count", "<u4"),  # 8: 0 for a leaf; a uint16, the upper half of word 2 is 0
        ("child_start", "<u4"),  # 12: index of the first child, 0 for a leaf
    ]
)
assert NODE.itemsize == 16


def pack_nodes(splats: Splats, tree: LodTree, *, threads: int = 1) -> dict[str, Words]:
    """Pack splats and their tree as Spark's traversal reads them: "lod_tree" (N, 4) uint32.

    Spark measures splats after their coding: for the same words as Spark's, pass splats that were packed and unpacked
    as ExtSplats or PackedSplats. A coordinate or a size of 65520 or more becomes infinite, as in Spark.

    Raises:
        FormatError: the numbers of nodes and splats differ.
    """
    if len(tree) != len(splats):
        raise FormatError(f"{len(tree):,} nodes, but {len(splats):,} splats")
    words = np.empty((len(splats), 4), np.uint32)

    @np.errstate(over="ignore")
    def encode(part: slice) -> None:
        rows = words[part].view(NODE)[:, 0]
        rows["center"] = splats.center[part]
        rows["size"] = spark_size(splats.take(part))
        rows["child_count"] = tree.child_count[part]
        rows["child_start"] = tree.child_start[part]

    for_blocks(encode, len(splats), threads)
    return {"lod_tree": words}


def unpack_nodes(arrays: Mapping[str, NDArray[Any]]) -> Nodes:
    """Unpack the nodes of a LodTree.

    Largest errors: 2 ** -11 of each coordinate and of the size, or 2 ** -25 if that is more; children are exact.

    Raises:
        FormatError: the array is missing or has another shape or type, or a node has more children than a uint16 holds.
    """
    rows = _checked(arrays, {"lod_tree": (4,)})["lod_tree"].view(NODE)[:, 0]
    child_count = rows["child_count"]
    if child_count.max(initial=0) > MAX_CHILDREN:
        node = int(np.argmax(child_count > MAX_CHILDREN))
        raise FormatError(f"node {node} has {child_count[node]:,} children, a uint16 holds at most {MAX_CHILDREN:,}")
    tree = LodTree(child_count.astype(np.uint16), rows["child_start"].copy())
    return Nodes(rows["center"].astype(np.float32), rows["size"].astype(np.float32), tree)


# Data texture: RGBA32UI, 2048 texels wide, 2 texels per splat.

WIDTH = 2048
SPLATS_A_ROW = WIDTH // 2

TEXELS = np.dtype(
    [
        ("center", "<f4", 3),  # 0: world units, in x y z of texel 2i
        ("unused", "<u4"),  # 12: 0
        ("covariance", "<f2", 6),  # 16: 4 * (xx xy | xz yy | yz zz), in x y z of texel 2i + 1; world units squared
        ("rgba", "u1", 4),  # 28: 0..1 in 255 steps, in its w
    ]
)
assert TEXELS.itemsize == 32

#: Factor of the covariance in the texture, and the largest float16, which bounds the product.
GAIN, LARGEST = 4, 65504


def pack_texture(splats: Splats, *, threads: int = 1) -> dict[str, Words]:
    """Pack splats as the viewer uploads them: "texture" (H, 2048, 4) uint32, H = ceil(N / 1024), at least 1.

    The viewer multiplies M^T M with M = diag(scale) R. Its R, by rows, is the transpose of the matrix that turns local
    into world axes, so that M^T M is the covariance A diag(scale ** 2) A^T with A local to world, as here.

    Colour and opacity are clamped to 0..1; SH is left out. A splat wider than float16 can express, 127.97 standard
    deviations in world units along an axis, is shrunk to that without changing its shape; the viewer's own would be
    infinite. float16s are rounded to the nearest and rotations are not quantized, where the viewer truncates both.
    """
    texture = np.zeros((max(1, -(-len(splats) // SPLATS_A_ROW)), WIDTH, 4), np.uint32)
    texels = texture.reshape(-1, 8).view(TEXELS)[:, 0]

    @np.errstate(over="ignore")
    def encode(part: slice) -> None:
        rows = texels[part]
        rows["center"] = splats.center[part]
        stored = GAIN * covariance(splats.scale[part], splats.quat_xyzw[part])  # the largest element is on the diagonal
        rows["covariance"] = stored * (LARGEST / np.maximum(stored.max(axis=1, keepdims=True), LARGEST))
        # 0..1 to a byte: ties to even, as the viewer's clamped array rounds.
        rows["rgba"][:, :3] = quantize.encode_unorm8(splats.rgb[part])
        rows["rgba"][:, 3] = quantize.encode_unorm8(splats.opacity[part])

    for_blocks(encode, len(splats), threads)
    return {"texture": texture}


def texture_capacity(arrays: Mapping[str, NDArray[Any]]) -> int:
    """Return how many splats fit into a texture; raises `FormatError` if it is missing or has another shape or type."""
    return len(_checked(arrays, {"texture": (WIDTH, 4)})["texture"]) * SPLATS_A_ROW


# Files of arrays.

#: Largest header of a .npy file, bytes; that of a two-dimensional array has 118.
MAX_HEADER = 1 << 12

_READERS = {
    (1, 0): npy_format.read_array_header_1_0,
    (2, 0): npy_format.read_array_header_2_0,
    (3, 0): npy_format.read_array_header_2_0,  # version 3 differs in the names of records only, which are refused
}


@dataclass(frozen=True)
class ArrayLayout:
    """Shape and type of an array in a file, and whether its first index runs fastest."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran_order: bool = False


def read_layout(file: BinaryIO) -> ArrayLayout | None:
    """Read the header of a .npy file and stop at its numbers; return None, at the beginning, for another file.

    Raises:
        FormatError: the header is not that of an array of plain numbers; the text continues a sentence about the file.
    """
    file.seek(0)
    is_npy = file.read(len(npy_format.MAGIC_PREFIX)) == npy_format.MAGIC_PREFIX
    file.seek(0)
    if not is_npy:
        return None
    try:
        version = npy_format.read_magic(file)
        if version not in _READERS:
            raise FormatError("is a .npy file of an unknown version")
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # about former names of types
            shape, fortran_order, dtype = _READERS[version](file, max_header_size=MAX_HEADER)
    except (Warning, ValueError, TypeError, SyntaxError, RecursionError, MemoryError, tokenize.TokenError):
        raise FormatError("is not a .npy file of plain numbers: its header is malformed") from None
    if dtype.kind not in "biufc" or min(shape, default=0) < 0:
        raise FormatError(f"is not a .npy file of plain numbers: its header says {dtype} {shape}")
    return ArrayLayout(shape, dtype, fortran_order)


def read_values(file: BinaryIO, layout: ArrayLayout) -> NDArray[Any]:
    """Read the array at the current position of a file; raises `TruncatedError`, see `read_layout`."""
    size = math.prod(layout.shape) * layout.dtype.itemsize
    data = file.read(size)
    if len(data) < size:
        raise TruncatedError(f"ends {size - len(data):,} bytes before its last number")
    values: NDArray[Any] = np.frombuffer(data, layout.dtype)
    return values.reshape(layout.shape, order="F" if layout.fortran_order else "C")


def decode_rgba(file: BinaryIO, count: int, rows: slice | None = None) -> FloatArray:
    """Read colours and opacities for the `count` splats of a scene, or for a range: (n, 4) float32, 0..1.

    The size of a raw file determines its type.

    Raises:
        FormatError: the format, length or values are wrong; the text continues a sentence about the file.
    """
    layout = read_layout(file)
    if layout is None:
        size = os.fstat(file.fileno()).st_size
        if size != 16 * count and size % 4:
            raise FormatError(f"has {size:,} bytes, which are not four a splat")
        is_float = size == 16 * count
        layout = ArrayLayout((count if is_float else size // 4, 4), np.dtype("<f4" if is_float else np.uint8))
    shape, dtype = layout.shape, layout.dtype
    if len(shape) != 2 or shape[1] != 4 or (dtype != np.uint8 and dtype.kind != "f"):
        raise FormatError(f"has {dtype}{list(shape)}, expected uint8 or floats [{count}, 4]")
    if shape[0] != count:
        raise FormatError(f"has colours for {count_of(shape[0], 'splat')}, the scene has {count:,}")
    if rows is not None and not layout.fortran_order:
        file.seek(rows.start * 4 * dtype.itemsize, os.SEEK_CUR)
        layout, rows = ArrayLayout((rows.stop - rows.start, 4), dtype), None
    values = read_values(file, layout)[rows or slice(None)]
    most = 255 if values.dtype == np.uint8 else 1
    if not ((values >= 0) & (values <= most)).all():
        raise FormatError("has values that are not 0..1")
    return np.ascontiguousarray(values, np.float32) / np.float32(most)


def encode_arrays(arrays: Arrays, *, raw: bool = False) -> Iterator[bytes]:
    """Encode arrays as a .npz file, the same bytes for the same arrays; or, if `raw`, as little-endian words alone."""
    if raw:
        yield from (words.astype("<u4", copy=False).tobytes() for words in arrays.values())
        return
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    yield file.getvalue()


def decode_npz(file: BinaryIO) -> Arrays | None:
    """Read the arrays of a .npz file; None if the file is something else.

    Raises `FormatError` if an array is compressed, cut short or holds something else than plain numbers.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            if not members or not all(member.filename.endswith(".npy") for member in members):
                return None
            return {member.filename.removesuffix(".npy"): _member(archive, member) for member in members}
    except ZIP_ERRORS:
        return None


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    # Stored members cannot claim more than the file has; compressed ones could, and convert writes none.
    if member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
        raise FormatError(f"its member {quoted_value(member.filename)} is compressed, unlike those of convert --layout")
    try:
        with archive.open(member) as file:
            data = io.BytesIO(file.read())
        layout = read_layout(data)
        if layout is None:
            raise FormatError("is not a .npy file")
        return read_values(data, layout)
    except (*ZIP_ERRORS, OSError) as error:
        raise FormatError(f"its member {quoted_value(member.filename)} is damaged: {quoted(error)}") from None
    except FormatError as error:
        raise type(error)(f"its member {quoted_value(member.filename)} {error}") from None
