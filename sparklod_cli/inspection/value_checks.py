"""Findings about the values of splats."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..codecs import clamps, quantize
from ..model.scene import Scene
from ..model.splats import COLUMNS
from .blocks import Block, Blocks, Tally, largest
from .findings import Finding

#: Code and message of each reason that makes a splat invalid (`splats.INVALID`).
OF_INVALID = {
    "non_finite": ("values.non-finite", "a number is not finite, or the rotation has length 0"),
    "bad_rotation": ("values.rotation", "the length of the rotation is not 1"),
    "negative_scale": ("values.negative-scale", "a scale is below 0"),
    "negative_opacity": ("values.opacity", "the opacity is below 0"),
}

#: Columns of `Splats` that are looked at besides those that make a splat invalid.
USED = ("center", "scale", "opacity")

#: Share of splats above which invisible ones are a finding: a few are the rounding of good files.
MANY_INVISIBLE = 0.1

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
    """The ends of the codes of an SPZ file by its header, and none for other formats, whose numbers are floats."""
    if "fractional_bits" not in header:
        return Ends()
    low, high = quantize.decode_log_scale(np.array([0, 255], np.uint8))
    fixed = header["version"] >= 2  # version 1 has floats
    return Ends((low, high), quantize.FIXED24_MAX * 2.0 ** -int(header["fractional_bits"]) if fixed else math.inf)


def check(scene: Scene, ends: Ends | None = None) -> list[Finding]:
    """Findings about the values of a scene in memory.

    Args:
        scene: as it was read.
        ends: of its codes; None for those of its header.
    """
    found = ValueChecks(ends_of(scene.header) if ends is None else ends, is_tree=scene.tree is not None)
    for block in Blocks.of(scene).read(COLUMNS):
        found.merge(found.part_of(block))
    return found.findings()


@dataclass
class ValueChecks:
    """Looks for faults in splats that pass once, block by block: with all columns, `USED` of sound ones, or codes.

    Attributes:
        ends: of the codes of their file.
        is_tree: they are the nodes of a tree.
        count: splats so far.
        checked: of them, those of which few may be invisible or clamped: the leaves of a tree, or all.
        invisible: of these, valid or not.
        tallies: by what is wrong.
    """

    ends: Ends
    is_tree: bool
    count: int = 0
    checked: int = 0
    invisible: int = 0
    tallies: dict[str, Tally] = field(default_factory=dict)

    def _add(self, what: str, mask: NDArray[np.bool_], block: Block) -> None:
        self.tallies.setdefault(what, Tally()).add(mask, block.start)

    def part_of(self, block: Block) -> ValueChecks:
        """What is wrong in a block, to be merged."""
        part = ValueChecks(self.ends, is_tree=self.is_tree)
        part.add(block)
        return part

    def merge(self, part: ValueChecks) -> None:
        """Adds what was found in the next block."""
        self.count += part.count
        self.checked += part.checked
        self.invisible += part.invisible
        for what, tally in part.tallies.items():
            self.tallies.setdefault(what, Tally()).merge(tally)

    def add(self, block: Block) -> None:
        """Looks at a block."""
        splats, valid = block.splats, block.valid
        some = np.ones(len(splats), np.bool_) if block.tree is None else block.tree.is_leaf
        self.count += len(splats)
        self.checked += int(np.count_nonzero(some))
        for kind, mask in block.invalid.items():
            self._add(kind, mask, block)
        if block.coded is None:
            opacity, most, furthest = splats.opacity, largest(splats.scale), largest(np.abs(splats.center))
        else:
            opacity, most, furthest = block.coded.extremes(block.part)
        if not self.is_tree:
            self._add("opaque", valid & (opacity > 1), block)
        # Merged splats of thin leaves far apart may be fainter than any code, or larger.
        invisible = some & ((opacity == 0) | (most == 0))
        self.invisible += int(np.count_nonzero(invisible))
        self._add("invisible", valid & invisible, block)
        self._add("center", valid & (furthest >= self.ends.center), block)
        low, high = self.ends.scale
        if high < math.inf:  # see `clamps.tally` for what of it can be seen
            self._add("small", some & valid & (most > 0) & (most <= low), block)
            self._add("large", some & valid & (most >= high), block)
        self._add("far", valid & (furthest >= FLOAT16_END), block)

    def findings(self) -> list[Finding]:
        """What was found."""
        if not self.count:
            return [Finding("values.empty", "there are no splats")]
        found: list[Finding] = []

        def report(code: str, what: str, text: str) -> None:
            tally = self.tallies.get(what, Tally())
            more = " and {more} more" if tally.count > 1 else ""
            found.extend(tally.finding(code, f"splat {{first}}{more}: {text}"))

        for kind, (code, text) in OF_INVALID.items():
            report(code, kind, text)
        report("values.opacity", "opaque", "the opacity is above 1")
        if self.invisible > MANY_INVISIBLE * self.checked:
            report("values.invisible", "invisible", "cannot be drawn, as its opacity or scale is 0")
        if self.ends.center < math.inf:
            text = f"a coordinate is {self.ends.center:g}, the end of the range of its code"
            report("values.center-clamped", "center", text)
        for what, end in zip(("small", "large"), self.ends.scale, strict=True):
            visible = self.tallies.get(what, Tally()).count
            if clamps.matters("scale", above=what == "large", visible=visible, leaves=self.checked):
                text = (
                    f"a scale is {end:.2g}, the end of the range of its code; RAD with --rad-scales ln_f16 keeps such"
                )
                report("values.scale-clamped", what, text)
        report("values.center-far", "far", f"a coordinate is {FLOAT16_END:,} or more, which float16 cannot hold")
        return found
