"""Statistics of the values of splats."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..codecs import quantize
from ..codecs.losses import MOST_PAGED_DEGREE, LayoutLoss, clamp_matters, sample_loss
from ..codecs.statistics import Distribution
from ..model.gaussian import spark_size
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..system.threads import ordered_map
from ..tables.histograms import Histogram, histogram
from .findings import Block, Finding, Mask, ReportBlocks, Tallies, largest, merged, smallest, tallies

#: Coordinates, whose percentiles are those of the box.
AXES = ("x", "y", "z")


class SplatQuantity(NamedTuple):
    """A number of each splat.

    Attributes:
        columns: of `Splats` that it is computed from.
        of: function of N splats to (N,) numbers, which may not be finite.
        linear: its histogram has bins of equal width, for any range of the numbers.
        sh_degree: least SH degree of splats that have it.
    """

    meaning: str
    columns: tuple[str, ...]
    of: Callable[[Splats], FloatArray]
    linear: bool = False
    sh_degree: int = 0


def _component(meaning: str, column: str, at: int) -> SplatQuantity:
    return SplatQuantity(meaning, (column,), lambda splats: getattr(splats, column)[:, at], linear=True)


def _anisotropy(splats: Splats) -> FloatArray:
    return np.divide(largest(splats.scale), smallest(splats.scale), dtype=np.float64)


def _sh(degree: int) -> SplatQuantity:
    def of(splats: Splats) -> FloatArray:
        own = splats.sh[:, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]]
        return np.sqrt(np.einsum("nkc,nkc->n", own, own, dtype=np.float64) / (3 * own.shape[1]))

    return SplatQuantity(f"root mean square of the coefficients of degree {degree}", ("sh",), of, sh_degree=degree)


QUANTITIES = {
    **{axis: _component("centres, world units", "center", at) for at, axis in enumerate(AXES)},
    "scale": SplatQuantity(
        "the largest standard deviation, world units", ("scale",), lambda splats: largest(splats.scale)
    ),
    "scale_min": SplatQuantity(
        "the smallest standard deviation, world units", ("scale",), lambda splats: smallest(splats.scale)
    ),
    "anisotropy": SplatQuantity("the largest standard deviation over the smallest", ("scale",), _anisotropy),
    "opacity": SplatQuantity(
        "linear opacity; above 1 for merged splats", ("opacity",), lambda splats: splats.opacity, linear=True
    ),
    "size": SplatQuantity(
        "the feature size by which Spark chooses nodes, world units", ("scale", "opacity"), spark_size
    ),
    **{name: _component("display-referred colour", "rgb", at) for at, name in enumerate(("red", "green", "blue"))},
    **{f"sh{degree}": _sh(degree) for degree in (1, 2, 3)},
}

#: The quantities of a report without --stats.
MAIN = ("scale", "opacity", "anisotropy")
#: Percentiles of a quantity, by name.
LEVELS = {"min": 0, "p1": 1, "p25": 25, "p50": 50, "p75": 75, "p99": 99, "max": 100}

#: Most numbers of a quantity that are kept and sorted when a scene is read by chunk. Chosen.
KEPT = 1 << 18


class Numbers:
    """Percentiles and mean of numbers that are added block by block.

    Up to `limit` numbers are kept, and percentiles are exact. More numbers are counted in a `Distribution` of their
    distances from an origin, in memory that does not depend on their number: a percentile is then off by at most 0.8 %
    of its distance from there, within float32.

    Args:
        centred: the origin is the median of the first numbers, instead of 0.
    """

    def __init__(self, limit: float, *, centred: bool) -> None:
        self._limit, self._centred = limit, centred
        self._kept: list[FloatArray] = []
        self._distribution: Distribution | None = None
        self._sum = self._origin = 0.0
        self.count = 0

    def add(self, values: FloatArray) -> None:
        """Add the finite numbers of an (n,) array."""
        values = values[np.isfinite(values)]
        self.count += len(values)
        self._sum += float(values.sum(dtype=np.float64))
        self._kept.append(values)
        if self._distribution is not None or self.count > self._limit:
            self._merge()

    def _merge(self) -> None:
        """Move the kept numbers to the distribution."""
        values = np.concatenate(self._kept).astype(np.float64)
        self._kept = []
        if self._distribution is None and self._centred:
            self._origin = float(np.median(values))
        most = float(np.finfo(np.float32).max)
        added = Distribution.of(np.clip(values - self._origin, -most, most).astype(np.float32))
        before = self._distribution
        self._distribution = added if before is None else Distribution.merged([before, added])

    def summary(self) -> dict[str, float]:
        """Return the percentiles and the mean by name; empty without numbers."""
        if not self.count:
            return {}
        if self._distribution is not None:
            found = {name: self._origin + self._distribution.quantile(level / 100) for name, level in LEVELS.items()}
        else:
            numbers = np.concatenate(self._kept).astype(np.float64) + 0  # -0 becomes 0, as in a `Distribution`
            shares = np.array(list(LEVELS.values())) / 100
            found = dict(zip(LEVELS, np.quantile(numbers, shares).tolist(), strict=True))
        return {name: _number(value) for name, value in found.items()} | {"mean": _number(self._sum / self.count)}


@dataclass(frozen=True)
class Box:
    """Axis-aligned box: its lowest and highest corner, (3,) world units."""

    min: list[float]
    max: list[float]


@dataclass(frozen=True)
class ValueFacts:
    """Statistics of valid splats, and the number of invalid ones (`splats.INVALID`); `schema.json` has the fields."""

    box: Box | None
    box_98: Box | None
    non_finite: int
    negative_scale: int
    zero_opacity: int
    zero_scale: int
    more_than_opaque: int
    quantities: dict[str, dict[str, float | None]]


def names_of(splats: Splats) -> list[str]:
    """Return the names of the quantities that splats of this SH degree have."""
    return [name for name, row in QUANTITIES.items() if row.sh_degree <= splats.sh_degree]


def quantity(splats: Splats, name: str) -> FloatArray:
    """Compute the (N,) numbers of a quantity, finite or not."""
    with np.errstate(all="ignore"):
        return QUANTITIES[name].of(splats)


def histogram_of(splats: Splats, name: str) -> Histogram:
    """Count the numbers of a quantity, one of `names_of(splats)`, in bins."""
    return histogram(quantity(splats, name), linear=QUANTITIES[name].linear)


def statistics_of(blocks: ReportBlocks, tally: ValueTally, *, all_quantities: bool, threads: int) -> ValueFacts:
    """Compute statistics, for which all blocks are read again; in memory, threads share the quantities by columns."""
    none = blocks.about.splats.take(slice(0))
    shown = names_of(none) if all_quantities else MAIN
    groups: dict[tuple[str, ...], list[str]] = {}
    for name in dict.fromkeys((*AXES, *shown)):
        groups.setdefault(QUANTITIES[name].columns if blocks.in_memory else (), []).append(name)

    def valid_splats(block: Block) -> Splats:
        valid = tally.valid.get(block.start)
        return block.splats if valid is None else block.splats.take(valid)

    def summaries(names: list[str]) -> dict[str, dict[str, float]]:
        limit = math.inf if blocks.in_memory else KEPT
        numbers = {name: Numbers(limit, centred=name in AXES) for name in names}
        columns = {column for name in names for column in QUANTITIES[name].columns}
        for splats in blocks.map(valid_splats, columns, 1):
            for name in names:
                numbers[name].add(quantity(splats, name))
        return {name: numbers.pop(name).summary() for name in names}

    found: dict[str, dict[str, float]] = {}
    for summary in ordered_map(summaries, groups.values(), threads):
        found |= summary
    box = box_98 = None
    if found["x"]:
        box = Box(_numbers(tally.low), _numbers(tally.high))
        box_98 = Box(*([found[axis][level] for axis in AXES] for level in ("p1", "p99")))
    return ValueFacts(
        box,
        box_98,
        non_finite=tally.by_name["non_finite"].count,
        negative_scale=tally.by_name["negative_scale"].count,
        zero_opacity=tally.by_name["transparent"].count,
        zero_scale=tally.by_name["without scale"].count,
        more_than_opaque=tally.by_name["opaque"].count,
        quantities={name: {key: found[name].get(key) for key in (*LEVELS, "mean")} for name in shown},
    )


def _number(value: Any) -> float:
    return float(f"{float(value):.6g}")


def _numbers(values: NDArray[Any]) -> list[float]:
    return [_number(value) for value in values]


#: Code and message of each kind of invalid splats (`splats.INVALID`).
OF_INVALID = {
    "non_finite": ("values.non-finite", "a number is not finite, or the rotation has length 0"),
    "bad_rotation": ("values.rotation", "the length of the rotation is not 1"),
    "negative_scale": ("values.negative-scale", "a scale is below 0"),
    "negative_opacity": ("values.opacity", "the opacity is below 0"),
}

#: Share of splats above which invisible ones are a finding: a few are the rounding of good files.
MANY_INVISIBLE = 0.1

#: PSNR of colours in one of Spark's layouts, dB, below which pictures differ visibly, and how much higher that of the
#: other layout is when a hint is worthwhile: half the error. Chosen.
VISIBLE_LOSS, LOSS_APART = 35, 6

#: Splats of a block for which this loss is measured.
BLOCK_SAMPLE = 4096

#: Coordinates from this on become infinite in float16, which Spark's PackedSplats use.
FLOAT16_END = 65_520


@dataclass(frozen=True)
class Ends:
    """Limits of the codes of a file; values at a limit may have been clamped.

    Attributes:
        scale: smallest and largest scale, world units; 0 and infinity for floats.
        center: largest absolute coordinate, world units.
    """

    scale: tuple[float, float] = (0.0, math.inf)
    center: float = math.inf


def ends_of(header: Mapping[str, int]) -> Ends:
    """Return the limits of the codes of an SPZ file from its header; infinite for other formats, which have floats."""
    if "fractional_bits" not in header:
        return Ends()
    low, high = quantize.decode_log_scale(np.array([0, 255], np.uint8))
    fixed = header["version"] >= 2  # version 1 has floats
    return Ends((low, high), quantize.FIXED24_MAX * 2.0 ** -int(header["fractional_bits"]) if fixed else math.inf)


@dataclass(frozen=True, eq=False)
class ValueTally:
    """Tallies of splats by their values.

    Attributes:
        by_name: of valid splats that are "opaque", "invisible", "transparent" etc.; of the kinds of `splats.INVALID`;
            of "all" splats; of those of which few may be invisible or clamped, the leaves of a tree or all, as
            "checked"; and of the invisible among these, valid or not, as "unseen".
        valid: masks of valid splats, by the start of each block that has invalid ones.
        low, high: (3,) corners of the box of the centres of valid splats; infinite without any.
        layouts: loss of a sample in Spark's layouts.
    """

    by_name: Tallies
    valid: dict[int, Mask]
    low: FloatArray
    high: FloatArray
    layouts: LayoutLoss = field(default_factory=LayoutLoss)

    @classmethod
    def of(cls, block: Block, ends: Ends, *, layouts: bool = False) -> ValueTally:
        """Tally a block with the columns center, scale and opacity; losses in `layouts` take all columns."""
        opacity, most = block.splats.opacity, largest(block.splats.scale)
        furthest, invalid = largest(np.abs(block.splats.center)), block.splats.invalid()
        every = np.ones(len(opacity), np.bool_)
        valid = ~np.logical_or.reduce([~every, *invalid.values()])
        # Merged splats of thin leaves far apart may be fainter than any code, or larger.
        checked = every if block.tree is None else block.tree.is_leaf
        unseen = checked & ((opacity == 0) | (most == 0))
        masks = {
            **invalid,
            "all": every,
            "checked": checked,
            "unseen": unseen,
            "opaque": valid & (opacity > 1),
            "transparent": valid & (opacity == 0),
            "without scale": valid & (most == 0),
            "invisible": valid & unseen,
            "center": valid & (furthest >= ends.center),
            "far": valid & (furthest >= FLOAT16_END),
        }
        low, high = ends.scale
        if high < math.inf:  # `encoder.tally` says which clamped scales can be seen
            masks["small"] = checked & valid & (most > 0) & (most <= low)
            masks["large"] = checked & valid & (most >= high)
        center = block.splats.center[valid] if invalid else block.splats.center
        return cls(
            tallies(masks, block.start),
            {block.start: valid} if invalid else {},
            np.array([axis.min(initial=np.inf) for axis in center.T]),
            np.array([axis.max(initial=-np.inf) for axis in center.T]),
            sample_loss(block.splats, BLOCK_SAMPLE) if layouts else LayoutLoss(),
        )

    @classmethod
    def total(cls, parts: Iterable[ValueTally]) -> ValueTally:
        """Return the sum of the tallies of blocks, in their order."""
        every = list(parts)
        return cls(
            merged(part.by_name for part in every),
            {start: mask for part in every for start, mask in part.valid.items()},
            functools.reduce(np.minimum, (part.low for part in every), np.full(3, np.inf, np.float32)),
            functools.reduce(np.maximum, (part.high for part in every), np.full(3, -np.inf, np.float32)),
            LayoutLoss.total(part.layouts for part in every),
        )


def findings_about(tallied: Tallies, ends: Ends, *, merged_splats: bool) -> list[Finding]:
    """Return findings about the values of all splats of a file.

    Args:
        tallied: tallies of `ValueTally.by_name`.
        ends: ends of the ranges of stored values.
        merged_splats: whether the file can hold merged splats, whose opacity may be above 1.
    """
    if not tallied["all"].count:
        return [Finding("values.empty", "there are no splats")]
    findings: list[Finding] = []

    def report(code: str, name: str, text: str) -> None:
        findings.extend(tallied[name].finding(code, f"splat {{first}}{{rest}}: {text}"))

    for kind, (code, text) in OF_INVALID.items():
        report(code, kind, text)
    if not merged_splats:
        report("values.opacity", "opaque", "the opacity is above 1")
    if tallied["unseen"].count > MANY_INVISIBLE * tallied["checked"].count:
        report("values.invisible", "invisible", "cannot be drawn, as its opacity or scale is 0")
    if ends.center < math.inf:
        text = f"a coordinate is {ends.center:g}, the end of the range of its code"
        report("values.center-clamped", "center", text)
    for name, end in zip(("small", "large"), ends.scale, strict=True):
        leaves, visible = tallied["checked"].count, tallied[name].count
        if clamp_matters("scale", above=name == "large", visible=visible, leaves=leaves):
            text = f"a scale is {end:.2g}, the end of the range of its code; RAD with --rad-scales ln_f16 keeps such"
            report("values.scale-clamped", name, text)
    report("values.center-far", "far", f"a coordinate is {FLOAT16_END:,} or more, which float16 cannot hold")
    return findings


def hints_about(loss: LayoutLoss, sh_degree: int) -> list[str]:
    """Return a hint if one of Spark's layouts is visibly worse than the other."""
    ext, packed = loss.psnr("ext"), loss.psnr("packed")
    if min(ext, packed) >= VISIBLE_LOSS or abs(ext - packed) < LOSS_APART:
        return []
    if packed > ext:
        text = f"Spark's ExtSplats clip the SH ({ext:.0f} dB; PackedSplats {packed:.0f} dB)"
        return [f"{text}; leave out extSplats and pagedExtSplats"]
    text = f"Spark's PackedSplats clamp colours or round centres ({packed:.0f} dB; ExtSplats {ext:.0f} dB)"
    paged = " (pagedExtSplats of a paged file)" if sh_degree <= MOST_PAGED_DEGREE else ""
    return [f"{text}; set extSplats{paged}"]
