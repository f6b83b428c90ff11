"""Findings about the values of splats."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from ..codecs import clamps, quantize
from ..codecs.gpu.layout_loss import MOST_PAGED_DEGREE, LayoutLoss, sample_loss
from ..model.scene import Scene
from ..model.splats import COLUMNS, FloatArray
from .blocks import Block, Mask, MaskTally, ReportBlocks, largest, merged, tallies
from .findings import Finding

#: Code and message of each reason that makes a splat invalid (`splats.INVALID`).
OF_INVALID = {
    "non_finite": ("values.non-finite", "a number is not finite, or the rotation has length 0"),
    "bad_rotation": ("values.rotation", "the length of the rotation is not 1"),
    "negative_scale": ("values.negative-scale", "a scale is below 0"),
    "negative_opacity": ("values.opacity", "the opacity is below 0"),
}

#: Share of splats above which invisible ones are a finding: a few are the rounding of good files.
MANY_INVISIBLE = 0.1

#: Loss of colours in one of Spark's layouts, dB, below which pictures differ visibly, and by how much more than in the
#: other it is worth a hint: twice the error. Chosen.
VISIBLE_LOSS, LOSS_APART = 35, 6

#: Splats of a block that stand for it where this loss is measured.
BLOCK_SAMPLE = 4096

#: Coordinates from this on become infinite in float16, which Spark's PackedSplats use.
FLOAT16_END = 65_520


@dataclass(frozen=True)
class Ends:
    """The numbers at which a file's codes end; values at one of them may have been clamped.

    Attributes:
        scale: smallest and largest scale, world units; 0 and infinity for floats.
        center: largest absolute coordinate, world units.
    """

    scale: tuple[float, float] = (0.0, math.inf)
    center: float = math.inf


def ends_of(header: Mapping[str, int]) -> Ends:
    """Return the ends of the codes of an SPZ file by its header; none for other formats, whose numbers are floats."""
    if "fractional_bits" not in header:
        return Ends()
    low, high = quantize.decode_log_scale(np.array([0, 255], np.uint8))
    fixed = header["version"] >= 2  # version 1 has floats
    return Ends((low, high), quantize.FIXED24_MAX * 2.0 ** -int(header["fractional_bits"]) if fixed else math.inf)


@dataclass(frozen=True, eq=False)
class ValueTally:
    """Tallies of splats by their values.

    Attributes:
        count: splats.
        checked: of them, those of which few may be invisible or clamped: the leaves of a tree, or all.
        invisible: of these, valid or not.
        by_name: tallies of valid splats that are "opaque", "invisible", "transparent", ..., and of the kinds of
            `splats.INVALID`.
        valid: masks of valid splats, by the start of each block in which some are not.
        low, high: (3,) corners of the box of the centres of valid splats; infinite without any.
        layouts: loss of a sample in Spark's layouts.
    """

    count: int
    checked: int
    invisible: int
    by_name: dict[str, MaskTally]
    valid: dict[int, Mask]
    low: FloatArray
    high: FloatArray
    layouts: LayoutLoss = field(default_factory=LayoutLoss)

    @classmethod
    def of(cls, block: Block, ends: Ends, *, layouts: bool = False) -> ValueTally:
        """Tallies of a block with the columns center, scale and opacity, and others that may be invalid.

        Args:
            layouts: measure the loss in Spark's layouts, which takes all columns.
        """
        opacity, most = block.splats.opacity, largest(block.splats.scale)
        furthest, valid = largest(np.abs(block.splats.center)), block.valid
        checked = np.ones(len(opacity), np.bool_) if block.tree is None else block.tree.is_leaf
        # Merged splats of thin leaves far apart may be fainter than any code, or larger.
        invisible = checked & ((opacity == 0) | (most == 0))
        masks = {
            **block.invalid,
            "opaque": valid & (opacity > 1),
            "transparent": valid & (opacity == 0),
            "without scale": valid & (most == 0),
            "invisible": valid & invisible,
            "center": valid & (furthest >= ends.center),
            "far": valid & (furthest >= FLOAT16_END),
        }
        low, high = ends.scale
        if high < math.inf:  # see `clamps.tally` for what of it can be seen
            masks["small"] = checked & valid & (most > 0) & (most <= low)
            masks["large"] = checked & valid & (most >= high)
        center = block.splats.center[valid] if block.invalid else block.splats.center
        return cls(
            len(opacity),
            int(np.count_nonzero(checked)),
            int(np.count_nonzero(invisible)),
            tallies(masks, block.start),
            {block.start: valid} if block.invalid else {},
            np.array([axis.min(initial=np.inf) for axis in center.T]),
            np.array([axis.max(initial=-np.inf) for axis in center.T]),
            sample_loss(block.splats, BLOCK_SAMPLE) if layouts else LayoutLoss(),
        )

    @classmethod
    def total(cls, parts: Iterable[ValueTally]) -> ValueTally:
        """Tallies of all blocks, in order."""
        every = list(parts)
        valid = {start: mask for part in every for start, mask in part.valid.items()}
        low, high = np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
        for part in every:
            low, high = np.minimum(low, part.low), np.maximum(high, part.high)
        return cls(
            sum(part.count for part in every),
            sum(part.checked for part in every),
            sum(part.invisible for part in every),
            merged(part.by_name for part in every),
            valid,
            low,
            high,
            LayoutLoss.total(part.layouts for part in every),
        )

    def number(self, name: str) -> int:
        """Return the number of splats in a tally."""
        return self.by_name.get(name, MaskTally()).count


def check(scene: Scene) -> list[Finding]:
    """Return findings about the values of a scene in memory."""
    ends, blocks = ends_of(scene.header), ReportBlocks.of(scene)
    parts = blocks.map(lambda block: ValueTally.of(block, ends), COLUMNS, 1)
    return findings_about(ValueTally.total(parts), ends, is_tree=blocks.is_tree)


def findings_about(values: ValueTally, ends: Ends, *, is_tree: bool) -> list[Finding]:
    """Return findings about the values of all splats of a file."""
    if not values.count:
        return [Finding("values.empty", "there are no splats")]
    findings: list[Finding] = []

    def report(code: str, name: str, text: str) -> None:
        tally = values.by_name.get(name, MaskTally())
        more = " and {more} more" if tally.count > 1 else ""
        findings.extend(tally.finding(code, f"splat {{first}}{more}: {text}"))

    for kind, (code, text) in OF_INVALID.items():
        report(code, kind, text)
    if not is_tree:
        report("values.opacity", "opaque", "the opacity is above 1")
    if values.invisible > MANY_INVISIBLE * values.checked:
        report("values.invisible", "invisible", "cannot be drawn, as its opacity or scale is 0")
    if ends.center < math.inf:
        text = f"a coordinate is {ends.center:g}, the end of the range of its code"
        report("values.center-clamped", "center", text)
    for name, end in zip(("small", "large"), ends.scale, strict=True):
        if clamps.matters("scale", above=name == "large", visible=values.number(name), leaves=values.checked):
            text = f"a scale is {end:.2g}, the end of the range of its code; RAD with --rad-scales ln_f16 keeps such"
            report("values.scale-clamped", name, text)
    report("values.center-far", "far", f"a coordinate is {FLOAT16_END:,} or more, which float16 cannot hold")
    return findings


def hints_about(loss: LayoutLoss, sh_degree: int) -> list[str]:
    """Return a hint where one of Spark's layouts is visibly worse than the other."""
    ext, packed = loss.psnr("ext"), loss.psnr("packed")
    if min(ext, packed) >= VISIBLE_LOSS or abs(ext - packed) < LOSS_APART:
        return []
    if packed > ext:
        text = f"Spark's ExtSplats clip the SH ({ext:.0f} dB; PackedSplats {packed:.0f} dB)"
        return [f"{text}; leave out extSplats and pagedExtSplats"]
    text = f"Spark's PackedSplats clamp colours or round centres ({packed:.0f} dB; ExtSplats {ext:.0f} dB)"
    paged = " (pagedExtSplats of a paged file)" if sh_degree <= MOST_PAGED_DEGREE else ""
    return [f"{text}; set extSplats{paged}"]
