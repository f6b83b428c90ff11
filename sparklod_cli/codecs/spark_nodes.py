"""Nodes of a Level-of-Detail tree as Spark's traversal reads them: its layout of 16 bytes per node, and loaded nodes.

Loaded nodes are measured after Spark's own coding of the splats: it decodes a file to float32, codes the splats as
ExtSplats or PackedSplats, decodes those, and takes of them centres and sizes, which it rounds to half floats. All of
that is repeated here in the same arithmetic, for the columns that matter.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import size_factor, spark_size
from ..model.lod_tree import CHUNK_NODES, MAX_CHILDREN, LodTree
from ..model.scene import SPZ_SCALES, FileCoding, ScaleCoding
from ..model.splats import FloatArray, Splats
from ..system.errors import FormatError
from ..system.threads import for_blocks
from . import quantize, spark_codings
from .spark_codings import SplatEncoding, Words, checked_words

NODE = np.dtype(
    [
        ("center", "<f2", 3),  # 0: world units; x | y << 16 in word 0, z in word 1
        ("size", "<f2"),  # 6: world units, see `spark_size`; the upper half of word 1
        ("child_count", "<u4"),  # 8: 0 for a leaf; a uint16, the upper half of word 2 is 0
        ("child_start", "<u4"),  # 12: index of the first child, 0 for a leaf
    ]
)
assert NODE.itemsize == 16


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


def pack(splats: Splats, tree: LodTree, *, threads: int = 1) -> dict[str, Words]:
    """Pack splats and their tree in the layout of Spark's traversal: "lod_tree" (N, 4) uint32.

    Spark measures splats after their coding: for the same words as Spark's, pass splats that were packed and unpacked
    by `ext_splats` or `packed_splats`. A coordinate or a size of 65520 or more becomes infinite, as in Spark.

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


def unpack(arrays: Mapping[str, NDArray[Any]]) -> Nodes:
    """Return the nodes of the array of `pack`.

    Largest errors: 2 ** -11 of each coordinate and of the size, or 2 ** -25 if that is more; children are exact.

    Raises:
        FormatError: the array is missing or has another shape or type, or a node has more children than a uint16 holds.
    """
    rows = checked_words(arrays, {"lod_tree": 4})["lod_tree"].view(NODE)[:, 0]
    child_count = rows["child_count"]
    if child_count.max(initial=0) > MAX_CHILDREN:
        node = int(np.argmax(child_count > MAX_CHILDREN))
        raise FormatError(f"node {node} has {child_count[node]:,} children, a uint16 holds at most {MAX_CHILDREN:,}")
    tree = LodTree(child_count.astype(np.uint16), rows["child_start"].copy())
    return Nodes(rows["center"].astype(np.float32), rows["size"].astype(np.float32), tree)


Recode = Callable[[FloatArray], FloatArray]

#: Every half float.
_HALVES = np.arange(1 << 16, dtype=np.uint16).view(np.float16)

#: Spark's worker codes no other scales as 0 than those below this; its documentation says e ** -30.
_LEAST = np.finfo(np.float32).smallest_subnormal

#: Share of a scale by which it may differ from that of its code: several times what exponentials disagree by.
_SAME = np.float32(2**-20)


def nodes(splats: Splats, tree: LodTree, layout: str, coding: FileCoding | None = None, *, threads: int = 1) -> Nodes:
    """Return the nodes of a tree as Spark's traversal reads them.

    Args:
        splats: N, as they were decoded; their centres, scales and opacities matter.
        layout: one of `formats.LOADED`.
        coding: of the file that they were read from. Scales that do not come from its codes, or of splats that were not
            read from a file, are taken to be those that Spark has.
    """
    coding = coding or FileCoding()
    alpha_held, scale_held = _layout(layout, coding.packed_range)
    found = Nodes(np.empty((len(splats), 3), np.float32), np.empty(len(splats), np.float32), tree)
    for rows, scales in coding.parts(len(splats)):
        recode = _recoded(scales, scale_held)

        @np.errstate(over="ignore", invalid="ignore")
        def measure(part: slice, start: int = rows.start, recode: Recode = recode) -> None:
            part = slice(start + part.start, start + part.stop)
            alpha = alpha_held(spark_codings.stored_lod_alpha(splats.opacity[part]))
            x, y, z = recode(np.ascontiguousarray(splats.scale[part].T))
            factor = np.float32(2) * size_factor(spark_codings.lod_opacity_of_alpha(alpha))
            found.center[part] = splats.center[part].astype(np.float16)
            found.size[part] = (factor * ((x + y + z) / np.float32(3))).astype(np.float16)

        for_blocks(measure, rows.stop - rows.start, threads)
    return found


def _layout(name: str, packed_range: tuple[float, float] | None) -> tuple[Recode, Recode]:
    """Return the rounding of alphas, 0..2, and of linear scales in one of `formats.LOADED`.

    Args:
        packed_range: range of logarithms that a file sets for PackedSplats; None for that of Spark.
    """
    if name == "ext":
        scales = spark_codings.exp(_HALVES.astype(np.float32))
        return (
            lambda alpha: alpha.astype(np.float16).astype(np.float32),
            lambda scale: scales[spark_codings.log(scale).astype(np.float16).view(np.uint16)],
        )
    own = SplatEncoding(lod_opacity=True)
    low, high = own.ln_scale_min, own.ln_scale_max
    if name == "packed" and packed_range is not None:
        low, high = packed_range
    table = spark_codings.log_scale_table(low, high, exp=spark_codings.exp)

    def alpha_held(alpha: FloatArray) -> FloatArray:
        codes = spark_codings.encode_linear(alpha, 0, own.alpha_max)
        return spark_codings.decode_linear(codes.astype(np.uint8), 0, own.alpha_max)

    def scale_held(scale: FloatArray) -> FloatArray:
        known = np.where(np.isnan(scale), _LEAST, scale)
        return table[spark_codings.encode_log_scale(known, low, high, log=spark_codings.log, least=_LEAST)]

    return alpha_held, scale_held


@np.errstate(divide="ignore", invalid="ignore")
def _half_log(scale: FloatArray) -> NDArray[np.uint16]:
    return np.log(scale).astype(np.float16).view(np.uint16)


@np.errstate(over="ignore", invalid="ignore")
def _recoded(coding: ScaleCoding, held: Recode) -> Recode:
    """Return what a layout keeps (`held`) of scales that come from codes, whose last bits are others in Spark."""
    code_of: Callable[[FloatArray], NDArray[Any]]
    name, low, high = coding
    if name == "ln_0r8":
        code_of = functools.partial(spark_codings.encode_log_scale, low=low, high=high)
        scale_of = spark_codings.log_scale_table(low, high)
        theirs = spark_codings.log_scale_table(low, high, exp=spark_codings.exp)
    elif coding == SPZ_SCALES or name == "ln_f16":
        logs: NDArray[Any] = _HALVES.astype(np.float32)
        code_of = _half_log
        if coding == SPZ_SCALES:
            logs = np.arange(256, dtype=np.float32) / quantize.SCALE_STEPS - quantize.SCALE_OFFSET
            code_of = quantize.encode_log_scale
        scale_of, theirs = np.exp(logs), spark_codings.exp(logs)
    else:
        return held
    of_code = held(theirs)

    def of_scale(scale: FloatArray) -> FloatArray:
        code = code_of(scale)
        found, ours = of_code[code], scale_of[code]
        other = ~((ours == scale) | (np.abs(ours - scale) <= _SAME * scale))
        if other.any():
            found[other] = held(scale[other])
        return found

    return of_scale
