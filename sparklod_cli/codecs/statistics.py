"""`Statistics`: what has to be known of all splats of a file before the first of them can be written.

They are counted in any pieces, merged in any order with the same outcome, and small: a file that does not fit into
memory is settled by those of its pieces.
"""

from __future__ import annotations

import io
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..system.defaults import MAX_SH_DEGREE
from ..system.threads import blocks_of, ordered_map
from . import quantize

#: A bin has the float32 of the same upper bits: sign, exponent and 7 bits of the mantissa, so its ends are at most
#: 0.8 % apart.
_SHIFT = 16
_BINS = 1 << 15

#: Values that are counted at a time: they and their bins stay in the processor's cache.
_VALUES = 1 << 17


def _of_bins(bins: NDArray[np.uint32]) -> NDArray[np.float64]:
    return (bins << np.uint32(_SHIFT)).view(np.float32).astype(np.float64)


#: Ends of the bins. The last ones are of infinity and NaN.
with np.errstate(invalid="ignore", over="ignore"):
    UPPER = _of_bins(np.arange(1, _BINS + 1, dtype=np.uint32))
    LOWER = _of_bins(np.arange(_BINS, dtype=np.uint32))


@dataclass(frozen=True, eq=False)
class Magnitudes:
    """Counts of positive and of negative values.

    Attributes:
        positive, negative: (bins,) counts by magnitude, ascending; 0 is positive, -0 negative.
        lowest, highest: of all values and 0.
    """

    positive: NDArray[np.int64]
    negative: NDArray[np.int64]
    lowest: float
    highest: float

    @classmethod
    def of(cls, values: FloatArray) -> Magnitudes:
        """Count all values of (N, ...) float32."""
        counts, lowest, highest = np.zeros(2 * _BINS, np.int64), 0.0, 0.0
        rows = max(1, _VALUES * len(values) // max(values.size, 1))
        for start in range(0, len(values), rows):
            flat = np.ascontiguousarray(values[start : start + rows], np.float32).reshape(-1)
            lowest, highest = min(lowest, float(flat.min(initial=0))), max(highest, float(flat.max(initial=0)))
            counts += np.bincount(flat.view(np.uint32) >> np.uint32(_SHIFT), minlength=2 * _BINS)
        return cls(counts[:_BINS], counts[_BINS:], lowest, highest)

    @classmethod
    def merged(cls, parts: Sequence[Magnitudes]) -> Magnitudes:
        """Merge the counts of one part or more, in any order."""
        positive = np.sum([part.positive for part in parts], axis=0)
        negative = np.sum([part.negative for part in parts], axis=0)
        return cls(positive, negative, min(part.lowest for part in parts), max(part.highest for part in parts))

    @property
    def count(self) -> int:
        """Number of values."""
        return int(self.positive.sum() + self.negative.sum())


def tops(counts: NDArray[np.int64], total: int, most: float, beyond: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the magnitudes above which lie at most these shares of `total` values; `most` is the largest magnitude."""
    above = np.cumsum(counts[::-1])[::-1]  # of each bin and all larger ones
    first = [int(np.count_nonzero(above > share * total)) for share in beyond]
    return np.minimum([UPPER[each - 1] if each else 0.0 for each in first], most)


#: Where the binades of float32 begin, those of subnormal numbers, too; what is below the first is 0. Last is infinity.
ENDS = np.append(np.ldexp(np.float32(1), np.arange(-149, 128, dtype=np.int32)), np.float32(np.inf))

#: Values that are sorted at a time.
_SORTED_ROWS = 1 << 18


@dataclass(frozen=True, eq=False)
class Binades:
    """Counts of values of at least 0, by binade: the range from a power of two to the next.

    Attributes:
        count: (binades,) int64: of 0, then of each binade, then of infinity.
        least, most: (binades,) float64 smallest and largest value of each; infinity and 0 of empty ones.
        unknown: the number of values that are not a number.
    """

    count: NDArray[np.int64]
    least: NDArray[np.float64]
    most: NDArray[np.float64]
    unknown: int = 0

    @classmethod
    def of(cls, values: FloatArray) -> Binades:
        """Count (N,) float32 values of at least 0."""
        parts = [
            cls._of_sorted(np.sort(values[start : start + _SORTED_ROWS]))
            for start in range(0, len(values), _SORTED_ROWS)
        ]
        return cls.merged(parts) if parts else cls._of_sorted(values)

    @classmethod
    def _of_sorted(cls, values: FloatArray) -> Binades:
        known = len(values) - int(np.count_nonzero(np.isnan(values)))  # which are last
        at = np.concatenate([[0], np.searchsorted(values[:known], ENDS), [known]])
        count = np.diff(at)
        least, most = np.full(len(count), np.inf), np.zeros(len(count))
        filled = np.flatnonzero(count)
        least[filled], most[filled] = values[at[filled]], values[at[filled + 1] - 1]
        return cls(count, least, most, len(values) - known)

    @classmethod
    def merged(cls, parts: Sequence[Binades]) -> Binades:
        """Merge the counts of one part or more, in any order."""
        return cls(
            np.sum([part.count for part in parts], axis=0),
            np.min([part.least for part in parts], axis=0),
            np.max([part.most for part in parts], axis=0),
            sum(part.unknown for part in parts),
        )

    def quantile(self, share: float) -> float:
        """Return a value of the same binade as the quantile of all values, linearly interpolated as numpy does.

        It is the quantile itself where the values on either side of it lie in two binades. Infinity where a value
        is not a number; 0 of no values.
        """
        if self.unknown:
            return float("inf")
        total = int(self.count.sum())
        if not total:
            return 0.0
        place = share * (total - 1)
        rank = int(place)
        until = np.cumsum(self.count)
        first, second = np.searchsorted(until, [rank, min(rank + 1, total - 1)], side="right")
        if first == second:
            return float(self.least[first])
        low, high = float(self.most[first]), float(self.least[second])
        return low + (high - low) * (place - rank)


#: All bits of a byte.
ALL_BITS = 8

#: Largest root mean square, over splats and directions, of what dropping bits changes of a splat's colour: with
#: it, SH alone cost what 58 dB and more are, see docs/decisions/08-rounding.md.
LARGEST_ERROR = 0.009

#: Splats that are counted at a time: they and their codes stay in the processor's cache.
_SH_ROWS = 1 << 13


@dataclass(frozen=True, eq=False)
class ShBytes:
    """Counts of SH as bytes of SPZ: (degrees, 256) int64 of each code, and how many coefficients have none exactly."""

    count: NDArray[np.int64]
    between: int

    @classmethod
    def of(cls, sh: FloatArray) -> ShBytes:
        """Count (N, K, 3) coefficients."""
        count, between = np.zeros((MAX_SH_DEGREE, 256), np.int64), 0
        for start in range(0, len(sh), _SH_ROWS):
            part = sh[start : start + _SH_ROWS]
            codes = quantize.encode_sh(part, ALL_BITS)
            between += int(np.count_nonzero(quantize.decode_sh(codes) != part))
            for degree in range(MAX_SH_DEGREE):
                own = codes[:, COEFFICIENTS[degree] : COEFFICIENTS[degree + 1]]
                count[degree] += np.bincount(own.reshape(-1), minlength=256)
        return cls(count, between)

    @classmethod
    def merged(cls, parts: Sequence[ShBytes]) -> ShBytes:
        """Merge the counts of one part or more, in any order."""
        return cls(np.sum([part.count for part in parts], axis=0), sum(part.between for part in parts))

    def error(self, bits: int) -> float:
        """Return the root mean square that keeping so many bits changes of a colour, over splats and directions.

        The mean square of a basis function over all directions is 1 / (4 * pi).
        """
        codes = np.broadcast_to(np.arange(256, dtype=np.uint8)[:, None, None], (256, COEFFICIENTS[MAX_SH_DEGREE], 3))
        whole = quantize.decode_sh(np.ascontiguousarray(codes))
        square = np.square(quantize.decode_sh(quantize.encode_sh(whole, bits)) - whole, dtype=np.float64)[:, :, 0]
        total = 0.0
        for degree, count in enumerate(self.count):
            if count.any():
                coefficients = 2 * degree + 3
                total += coefficients * float(count @ square[:, COEFFICIENTS[degree]]) / float(count.sum())
        return math.sqrt(total / (4 * math.pi))


def enough(found: ShBytes) -> int:
    """Return the fewest bits of the SH of full detail of which `LARGEST_ERROR` is true; all of SH that are such codes.

    Those come from SPZ, and stay as they are, however often they are written.
    """
    most = LARGEST_ERROR if found.between else 0.0
    every = range(quantize.LEAST_SH_BITS, ALL_BITS)
    return next((bits for bits in every if found.error(bits) <= most), ALL_BITS)


#: A step of the positions is at most a 16th of the standard deviation of a small splat, so that rounding shifts it by
#: at most a 32nd; small are the splats at this quantile of the largest scales. See docs/decisions/05-spz.md.
STEPS_A_SPLAT, SMALL_QUANTILE = 16, 0.01


#: Fractional bits of the smallest float32: with these, nothing is rounded.
EXACT_BITS = 149


def fine_bits(leaf_scale: Binades) -> int:
    """Return the fractional bits with which a step is far below the smallest splats of full detail (`STEPS_A_SPLAT`).

    A step is a power of two, so the binade of the small splats is all that matters; without a size, `EXACT_BITS`.
    """
    small = leaf_scale.quantile(SMALL_QUANTILE)
    return math.ceil(math.log2(STEPS_A_SPLAT / small)) if 0 < small < math.inf else EXACT_BITS


#: What can be counted: the largest coordinate, the largest scale of each leaf, how many times as long as wide it is,
#: the SH bytes of leaves, and the magnitudes of columns.
ALL = frozenset(("reach", "leaf_scale", "leaf_length", "leaf_sh", "rgb", "scale", "sh"))

#: Splats that a thread counts at a time. Counts take some 2 MB.
_BLOCK = 1 << 16


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of splats; those that were not requested are None.

    Attributes:
        count: N splats, which are nodes where there is a tree.
        sh_degree: of them.
        tree: whether they are nodes of a tree.
        reach: the largest magnitude of a coordinate.
        leaf_scale: the largest scale of each leaf, or splat where there is no tree.
        magnitudes: of the values of "rgb", "scale", "sh1", "sh2" and "sh3".
        leaf_sh: SH of leaves, or of splats where there is no tree; None without SH.
        leaf_length: of each leaf, or splat where there is no tree, the largest scale as a multiple of the middle one.
    """

    count: int
    sh_degree: int
    tree: bool
    reach: float | None = None
    leaf_scale: Binades | None = None
    magnitudes: Mapping[str, Magnitudes] = field(default_factory=dict)
    leaf_sh: ShBytes | None = None
    leaf_length: Binades | None = None

    @classmethod
    def of(cls, splats: Splats, leaf: NDArray[np.bool_] | None = None, needed: Collection[str] = ALL) -> Statistics:
        """Count N splats or nodes.

        Args:
            leaf: (N,) which nodes are leaves; None for splats that are no nodes.
            needed: what to count, of `ALL`.
        """
        reach, leaf_scale, leaf_length = None, None, None
        if "reach" in needed:
            center = splats.center
            reach = float(np.maximum(center.max(initial=0), -center.min(initial=0)))  # NaN stays
        if "leaf_scale" in needed:
            scale = splats.scale if leaf is None else splats.scale[leaf]
            leaf_scale = Binades.of(np.maximum.reduce(scale.T))
        if "leaf_length" in needed:
            leaf_length = Binades.of(lengths(splats.scale if leaf is None else splats.scale[leaf]))
        leaf_sh = None
        if "leaf_sh" in needed and splats.sh_degree:
            leaf_sh = ShBytes.of(splats.sh if leaf is None else splats.sh[leaf])
        columns = {name: getattr(splats, name) for name in ("rgb", "scale") if name in needed}
        if "sh" in needed:
            for degree in range(1, splats.sh_degree + 1):
                columns[f"sh{degree}"] = splats.sh[:, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]]
        magnitudes = {name: Magnitudes.of(values) for name, values in columns.items()}
        return cls(len(splats), splats.sh_degree, leaf is not None, reach, leaf_scale, magnitudes, leaf_sh, leaf_length)

    @classmethod
    def of_scene(cls, scene: Scene, needed: Collection[str] = ALL, *, threads: int = 1) -> Statistics:
        """Count the splats of a scene."""
        return cls._of_blocks(scene.splats, None if scene.tree is None else scene.tree.is_leaf, needed, threads)

    @classmethod
    def of_leaves(cls, splats: Splats, needed: Collection[str] = ALL, *, threads: int = 1) -> Statistics:
        """Count splats that will be the leaves of a tree, for `of_tree`."""
        return cls._of_blocks(splats, np.ones(len(splats), np.bool_), needed, threads)

    @classmethod
    def of_tree(
        cls, scene: Scene, leaves: Statistics, needed: Collection[str] = ALL, *, threads: int = 1
    ) -> Statistics:
        """Count as `of_scene` the nodes of a tree whose `leaves` `of_leaves` has counted for the same needs."""
        assert scene.tree is not None
        inner = scene.splats.take(np.flatnonzero(scene.tree.child_count))
        return cls.merged([leaves, cls._of_blocks(inner, np.zeros(len(inner), np.bool_), needed, threads)])

    @classmethod
    def _of_blocks(
        cls, splats: Splats, leaf: NDArray[np.bool_] | None, needed: Collection[str], threads: int
    ) -> Statistics:
        """Count as `of`, block by block."""

        def count(part: slice) -> Statistics:
            return cls.of(splats.take(part), None if leaf is None else leaf[part], needed)

        found: Statistics | None = None
        for some in ordered_map(count, blocks_of(len(splats), _BLOCK), threads):
            found = some if found is None else cls.merged([found, some])
        return cls.of(splats, leaf, needed) if found is None else found

    @classmethod
    def merged(cls, parts: Sequence[Statistics]) -> Statistics:
        """Merge the statistics of one part or more, for the same needs.

        Raises:
            ValueError: the parts are not of one scene: they differ in SH degree, or in whether they have a tree.
        """
        first = parts[0]
        if {(part.sh_degree, part.tree) for part in parts} != {(first.sh_degree, first.tree)}:
            raise ValueError("statistics of splats of several SH degrees, or of splats and nodes, cannot be merged")
        return cls(
            sum(part.count for part in parts),
            first.sh_degree,
            first.tree,
            None if first.reach is None else float(np.max([part.reach for part in parts])),
            None if first.leaf_scale is None else Binades.merged([_known(part.leaf_scale) for part in parts]),
            {name: Magnitudes.merged([part.magnitudes[name] for part in parts]) for name in first.magnitudes},
            None if first.leaf_sh is None else ShBytes.merged([part.leaf_sh for part in parts if part.leaf_sh]),
            None if first.leaf_length is None else Binades.merged([_known(part.leaf_length) for part in parts]),
        )

    def array(self) -> NDArray[np.uint8]:
        """Return the bytes of these statistics, tens of KB, from which `from_array` makes them again."""
        columns: dict[str, Any] = {"facts": [self.count, self.sh_degree, self.tree]}
        if self.reach is not None:
            columns["reach"] = self.reach
        of_leaves = {"leaf_scale": self.leaf_scale, "leaf_length": self.leaf_length, "leaf_sh": self.leaf_sh}
        parts = {**of_leaves, **self.magnitudes}
        for name, part in parts.items():
            if part is None:
                continue
            columns |= {f"{name}.{key}": value for key, value in vars(part).items()}
        file = io.BytesIO()
        np.savez_compressed(file, **columns)
        return np.frombuffer(file.getvalue(), np.uint8)

    @classmethod
    def from_array(cls, array: NDArray[np.uint8]) -> Statistics:
        """Return the statistics of `array`."""
        with np.load(io.BytesIO(array.tobytes()), allow_pickle=False) as file:
            columns = {name: values.item() if values.ndim == 0 else values for name, values in file.items()}
        count, sh_degree, tree = columns.pop("facts").tolist()
        reach = columns.pop("reach", None)
        parts: dict[str, dict[str, Any]] = {}
        for name, value in columns.items():
            column, key = name.split(".")
            parts.setdefault(column, {})[key] = value
        leaf_scale, leaf_length = (
            None if found is None else Binades(**found)
            for found in (parts.pop("leaf_scale", None), parts.pop("leaf_length", None))
        )
        sh = parts.pop("leaf_sh", None)
        leaf_sh = None if sh is None else ShBytes(**sh)
        magnitudes = {name: Magnitudes(**found) for name, found in parts.items()}
        return cls(count, sh_degree, bool(tree), reach, leaf_scale, magnitudes, leaf_sh, leaf_length)


def lengths(scale: FloatArray) -> FloatArray:
    """Return (N,) the largest scale of splats by the middle one; 1 for those of no width."""
    x, y, z = scale.T
    largest = np.maximum(np.maximum(x, y), z)
    middle = np.maximum(np.minimum(x, y), np.minimum(np.maximum(x, y), z))
    with np.errstate(divide="ignore", over="ignore"):
        return np.divide(largest, middle, out=np.ones_like(largest), where=middle > 0)


def _known(found: Binades | None) -> Binades:
    assert found is not None, "the parts were asked for different statistics"
    return found
