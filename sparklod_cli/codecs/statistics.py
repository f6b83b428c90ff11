"""`Statistics` of all splats of a file, from which the writer chooses options before it writes the first splat.

Statistics are small, and those of parts of a file can be merged in any order with the same result, so that a file need
not fit into memory. `Distribution` also serves `inspect`.
"""

from __future__ import annotations

import io
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model import MAX_SH_DEGREE
from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..system.threads import blocks_of, ordered_map
from . import quantize
from .quantize import ALL_BITS

#: A bin counts the float32 values with the same upper 16 bits: sign, exponent and 7 bits of the mantissa. Its ends
#: are at most 0.8 % apart.
_SHIFT, _BINS = 16, 1 << 16


@dataclass(frozen=True, eq=False)
class Distribution:
    """Histogram of float32 values with bins of equal relative width.

    Attributes:
        bins: (B,) int64 numbers of the bins with values, in the order of the values: bin 32768 begins at 0, and lower
            bins are negative.
        counts: (B,) int64 number of values in each bin.
        least, most: (B,) float32 smallest and largest value in each bin.
    """

    bins: NDArray[np.int64]
    counts: NDArray[np.int64]
    least: FloatArray
    most: FloatArray

    @classmethod
    def of(cls, values: FloatArray) -> Distribution:
        """Count the values of a float32 array of any shape; NaN goes to the last bin."""
        ordered = np.sort(values, axis=None) + np.float32(0)  # -0 becomes 0
        ordered[np.isnan(ordered)] = np.nan  # without a sign
        bits = ordered.view(np.uint32) >> np.uint32(_SHIFT)
        first = np.flatnonzero(np.diff(bits, prepend=~bits[:1]))
        ends = np.append(first, len(bits))[1:]
        bins = bits[first].astype(np.int64)
        bins = np.where(bins < _BINS // 2, bins + _BINS // 2, _BINS - 1 - bins)
        return cls(bins, ends - first, ordered[first], ordered[ends - 1])

    @classmethod
    def merged(cls, parts: Sequence[Distribution]) -> Distribution:
        """Merge at least one distribution; the order does not matter."""
        if len(parts) == 1:
            return parts[0]
        bins = np.concatenate([part.bins for part in parts])
        order = np.argsort(bins, kind="stable")
        first = np.flatnonzero(np.diff(bins[order], prepend=-1))
        counts, least, most = (np.concatenate([getattr(part, name) for part in parts])[order] for name in _COLUMNS)
        if len(first):  # `reduceat` takes no empty list
            counts, least = np.add.reduceat(counts, first), np.minimum.reduceat(least, first)
            most = np.maximum.reduceat(most, first)
        return cls(bins[order[first]], counts, least, most)

    @property
    def count(self) -> int:
        """Number of values."""
        return int(self.counts.sum())

    @property
    def lowest(self) -> float:
        """Smallest of all values and 0."""
        return float(self.least.min(initial=0))

    @property
    def highest(self) -> float:
        """Largest of all values and 0."""
        return float(self.most.max(initial=0))

    def magnitudes(self, sign: int) -> NDArray[np.int64]:
        """Return (32768,) counts of values of one sign, 1 or -1, by ascending magnitude (`UPPER`); 0 is positive."""
        counts = np.zeros(_BINS, np.int64)
        counts[self.bins] = self.counts
        return counts[_BINS // 2 :] if sign > 0 else counts[_BINS // 2 - 1 :: -1]

    def quantile(self, share: float) -> float:
        """Return a quantile, linearly interpolated as numpy does, with a relative error of at most 0.8 %.

        It is exact if the two neighbouring values lie in different bins. Returns infinity if a value is NaN, and 0 if
        there are no values.
        """
        if not len(self.counts):
            return 0.0
        if math.isnan(self.most[-1]):
            return math.inf
        until = np.cumsum(self.counts)
        place, ends = share * (int(until[-1]) - 1), list[float]()
        for rank in (math.floor(place), math.ceil(place)):
            row = int(np.searchsorted(until, rank, side="right"))
            count, least, most = int(self.counts[row]), float(self.least[row]), float(self.most[row])
            after = rank - (int(until[row]) - count)
            ends.append(least if least == most else least + (most - least) * after / (count - 1))
        (low, high), part = ends, place - math.floor(place)
        if low == high:
            return low
        return high - (high - low) * (1 - part) if part >= 0.5 else low + (high - low) * part


#: The columns of a `Distribution` beside its bins.
_COLUMNS = ("counts", "least", "most")


#: Lower and upper ends of the 32,768 bins of magnitudes, from 0 up. The last bins are those of infinity and NaN.
_BITS = np.arange(_BINS // 2 + 1, dtype=np.uint32) << np.uint32(_SHIFT)
with np.errstate(invalid="ignore"):
    LOWER, UPPER = (_BITS.view(np.float32)[ends].astype(np.float64) for ends in (slice(-1), slice(1, None)))


def tops(counts: NDArray[np.int64], total: int, most: float, beyond: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest magnitudes above which at most given shares of values lie.

    Args:
        counts: (32768,) counts by magnitude, see `Distribution.magnitudes`.
        total: number of all values, of which `beyond` are shares.
        most: largest magnitude.
        beyond: (n,) shares.
    """
    above = np.cumsum(counts[::-1])[::-1]  # values in each bin and all larger ones
    first = [int(np.count_nonzero(above > share * total)) for share in beyond]
    return np.minimum([UPPER[each - 1] if each else 0.0 for each in first], most)


#: Largest root mean square change of a colour, over splats and directions, by dropped bits of SH. It costs what a PSNR
#: of 58 dB or more means, see docs/decisions/08-rounding.md.
LARGEST_ERROR = 0.009

#: Splats whose SH are counted at a time: they and their codes fit into the processor's cache.
_SH_ROWS = 1 << 13


def sh_code_counts(sh: FloatArray) -> tuple[NDArray[np.int64], int]:
    """Count (N, K, 3) SH coefficients by their bytes in SPZ.

    Returns:
        (degrees, 256) int64 numbers of coefficients by degree and code, and the number of those between two codes.
    """
    counts, between = np.zeros((MAX_SH_DEGREE, 256), np.int64), 0
    for start in range(0, len(sh), _SH_ROWS):
        part = sh[start : start + _SH_ROWS]
        codes = quantize.encode_sh(part, ALL_BITS)
        between += int(np.count_nonzero(quantize.decode_sh(codes) != part))
        for degree in range(MAX_SH_DEGREE):
            own = codes[:, COEFFICIENTS[degree] : COEFFICIENTS[degree + 1]]
            counts[degree] += np.bincount(own.reshape(-1), minlength=256)
    return counts, between


def sh_error(counts: NDArray[np.int64], bits: int) -> float:
    """Return the root mean square change of a colour, over splats and directions, if SH keep this many bits.

    The mean square of a basis function over all directions is 1 / (4 * pi). `counts` are those of `sh_code_counts`.
    """
    codes = np.broadcast_to(np.arange(256, dtype=np.uint8)[:, None, None], (256, COEFFICIENTS[MAX_SH_DEGREE], 3))
    whole = quantize.decode_sh(np.ascontiguousarray(codes))
    square = np.square(quantize.decode_sh(quantize.encode_sh(whole, bits)) - whole, dtype=np.float64)[:, :, 0]
    total = 0.0
    for degree, row in enumerate(counts):
        if row.any():
            total += (2 * degree + 3) * float(row @ square[:, COEFFICIENTS[degree]]) / float(row.sum())
    return math.sqrt(total / (4 * math.pi))


def enough(counts: NDArray[np.int64], between: int) -> int:
    """Return the fewest bits of the SH of leaves, counted by `sh_code_counts`, whose error is within `LARGEST_ERROR`.

    If all coefficients are codes, such as those from an SPZ file, none may change, however often they are rewritten.
    """
    most = LARGEST_ERROR if between else 0.0
    every = range(quantize.LEAST_SH_BITS, ALL_BITS)
    return next((bits for bits in every if sh_error(counts, bits) <= most), ALL_BITS)


#: A step of positions is at most a 16th of the standard deviation of a small splat, so that rounding moves it by at
#: most a 32nd. The largest scale of a small splat is that of this quantile. See docs/decisions/05-spz.md.
STEPS_A_SPLAT, SMALL_QUANTILE = 16, 0.01

#: Fractional bits of the smallest float32, with which no position is rounded.
EXACT_BITS = 149


def fine_bits(leaf_scale: Distribution) -> int:
    """Return the fractional bits that make a step of positions small for a small leaf, see `STEPS_A_SPLAT`.

    Returns `EXACT_BITS` if the size of small leaves is 0 or not finite.
    """
    small = leaf_scale.quantile(SMALL_QUANTILE)
    return math.ceil(math.log2(STEPS_A_SPLAT / small)) if 0 < small < math.inf else EXACT_BITS


#: Names of statistics. Of leaves, or of splats without a tree: the largest scale, the length over the width, and the
#: bytes of SH. Of all splats: the largest coordinate, and three columns.
ALL = frozenset(("reach", "leaf_scale", "leaf_length", "leaf_sh", "rgb", "scale", "sh"))

#: Splats that a thread counts at a time.
_BLOCK = 1 << 16


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of splats; those that were not requested are missing.

    Attributes:
        tree: the splats are nodes of a tree.
        reach: largest magnitude of a coordinate.
        values: distributions of "leaf_scale", "leaf_length", "rgb", "scale", "sh1", "sh2" and "sh3", see `ALL`.
        leaf_sh, sh_between: `sh_code_counts` of leaves, or of splats without a tree; None without SH.
    """

    count: int
    sh_degree: int
    tree: bool
    reach: float | None = None
    values: Mapping[str, Distribution] = field(default_factory=dict)
    leaf_sh: NDArray[np.int64] | None = None
    sh_between: int = 0

    @classmethod
    def of(
        cls, splats: Splats, leaf: NDArray[np.bool_] | None = None, needed: Collection[str] = ALL, threads: int = 1
    ) -> Statistics:
        """Count N splats or nodes.

        Args:
            leaf: (N,) mask of the nodes that are leaves; None for splats without a tree.
            needed: names of statistics, of `ALL`.
        """

        def count(part: slice) -> Statistics:
            block, leaves = splats.take(part), slice(None) if leaf is None or leaf[part].all() else leaf[part]
            reach, leaf_sh, between = None, None, 0
            if "reach" in needed:
                reach = float(np.maximum(block.center.max(initial=0), -block.center.min(initial=0)))  # NaN stays
            columns = {name: getattr(block, name) for name in ("rgb", "scale") if name in needed}
            if "leaf_scale" in needed:
                columns["leaf_scale"] = np.maximum.reduce(block.scale[leaves].T)
            if "leaf_length" in needed:
                columns["leaf_length"] = lengths(block.scale[leaves])
            if "leaf_sh" in needed and block.sh_degree:
                leaf_sh, between = sh_code_counts(block.sh[leaves])
            if "sh" in needed:
                for degree in range(1, block.sh_degree + 1):
                    columns[f"sh{degree}"] = block.sh[:, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]]
            values = {name: Distribution.of(column) for name, column in columns.items()}
            return cls(len(block), block.sh_degree, leaf is not None, reach, values, leaf_sh, between)

        blocks = blocks_of(len(splats), _BLOCK) or [slice(0)]
        return cls.merged(list(ordered_map(count, blocks, threads)))

    @classmethod
    def of_scene(cls, scene: Scene, needed: Collection[str] = ALL, *, threads: int = 1) -> Statistics:
        """Count the splats of a scene."""
        return cls.of(scene.splats, None if scene.tree is None else scene.tree.is_leaf, needed, threads)

    @classmethod
    def merged(cls, parts: Sequence[Statistics]) -> Statistics:
        """Merge the statistics of at least one part; raises ValueError if they differ in SH degree or `tree`."""
        first = parts[0]
        if {(part.sh_degree, part.tree) for part in parts} != {(first.sh_degree, first.tree)}:
            raise ValueError("statistics of splats of several SH degrees, or of splats and nodes, cannot be merged")
        leaf_sh = [part.leaf_sh for part in parts if part.leaf_sh is not None]
        return cls(
            sum(part.count for part in parts),
            first.sh_degree,
            first.tree,
            None if first.reach is None else float(np.max([part.reach for part in parts])),
            {name: Distribution.merged([part.values[name] for part in parts]) for name in first.values},
            np.sum(leaf_sh, axis=0) if leaf_sh else None,
            sum(part.sh_between for part in parts),
        )

    def array(self) -> NDArray[np.uint8]:
        """Encode the statistics as an array of bytes, tens of KB, for `from_array`."""
        columns = {name: value for name, value in vars(self).items() if name != "values" and value is not None}
        columns |= {f"{name}.{key}": value for name, part in self.values.items() for key, value in vars(part).items()}
        file = io.BytesIO()
        np.savez_compressed(file, **columns)
        return np.frombuffer(file.getvalue(), np.uint8)

    @classmethod
    def from_array(cls, array: NDArray[np.uint8]) -> Statistics:
        """Decode statistics from the result of `array`."""
        facts: dict[str, Any] = {}
        parts: dict[str, dict[str, Any]] = {}
        with np.load(io.BytesIO(array.tobytes()), allow_pickle=False) as file:
            for key, value in file.items():
                name, _, column = key.partition(".")
                place = parts.setdefault(name, {}) if column else facts
                place[column or name] = value if value.ndim else value.item()
        return cls(**facts, values={name: Distribution(**columns) for name, columns in parts.items()})


def lengths(scale: FloatArray) -> FloatArray:
    """Return the (N,) ratios of the largest and the middle scale of splats; 1 if the middle scale is 0."""
    x, y, z = scale.T
    largest = np.maximum(np.maximum(x, y), z)
    middle = np.maximum(np.minimum(x, y), np.minimum(np.maximum(x, y), z))
    with np.errstate(divide="ignore", over="ignore"):
        return np.divide(largest, middle, out=np.ones_like(largest), where=middle > 0)
