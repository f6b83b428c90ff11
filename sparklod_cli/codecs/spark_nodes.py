"""Nodes of a Level-of-Detail tree as Spark's traversal has them, measured after Spark's own coding of the splats.

Spark decodes a file to float32, encodes the splats as ExtSplats or PackedSplats, decodes those, measures centres and
sizes, and rounds them to half floats. All of that is repeated here in the same arithmetic, for the columns that matter.

`exp` and `log` are those of Spark's worker, bit for bit. It is compiled to WebAssembly, which has neither; so both are
those of Rust's `libm`, after FreeBSD's msun: float32 throughout, and off by less than one unit of the last place, where
numpy's differ from machine to machine.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import size_factor
from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import SPZ_SCALES, FileCoding, ScaleCoding
from ..model.splats import FloatArray, Splats
from ..system.threads import for_blocks
from . import quantize, spark_codings
from .spark_codings import SplatEncoding

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


Recode = Callable[[FloatArray], FloatArray]

#: Every half float.
_HALVES = np.arange(1 << 16, dtype=np.uint16).view(np.float16)

#: Spark's worker codes no other scales as 0 than those below this; its documentation says e ** -30.
_LEAST = np.finfo(np.float32).smallest_subnormal

#: Share of a scale by which it may differ from that of its code: several times what exponentials disagree by.
_SAME = np.float32(2**-20)

#: Units of the last place by which the logarithm, the exponential and the square root of an alpha may miss it together.
_STEPS_TO_STORED = (0, 1, -1, 2, -2, 3, -3, 4, -4)


@dataclass(frozen=True)
class Nodes:
    """N nodes of a tree, which is not validated, with (N, 3) float32 centres and (N,) feature sizes, world units."""

    center: FloatArray
    size: FloatArray
    tree: LodTree

    #: Whether nodes are read from the file when cuts need them.
    paged: ClassVar[bool] = False

    @property
    def count(self) -> int:
        return len(self.size)

    @property
    def chunks(self) -> int:
        return -(-self.count // CHUNK_NODES)

    @property
    def depth(self) -> NDArray[np.int32]:
        return self.tree.depths()

    def fill(self, rows: NDArray[np.void]) -> None:
        """Fill (N,) `pixel_scale.NODE`."""
        rows["x"], rows["y"], rows["z"] = self.center.T
        rows["size"] = self.size
        rows["child_start"], rows["child_count"] = self.tree.first_child(), self.tree.child_count


def nodes(splats: Splats, tree: LodTree, layout: str, coding: FileCoding | None = None, *, threads: int = 1) -> Nodes:
    """Return the nodes of a tree as Spark's traversal reads them.

    Args:
        splats: N decoded splats; their centres, scales and opacities matter.
        layout: one of `formats.LOADED`.
        coding: coding of their file. Scales that do not come from its codes, and all scales of splats without a file,
            are taken to be those that Spark has.
    """
    coding = coding or FileCoding()
    round_alpha, round_scale = _rounding(layout, coding.packed_range)
    measured = Nodes(np.empty((len(splats), 3), np.float32), np.empty(len(splats), np.float32), tree)
    for rows, scales in coding.parts(len(splats)):
        recode = _recoded(scales, round_scale)

        @np.errstate(over="ignore", invalid="ignore")
        def measure(part: slice, start: int = rows.start, recode: Recode = recode) -> None:
            part = slice(start + part.start, start + part.stop)
            alpha = round_alpha(stored_lod_alpha(splats.opacity[part]))
            x, y, z = recode(np.ascontiguousarray(splats.scale[part].T))
            factor = np.float32(2) * size_factor(spark_codings.lod_opacity_of_alpha(alpha))
            measured.center[part] = splats.center[part].astype(np.float16)
            measured.size[part] = (factor * ((x + y + z) / np.float32(3))).astype(np.float16)

        for_blocks(measure, rows.stop - rows.start, threads)
    return measured


def stored_lod_alpha(opacity: FloatArray) -> FloatArray:
    """Return the alpha from which linear opacity A was decoded, to the last bit.

    `encode_lod_alpha` may miss it by some units of the last place, and then another number nearby decodes to A. Where
    no number does, A was not decoded from an alpha, and the alpha of `encode_lod_alpha` is returned.
    """
    alpha = spark_codings.encode_lod_alpha(opacity)
    left = np.flatnonzero(alpha > 1)  # usually few
    for steps in _STEPS_TO_STORED:
        near = (alpha[left].view(np.int32) + np.int32(steps)).view(np.float32)
        is_same = spark_codings.decode_lod_alpha(near) == opacity[left]
        alpha[left[is_same]] = near[is_same]
        left = left[~is_same]
    return alpha


def _rounding(layout: str, packed_range: tuple[float, float] | None) -> tuple[Recode, Recode]:
    """Return the functions that round alphas, 0..2, and linear scales as one of `formats.LOADED` does.

    Args:
        packed_range: range of logarithms that a file sets for PackedSplats; None for that of Spark.
    """
    if layout == "ext":
        scales = exp(_HALVES.astype(np.float32))
        return (
            lambda alpha: alpha.astype(np.float16).astype(np.float32),
            lambda scale: scales[log(scale).astype(np.float16).view(np.uint16)],
        )
    own = SplatEncoding(lod_opacity=True)
    low, high = own.ln_scale_min, own.ln_scale_max
    if layout == "packed" and packed_range is not None:
        low, high = packed_range
    table = spark_codings.log_scale_table(low, high, exp=exp)

    def round_alpha(alpha: FloatArray) -> FloatArray:
        codes = spark_codings.encode_linear(alpha, 0, own.alpha_max)
        return spark_codings.decode_linear(codes.astype(np.uint8), 0, own.alpha_max)

    def round_scale(scale: FloatArray) -> FloatArray:
        known = np.where(np.isnan(scale), _LEAST, scale)
        return table[spark_codings.encode_log_scale(known, low, high, log=log, least=_LEAST)]

    return round_alpha, round_scale


@np.errstate(divide="ignore", invalid="ignore")
def _half_log(scale: FloatArray) -> NDArray[np.uint16]:
    return np.log(scale).astype(np.float16).view(np.uint16)


@np.errstate(over="ignore", invalid="ignore")
def _recoded(coding: ScaleCoding, round_scale: Recode) -> Recode:
    """Return a function that rounds scales decoded from codes as Spark does, which decodes them to other last bits."""
    code_of: Callable[[FloatArray], NDArray[Any]]
    name, low, high = coding
    if name == "ln_0r8":
        code_of = functools.partial(spark_codings.encode_log_scale, low=low, high=high)
        ours = spark_codings.log_scale_table(low, high)
        theirs = spark_codings.log_scale_table(low, high, exp=exp)
    elif coding == SPZ_SCALES or name == "ln_f16":
        logs: NDArray[Any] = _HALVES.astype(np.float32)
        code_of = _half_log
        if coding == SPZ_SCALES:
            logs = np.arange(256, dtype=np.float32) / quantize.SCALE_STEPS - quantize.SCALE_OFFSET
            code_of = quantize.encode_log_scale
        ours, theirs = np.exp(logs), exp(logs)
    else:
        return round_scale
    rounded_of_code = round_scale(theirs)

    def of_scale(scale: FloatArray) -> FloatArray:
        code = code_of(scale)
        rounded, decoded = rounded_of_code[code], ours[code]
        other = ~((decoded == scale) | (np.abs(decoded - scale) <= _SAME * scale))
        if other.any():
            rounded[other] = round_scale(scale[other])
        return rounded

    return of_scale
