"""Properties of RAD's chunks, and their encodings: pairs of encode and decode of a whole column of a chunk.

A column is stored number by number: all x, then all y, then all z. The formulas are those of Spark 2.2.0's `rad.rs`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...model.splats import FloatArray
from ...system.threads import blocks_of
from .. import spark_codings
from ..formats import RAD_ENCODINGS
from ..quantize import Bytes
from ..spark_codings import STEPS_8_8_8

#: Compression of properties: a raw deflate stream, despite its name.
GZ = "gz"

#: Largest finite float16, to which larger values are clamped; and the largest one whose exponential float32 holds.
LARGEST_F16, LARGEST_LOG_F16 = np.float32(65504), np.float16(88.6875)

#: Splats that are coded at a time, with their intermediate results in the processor's cache.
BLOCK = 1 << 13

#: All codes of a byte.
_ALL = np.arange(256, dtype=np.uint8)


class PropertyCoding(NamedTuple):
    """Encoding of a property.

    Attributes:
        encode: function of (N, numbers) values and the ends of the range of codes; returns codes of any shape.
        decode: function of the bytes, N, numbers of a splat and the ends of the range; returns (N, numbers) values.
        size: bytes of a number.
        ends: keys of a property that define the range of its codes.
    """

    encode: Callable[[NDArray[Any], float, float], NDArray[Any]]
    decode: Callable[[Bytes, int, int, float, float], NDArray[Any]]
    size: int
    ends: tuple[str, ...] = ()

    def rounded(self, values: NDArray[Any], low: float, high: float) -> NDArray[Any]:
        """Encode and decode (N, numbers) values."""
        codes = np.ascontiguousarray(self.encode(values, low, high)).reshape(-1).view(np.uint8)
        return np.ascontiguousarray(self.decode(codes, len(values), values.shape[1], low, high))


def _plain(code: str, most: np.float32 | None = None) -> PropertyCoding:
    """Return the coding of plain numbers of a type; `most` clamps their magnitude."""

    def encode(values: NDArray[Any], low: float, high: float) -> NDArray[Any]:
        planes = values.T if most is None else np.clip(values.T, -most, most)
        return np.ascontiguousarray(planes, code)

    def decode(codes: Bytes, count: int, numbers: int, low: float, high: float) -> NDArray[Any]:
        return codes.view(code).reshape(numbers, count).T

    return PropertyCoding(encode, decode, np.dtype(code).itemsize)


def _by_bytes(coding: PropertyCoding) -> PropertyCoding:
    """Return a coding with the lowest bytes of all numbers first, then their next bytes."""
    size = coding.size

    def encode(values: NDArray[Any], low: float, high: float) -> NDArray[Any]:
        planes = coding.encode(values, low, high).view(np.uint8)
        return np.ascontiguousarray(planes.reshape(-1, size).T)

    def decode(codes: Bytes, count: int, numbers: int, low: float, high: float) -> NDArray[Any]:
        whole = np.ascontiguousarray(codes.reshape(size, -1).T).reshape(-1)
        return coding.decode(whole, count, numbers, low, high)

    return coding._replace(encode=encode, decode=decode)


def _by_differences(coding: PropertyCoding) -> PropertyCoding:
    """Return a coding of differences from the bytes of the splat before, modulo 256."""

    def encode(values: NDArray[Any], low: float, high: float) -> NDArray[Any]:
        planes = coding.encode(values, low, high)
        return np.diff(planes, axis=1, prepend=np.zeros((len(planes), 1), np.uint8))

    def decode(codes: Bytes, count: int, numbers: int, low: float, high: float) -> NDArray[Any]:
        whole = np.cumsum(codes.reshape(numbers, count), axis=1, dtype=np.uint8)
        return coding.decode(whole.reshape(-1), count, numbers, low, high)

    return coding._replace(encode=encode, decode=decode)


def _by_table(
    encode: Callable[[FloatArray, float, float], NDArray[Any]],
    table: Callable[[float, float], FloatArray],
    ends: tuple[str, ...] = ("min", "max"),
) -> PropertyCoding:
    """Return a coding with a byte for a number; `table` returns the values of all 256 by the ends of the range."""

    def encode_planes(values: FloatArray, low: float, high: float) -> NDArray[Any]:
        planes = np.empty((values.shape[1], len(values)), np.uint8)
        for part in blocks_of(len(values), BLOCK):
            planes[:, part] = encode(np.ascontiguousarray(values[part].T), low, high)
        return planes

    def decode(codes: Bytes, count: int, numbers: int, low: float, high: float) -> NDArray[Any]:
        with np.errstate(over="ignore", invalid="ignore"):  # files may have any range
            values = table(low, high)
        return values[codes.reshape(numbers, count).T]

    return PropertyCoding(encode_planes, decode, 1, ends)


@np.errstate(over="ignore")  # values may be far beyond the range
def _encode_signed(values: FloatArray, low: float, high: float) -> NDArray[Any]:
    steps = values / np.float32(high)
    steps *= np.float32(127)
    np.clip(steps, -127, 127, out=steps)
    steps += np.copysign(spark_codings.ALMOST_HALF, steps)
    return steps.astype(np.int8).view(np.uint8)


def _encode_log(values: NDArray[Any], low: float, high: float) -> NDArray[Any]:
    with np.errstate(divide="ignore"):
        return np.minimum(np.log(values.astype(np.float64)), LARGEST_LOG_F16).astype(np.float32)


def _decode_log_f16(codes: Bytes, count: int, numbers: int, low: float, high: float) -> NDArray[Any]:
    with np.errstate(over="ignore", invalid="ignore"):  # files may have any logarithms
        return np.exp(_F16.decode(codes, count, numbers, low, high).astype(np.float32))


def _encode_octahedral(quat_xyzw: NDArray[Any], low: float, high: float) -> NDArray[Any]:
    codes = np.empty((len(quat_xyzw), 3), np.uint8)
    for part in blocks_of(len(quat_xyzw), BLOCK):
        for number, found in enumerate(spark_codings.encode_axis_angle(quat_xyzw[part], STEPS_8_8_8)):
            codes[part, number] = found
    return codes


def _decode_octahedral(codes: Bytes, count: int, numbers: int, low: float, high: float) -> NDArray[Any]:
    u, v, angle = codes.reshape(count, 3).T
    return spark_codings.decode_axis_angle(u, v, angle, STEPS_8_8_8)


_F32, _F16 = _plain("<f4"), _plain("<f2", LARGEST_F16)
_R8 = _by_table(spark_codings.encode_linear, functools.partial(spark_codings.decode_linear, _ALL))
_S8 = _by_table(_encode_signed, lambda low, high: _ALL.view(np.int8) / np.float32(127) * np.float32(high), ("max",))

#: Encodings by name. Largest errors inside the range of the codes, apart from that of float32:
#: f16, f16_lebytes: 2 ** -11 of a number, or 2 ** -25 if that is more. r8, r8_delta: (max - min) / 510.
#: s8, s8_delta: max / 254. ln_0r8: a factor of e ** ((max - min) / 508). ln_f16: a factor of e ** (2 ** -11 *
#: abs(ln(scale))). oct88r8, of whole quaternions, stored splat by splat: 1.94 degrees.
CODINGS = {
    "f32": _F32,
    "f16": _F16,
    "f32_lebytes": _by_bytes(_F32),
    "f16_lebytes": _by_bytes(_F16),
    "r8": _R8,
    "r8_delta": _by_differences(_R8),
    "s8": _S8,
    "s8_delta": _by_differences(_S8),
    "ln_0r8": _by_table(spark_codings.encode_log_scale, spark_codings.log_scale_table),
    "ln_f16": PropertyCoding(
        lambda values, low, high: _plain("<f2").encode(_encode_log(values, low, high), low, high), _decode_log_f16, 2
    ),
    "oct88r8": PropertyCoding(_encode_octahedral, _decode_octahedral, 1),
    "u16": _plain("<u2"),
    "u32": _plain("<u4"),
}


class Row(NamedTuple):
    """Description of a property.

    Attributes:
        option: field of `RadOptions` that chooses its encoding; empty without a choice.
        column: column of `Splats` or `LodTree`; "labels" for labels of the palette.
        numbers: numbers of a splat.
        encodings: allowed encodings; Spark writes the first.
        degree: degree of spherical harmonics; 0 for other properties.
        codes: whether it is a part of the palette of spherical harmonics, which only the first chunk has.
    """

    name: str
    option: str
    column: str
    numbers: int
    encodings: tuple[str, ...]
    degree: int = 0
    codes: bool = False


#: Properties in the order of a chunk.
PROPERTIES = (
    Row("center", "center", "center", 3, RAD_ENCODINGS["center"]),
    Row("alpha", "alpha", "opacity", 1, RAD_ENCODINGS["alpha"]),
    Row("rgb", "rgb", "rgb", 3, RAD_ENCODINGS["rgb"]),
    Row("scales", "scales", "scale", 3, RAD_ENCODINGS["scales"]),
    Row("orientation", "orientation", "quat_xyzw", 3, RAD_ENCODINGS["orientation"]),
    Row("sh1", "sh", "sh", 9, RAD_ENCODINGS["sh"], 1),
    Row("sh2", "sh", "sh", 15, RAD_ENCODINGS["sh"], 2),
    Row("sh3", "sh", "sh", 21, RAD_ENCODINGS["sh"], 3),
    Row("sh1_code", "sh", "sh", 9, RAD_ENCODINGS["sh"], 1, True),
    Row("sh2_code", "sh", "sh", 15, RAD_ENCODINGS["sh"], 2, True),
    Row("sh3_code", "sh", "sh", 21, RAD_ENCODINGS["sh"], 3, True),
    Row("sh_label", "", "labels", 1, ("u16", "u32")),
    Row("child_count", "", "child_count", 1, ("u16",)),
    Row("child_start", "", "child_start", 1, ("u32",)),
)

BY_NAME = {row.name: row for row in PROPERTIES}


@dataclass(frozen=True)
class Property:
    """Stored property of a chunk.

    Attributes:
        offset: position in the payload.
        name: a name of `PROPERTIES`, or an unknown one.
        encoding: a name of `CODINGS`, or an unknown one.
        min, max: ends of the range of the codes; None without a range.
    """

    offset: int
    bytes: int
    name: str
    encoding: str
    compression: str | None = GZ
    min: float | None = None
    max: float | None = None


def encodings_of(properties: Iterable[Property]) -> dict[str, str]:
    """Return the encodings of properties by the field of `RadOptions`."""
    return {BY_NAME[each.name].option: each.encoding for each in properties if BY_NAME[each.name].option}
