"""Statistics of the values of an SPZ file by its codes: bytes are counted, and what each stands for is decoded once."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..codecs.kernels.spz_codes import (
    HALF_BITS,
    LOWEST,
    count_bytes,
    count_ends,
    count_halves,
    count_squares,
)
from ..codecs.quantize import Bytes
from ..codecs.spz_coded import CodedSpz
from ..model.nodes import CHUNK_NODES
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..support.defaults import MAX_SH_DEGREE
from ..support.parallel import blocks_of, ordered_map
from .percentiles import Known, Percentiles, ranks_of
from .values import AXES, LEVELS, MAIN, SH_QUANTITIES, ValueFacts, facts_of, needed, quantity

#: Quantities of each column of bytes.
OF_BYTES = {"opacity": ("opacity",), "rgb": ("red", "green", "blue")}
OF_SCALES = ("scale", "scale_min", "anisotropy")

#: Steps of SH codes in 1, and the largest square of a code's steps.
SH_STEPS, MOST_SQUARED = 128, 128**2

#: What was counted: the names of quantities, and their numbers.
Found = dict[str, Known | Percentiles]


class Watched:
    """Counts codes while they are read, so that they need not be kept.

    Args:
        all_quantities: of all quantities, not only those of `MAIN`.

    Attributes:
        opacities: (1, 256) number of each code.
        watch: what is called with the codes of a file.
    """

    def __init__(self, *, all_quantities: bool) -> None:
        self.all_quantities = all_quantities
        self.opacities, self._colors = np.zeros((1, 256), np.int64), np.zeros((3, 256), np.int64)
        self._squares: dict[int, NDArray[np.int64]] = {}  # by degree, counted from 0
        self.watch: dict[str, Callable[[Bytes], None]] = {"opacity": lambda codes: count_bytes(codes, self.opacities)}
        if all_quantities:
            self.watch |= {"rgb": lambda codes: count_bytes(codes, self._colors), "sh": self._add_sh}

    def _add_sh(self, codes: Bytes) -> None:
        for degree in range(MAX_SH_DEGREE):
            first, last = 3 * COEFFICIENTS[degree], 3 * COEFFICIENTS[degree + 1]
            if last <= codes.shape[1]:
                counts = self._squares.setdefault(degree, np.zeros(0, np.int64))
                if not len(counts):
                    counts = self._squares[degree] = np.zeros((last - first) * MOST_SQUARED + 1, np.int64)
                count_squares(codes, first, last, counts)

    def found(self, coded: CodedSpz) -> Found:
        """The quantities of opacities, colours and SH, after the last codes."""
        found = _of_bytes(coded, "opacity", self.opacities)
        if self.all_quantities:
            found |= _of_bytes(coded, "rgb", self._colors)
        for degree, counts in self._squares.items():
            # The root mean square of the coefficients of a degree, of their whole numbers of steps.
            squares, numbers = np.flatnonzero(counts), (len(counts) - 1) // MOST_SQUARED
            values = np.sqrt(squares / SH_STEPS**2 / numbers)
            found[SH_QUANTITIES[degree]] = Known.of_counts(LEVELS, values, counts[squares])
        return found


def examine(coded: CodedSpz, size: FloatArray | None, watched: Watched, *, threads: int) -> ValueFacts:
    """Statistics of the splats of a sound file, as `values.Statistics` has them; means may differ in their last bits.

    Args:
        coded: of at least one splat.
        size: (N,) float32 feature sizes, if they are known.
        watched: has seen all codes.
        threads: to work on.
    """
    all_quantities, opacities = watched.all_quantities, watched.opacities
    names = needed(coded.sh_degree, all_quantities=all_quantities)
    scales = _count_ends(coded.codes["scales"])
    shown = [name for name in names if all_quantities or name in MAIN]
    # Those that take longest first.
    work: list[Callable[[], Found]] = [functools.partial(_of_axis, coded, axis) for axis in range(3)]
    if all_quantities:
        work = [
            lambda: {"size": _of_numbers(_sizes(coded) if size is None else size)},
            *work,
        ]
    numbers: Found = watched.found(coded) | _of_scales(coded, scales, names)
    for found in ordered_map(lambda each: each(), work, threads):
        numbers |= found
    low, high = (np.array([numbers[axis].values()[end] for axis in AXES]) for end in (0, -1))
    opacity, largest = coded.table("opacity"), coded.table("scale")
    counts = {
        "good": coded.count,
        "non_finite": 0,
        "negative_scale": 0,
        "zero_opacity": int(opacities[0, opacity == 0].sum()),
        "zero_scale": int(scales[largest == 0].sum()),
        "more_than_opaque": int(opacities[0, opacity > 1].sum()),
    }
    return facts_of(counts, low, high, numbers, shown)


def _sizes(coded: CodedSpz) -> FloatArray:
    found = np.empty(coded.count, np.float32)
    coded.fill_sizes(slice(None), found)
    return found


def _of_numbers(values: FloatArray) -> Percentiles:
    found = Percentiles(LEVELS, values.dtype)
    while found.passes:
        for part in blocks_of(len(values), CHUNK_NODES):
            found.add(values[part])
        found.end_pass()
    return found


def _palette(count: int, **columns: FloatArray) -> Splats:
    """Splats with these columns; the others are 0."""
    splats = Splats.zeros(count, 0)
    for name, values in columns.items():
        getattr(splats, name)[...] = values
    return splats


def _count_ends(codes: Bytes) -> NDArray[np.int64]:
    counts = np.zeros((256, 256), np.int64)
    count_ends(codes, counts)
    return counts


def _of_bytes(coded: CodedSpz, column: str, counts: NDArray[np.int64]) -> Found:
    """The quantities of a column, each of which is a byte."""
    table = coded.table(column)
    splats = _palette(256, **{column: table if len(counts) == 1 else np.stack([table] * len(counts), axis=1)})
    return {
        name: Known.of_counts(LEVELS, quantity(splats, name), row)
        for name, row in zip(OF_BYTES[column], counts, strict=True)
    }


def _of_scales(coded: CodedSpz, counts: NDArray[np.int64], names: list[str]) -> Found:
    """The quantities of the largest and the smallest scale of a splat."""
    most, least = np.nonzero(counts)
    table = coded.table("scale")
    splats = _palette(len(most), scale=np.stack([table[most], table[least], table[least]], axis=1))
    return {
        name: Known.of_counts(LEVELS, quantity(splats, name), counts[most, least])
        for name in OF_SCALES
        if name in names
    }


def _of_axis(coded: CodedSpz, axis: int) -> Found:
    """A coordinate: the upper halves of its bits, then the lower halves of those that have a percentile."""
    codes, half = coded.codes["positions"], 1 << HALF_BITS
    upper = np.zeros((1, half), np.int64)
    total = count_halves(codes, axis, HALF_BITS, np.zeros(half, np.int16), upper)
    ranks = ranks_of(LEVELS, coded.count)
    asked = np.unique(np.searchsorted(np.cumsum(upper[0]), ranks, "right"))
    rows = np.full(half, -1, np.int16)
    rows[asked] = np.arange(len(asked))
    lower = np.zeros((len(asked), half), np.int64)
    count_halves(codes, axis, 0, rows, lower)
    # All others stand for their half, since only their number matters.
    others = np.setdiff1d(np.flatnonzero(upper[0]), asked)
    keys = np.concatenate([((asked[:, None] << HALF_BITS) + np.arange(half)).ravel(), others << HALF_BITS]) - LOWEST
    step = 2.0**-coded.layout.fractional_bits
    known = Known.of_counts(LEVELS, keys * step, np.concatenate([lower.ravel(), upper[0, others]]))
    return {AXES[axis]: replace(known, mean=total * step / coded.count)}
