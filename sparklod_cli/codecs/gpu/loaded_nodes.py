"""Nodes as Spark has them once it has loaded a file: measured after its own coding of the splats.

Spark decodes a file to float32, codes the splats as ExtSplats or PackedSplats, decodes those, and takes centres and
sizes of them, which it rounds to half floats. All of that is repeated here, in the same arithmetic, for the columns that
matter; the words are those of its worker, not of its documentation (see `splat_encoding.encode_log_scale`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...model.coding import PLAIN, FileCoding, ScaleCoding
from ...model.gaussian import size_factor
from ...model.lod_tree import LodTree
from ...model.nodes import Nodes
from ...model.splats import FloatArray, Splats
from ...support.parallel import for_blocks
from .. import octahedral, quantize, spark_math, splat_encoding
from ..octahedral import Words
from ..splat_encoding import SplatEncoding

Recode = Callable[[FloatArray], FloatArray]

#: Ratio by which a scale may differ from that of its code, to be taken for it: a few times what libraries disagree by.
_SAME = 2.0**-21

_HALVES = np.arange(1 << 16, dtype=np.uint16).view(np.float16)


class Layout(NamedTuple):
    """What a layout in memory makes of numbers.

    Attributes:
        alpha: of alphas, 0..2.
        scale: of linear scales.
    """

    alpha: Recode
    scale: Recode


def nodes(
    splats: Splats, tree: LodTree, layout: str, coding: FileCoding = PLAIN, *, threads: int = 1
) -> Nodes:
    """The nodes of a tree as Spark's traversal reads them.

    Args:
        splats: N, as the file was decoded; centres, scales and opacities matter.
        tree: of them.
        layout: "ext" for ExtSplats; "packed" for PackedSplats in the ranges of the file, as Spark has a file that it
            loads whole; "packed-pages" for PackedSplats in Spark's own ranges, as it has a RAD file that it streams.
        coding: of the file that they were read from. Without, Spark's numbers are taken to be theirs.
        threads: to work on.
    """
    alpha, scale = _layout(layout, coding)
    found = Nodes(np.empty((len(splats), 3), np.float32), np.empty(len(splats), np.float32), tree)
    for rows, scales in coding.parts(len(splats)):
        recode = _recoded(scales, scale)

        @np.errstate(over="ignore", invalid="ignore")
        def measure(part: slice, rows: slice = rows, recode: Recode = recode) -> None:
            part = slice(rows.start + part.start, rows.start + part.stop)
            found.center[part] = splats.center[part].astype(np.float16)
            held = alpha(octahedral.stored_lod_alpha(splats.opacity[part]))
            x, y, z = recode(np.ascontiguousarray(splats.scale[part].T))
            size = size_factor(octahedral.lod_opacity_of_alpha(held)) * np.float32(2) * ((x + y + z) / np.float32(3))
            found.size[part] = size.astype(np.float16)

        for_blocks(measure, rows.stop - rows.start, threads, lambda _: None)
    return found


def _layout(name: str, coding: FileCoding) -> Layout:
    if name == "ext":
        scales = spark_math.exp(_HALVES.astype(np.float32))
        return Layout(
            lambda alpha: alpha.astype(np.float16).astype(np.float32),
            lambda scale: scales[spark_math.log(scale).astype(np.float16).view(np.uint16)],
        )
    encoding = SplatEncoding(**coding.ranges) if name == "packed" else splat_encoding.DEFAULT
    low, high = encoding.ln_scale_min, encoding.ln_scale_max
    table = splat_encoding.log_scale_table(low, high, exp=spark_math.exp)
    return Layout(
        lambda alpha: splat_encoding.decode_linear(splat_encoding.encode_linear(alpha, 0, 2).astype(np.uint8), 0, 2),
        lambda scale: table[
            splat_encoding.encode_log_scale(np.nan_to_num(scale, nan=_LEAST), low, high, log=spark_math.log, least=_LEAST)
        ],
    )


#: Spark's worker has no other scale than 0, and those below it, for zero.
_LEAST = np.float32(np.finfo(np.float32).smallest_subnormal)


class _Codes(NamedTuple):
    """The codes of a file's scales, which are not negative whole numbers.

    Attributes:
        of: codes of scales.
        ours: the scale of each code, as `Splats` has it.
        theirs: the same as Spark has it.
    """

    of: Callable[[FloatArray], Words]
    ours: FloatArray
    theirs: FloatArray


@np.errstate(over="ignore", invalid="ignore")
def _codes(coding: ScaleCoding) -> _Codes | None:
    if coding.name == "spz":
        logs = np.arange(256, dtype=np.float32) / quantize.SCALE_STEPS - quantize.SCALE_OFFSET
        return _Codes(quantize.encode_log_scale, np.exp(logs), spark_math.exp(logs))
    if coding.name == "ln_0r8":
        low, high = coding.low, coding.high
        ours, theirs = (splat_encoding.log_scale_table(low, high, exp=e) for e in (splat_encoding.nearest_exp, spark_math.exp))
        return _Codes(lambda scale: splat_encoding.encode_log_scale(scale, low, high), ours, theirs)
    if coding.name == "ln_f16":
        logs = _HALVES.astype(np.float32)
        return _Codes(lambda scale: np.log(scale).astype(np.float16).view(np.uint16), np.exp(logs), spark_math.exp(logs))
    return None


def _recoded(coding: ScaleCoding, recode: Recode) -> Recode:
    """What a layout makes of scales that are decoded from codes, whose last bits are others in Spark."""
    codes = _codes(coding)
    if codes is None:
        return recode
    of_code = recode(codes.theirs)

    def of_scale(scale: FloatArray) -> FloatArray:
        code = codes.of(scale)
        found, ours = of_code[code], codes.ours[code]
        other = ~((ours == scale) | (np.abs(ours - scale) <= _SAME * scale))
        found[other] = recode(scale[other])
        return found

    return of_scale
