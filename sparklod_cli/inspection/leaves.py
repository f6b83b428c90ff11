"""Check that the leaves of a tree are the splats of the file that it was baked from."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..codecs import quantize
from ..codecs.rad.property_codings import CODINGS, PROPERTIES, Row
from ..codecs.rad.rad_writer import rounded
from ..codecs.spark_codings import STEPS_8_8_8, encode_axis_angle, encode_lod_alpha
from ..codecs.spz import LOD, Layout, to_code
from ..codecs.statistics import Distribution, enough, fine_bits, sh_code_counts
from ..model.scene import Scene
from ..model.selection import Selection
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..system.errors import InvalidSplatsError
from ..system.units import count_of
from .findings import Finding
from .headers import PropertyFacts, RadFacts

#: Largest differences between codes of one splat, as writers round, truncate or go through float16. SPZ's codes of SH
#: keep the upper bits only, so that one step is a bucket of 16; logarithms of scales as float32 differ in last bits.
STEPS, SH_STEPS, F32_STEPS = 1, 16, 64

#: Largest angle in degrees between two codes of one rotation, by the bytes of an SPZ code and by RAD's encoding. RAD's
#: f16 and f32 omit w, which is less exact near 0.
DEGREES = {3: 14.0, 4: 0.8}
RAD_DEGREES = {"oct88r8": 4.0, "f16": 4.0, "f32": 0.2}

#: Columns of SPZ whose codes may differ by a step, in the order of `CodedSplats.numbers`.
COLUMNS = ("center", "opacity", "rgb", "scale", "sh")

#: Most bits after the binary point of rounded centres, as in SPZ.
MOST_BITS = 24

#: Encodings of RAD that are others with their bytes reordered, which compresses better.
PLAIN = {"f32_lebytes": "f32", "f16_lebytes": "f16", "r8_delta": "r8", "s8_delta": "s8"}


@dataclass(frozen=True)
class CodedSplats:
    """N splats as codes.

    Attributes:
        rows: (N,) all bytes of each splat as one value.
        numbers: (N, n) codes; the first three are of the centre.
        quat_xyzw: (N, 4).
    """

    rows: NDArray[np.void]
    numbers: NDArray[np.int32]
    quat_xyzw: NDArray[np.float32]


@dataclass(frozen=True)
class LeafCoding:
    """Coding of splats as integers, in which the splats of two files are compared.

    Attributes:
        steps: (n,) largest differences of `CodedSplats.numbers` for the same splat.
        degrees: largest angle between the rotations of the same splat.
    """

    encode: Callable[[Splats], CodedSplats]
    steps: NDArray[np.int64]
    degrees: float


def codings_of(scene: Scene, leaves: Splats, original: Splats, facts: RadFacts | None) -> Iterator[LeafCoding | str]:
    """Yield the encodings that may have turned `original` into the leaves, the most likely first.

    An encoding that cannot be imitated is a string, which says why.
    """
    if facts is None:
        yield from (of_spz(scene, leaves, covering=covering) for covering in (True, False))
        return
    # RAD does not store the number of bits to which centres were rounded: by default it follows from the scales.
    scales, bits = Distribution.of(np.maximum.reduce(original.scale.T)), _fractional_bits(leaves.center)
    for guess, covering in ((fine_bits(scales), True), (bits, True), (bits, False)):
        yield of_rad(facts, leaves, guess, covering=covering)


def of_spz(scene: Scene, leaves: Splats, *, covering: bool) -> LeafCoding:
    """Return the coding of the SPZ file of a scene.

    Args:
        covering: opacities compensate the rounding of scales, see `quantize.compensated`, as only sparklod does.
    """
    version, bits = max(2, int(scene.header["version"])), int(scene.header["fractional_bits"])
    degree = scene.splats.sh_degree
    steps = np.full(3 + 1 + 3 + 3 + 3 * COEFFICIENTS[degree], STEPS)
    steps[10:] = SH_STEPS
    sh_bits = enough(*sh_code_counts(leaves.sh)) if degree else quantize.ALL_BITS

    def encode(splats: Splats) -> CodedSplats:
        parts, numbers = [], {}
        splats = to_code(splats, None, bits, sh_bits, covering=covering)
        for stream in Layout(version, len(splats), degree, bits, LOD).streams():
            if not hasattr(splats, stream.column):
                continue  # a column of the tree
            values = np.ascontiguousarray(stream.encode(getattr(splats, stream.column)))
            codes = values.view(np.uint8).reshape(len(splats), stream.size)
            parts.append(codes)
            numbers[stream.column] = codes.astype(np.int32)
        center = numbers["center"].reshape(-1, 3, 3) @ np.array([1, 1 << 8, 1 << 16], np.int32)
        numbers["center"] = np.where(center >= 1 << 23, center - (1 << 24), center)
        columns = [numbers[name] for name in COLUMNS if name in numbers]
        return CodedSplats(_rows(parts), np.concatenate(columns, axis=1), splats.quat_xyzw)

    return LeafCoding(encode, steps, DEGREES[3 if version == 2 else 4])


def of_rad(facts: RadFacts, leaves: Splats, rounded_to: int | None, *, covering: bool) -> LeafCoding | str:
    """Return the coding of a RAD file, ignoring a palette of SH, or the reason why its leaves cannot be compared.

    Args:
        rounded_to: bits after the binary point to which the writer rounded centres; None for no rounding.
    """
    mixed = [name for name, found in facts.properties.items() if "," in found.encoding]
    if mixed:
        return f"its chunks have {mixed[0]} in several encodings, in which leaves cannot be compared"
    rows = [row for row in PROPERTIES if row.name in facts.properties and row.option and not row.codes]
    stored = [(row, facts.properties[row.name]) for row in rows if row.name != "orientation"]
    properties = [(row, found, PLAIN.get(found.encoding, found.encoding)) for row, found in stored]
    bits = _fractional_bits(leaves.center)
    steps = [np.full(row.numbers, F32_STEPS if name == "f32" else STEPS) for row, _, name in properties]
    if bits is not None and properties[0][0].name == "center":
        steps[0][:] = STEPS
    rotation = facts.properties["orientation"].encoding if "orientation" in facts.properties else "oct88r8"

    def numbers_of(splats: Splats) -> Iterator[NDArray[Any]]:
        for row, found, name in properties:
            if row.name == "center" and name == "f32" and bits is not None:
                yield np.round(splats.center.astype(np.float64) * 2.0**bits).astype(np.int32)
            else:
                yield _rad_codes(splats, row, found, name)

    def encode(splats: Splats) -> CodedSplats:
        splats = _covering(splats, facts, rounded_to) if covering else splats
        if rounded_to is not None:
            splats = dataclasses.replace(splats, center=rounded(splats.center, rounded_to))
        numbers = np.concatenate(list(numbers_of(splats)), axis=1)
        axis = np.stack(encode_axis_angle(splats.quat_xyzw, STEPS_8_8_8), axis=1)
        parts = [np.ascontiguousarray(each).view(np.uint8).reshape(len(splats), -1) for each in (numbers, axis)]
        return CodedSplats(_rows(parts), numbers, splats.quat_xyzw)

    return LeafCoding(encode, np.concatenate(steps), RAD_DEGREES[rotation])


def _fractional_bits(center: FloatArray) -> int | None:
    """Return the fewest bits after the binary point that hold all coordinates; None if these are too many."""
    most = float(np.abs(center).max(initial=0))
    for bits in range(MOST_BITS + 1):
        scaled = center * np.float32(2.0**bits)
        if not most * 2.0**bits < 1 << 30:
            return None
        if (scaled == np.round(scaled)).all():
            return bits
    return None


def _covering(splats: Splats, facts: RadFacts, bits: int | None) -> Splats:
    """Return splats whose opacities compensate the rounding of their scales in a RAD file."""
    found = facts.properties.get("scales")
    if found is None:
        return splats
    scale = CODINGS[found.encoding].rounded(splats.scale, found.min or 0.0, found.max or 0.0)
    blur = 0.0 if bits is None else 2.0**-bits
    return dataclasses.replace(splats, opacity=quantize.compensated(splats.opacity, splats.scale, scale, blur))


def _rad_codes(splats: Splats, row: Row, found: PropertyFacts, encoding: str) -> NDArray[np.int32]:
    """Return the (N, numbers) codes of a property, which are ordered as their values."""
    values = getattr(splats, row.column)
    if row.column == "sh":
        values = values[:, COEFFICIENTS[row.degree - 1] : COEFFICIENTS[row.degree]]
    elif row.column == "opacity":
        values = encode_lod_alpha(values)
    codes = CODINGS[encoding].encode(values.reshape(len(splats), -1), found.min or 0.0, found.max or 0.0).T
    if codes.dtype.kind != "f":
        return (codes.astype(np.uint8).view(np.int8) if encoding == "s8" else codes).astype(np.int32)
    bits = np.ascontiguousarray(codes).view(f"<i{codes.dtype.itemsize}").astype(np.int64)
    lowest = -(1 << (8 * codes.dtype.itemsize - 1))
    # Bits of floats are a sign and a magnitude; integers in their place must grow with the value.
    return np.where(bits < 0, lowest - bits, bits).astype(np.int32)


def _rows(parts: list[NDArray[np.uint8]]) -> NDArray[np.void]:
    together = np.ascontiguousarray(np.concatenate(parts, axis=1))
    return together.view(np.dtype((np.void, together.shape[1])))[:, 0]


#: Most leaves for which a search looks among nearby splats: those with neither an equal splat nor a similar one at the
#: same place of the order.
MAX_SEARCHED = 20_000


def check(scene: Scene, original: Scene, facts: RadFacts | None = None) -> list[Finding]:
    """Return a finding if the leaves of `scene`, a tree, are not exactly the visible splats of `original`.

    Both are compared in the codes of the tree's file: most are equal, and the rest must pair up so that all codes of a
    pair lie within a step of each other.

    Args:
        facts: those of the RAD file of the tree; None for SPZ.
    """
    if scene.tree is None:
        return [Finding("expect.leaves", "the file has no tree whose leaves could be compared")]
    leaves = scene.splats.take(scene.tree.is_leaf)
    source = original.splats if original.tree is None else original.splats.take(original.tree.is_leaf)
    try:
        splats, _ = Selection(drop_invalid=True).apply(source.with_max_sh(leaves.sh_degree))
    except InvalidSplatsError as error:
        return [Finding("expect.leaves", f"the original: {error}")]
    if len(leaves) != len(splats):
        found, expected = count_of(len(leaves), "leaf", "leaves"), count_of(len(splats), "splat")
        return [Finding("expect.leaves", f"{found}, but {expected} of the original can be drawn")]
    if leaves.sh_degree != splats.sh_degree:
        return [Finding("expect.leaves", f"SH degree {leaves.sh_degree}, but the original has {splats.sh_degree}")]
    missing = None
    for coding in codings_of(scene, leaves, splats, facts):
        if isinstance(coding, str):
            return [Finding("expect.leaves", coding)]
        unpaired = _unpaired(coding.encode(leaves), coding.encode(splats), coding)
        if not len(unpaired):
            return []
        missing = unpaired if missing is None or len(unpaired) < len(missing) else missing
    assert missing is not None
    index = int(np.flatnonzero(scene.tree.is_leaf)[missing[0]])
    what = f"{len(missing):,} leaves are not splats of the original; the first is node {index:,}"
    return [Finding("expect.leaves", what, index, len(missing))]


def _unpaired(ours: CodedSplats, theirs: CodedSplats, coding: LeafCoding) -> NDArray[np.intp]:
    """Return ascending indices of our splats that pair with none of theirs; a splat is in one pair at most."""
    left, right = _not_equal(ours.rows, theirs.rows)
    # When sorted, splats mostly have the same order even if the writers round differently.
    left = left[np.lexsort(ours.numbers[left].T[::-1])]
    right = right[np.lexsort(theirs.numbers[right].T[::-1])]
    apart = ~_alike(ours, left, theirs, right, coding)
    left, right = np.sort(left[apart]), right[apart]
    if len(left) > MAX_SEARCHED:
        return left
    # Search for the rest along the axis with the most distinct coordinates.
    axis = int(np.argmax([len(np.unique(theirs.numbers[right, axis])) for axis in range(3)]))
    free = right[np.argsort(theirs.numbers[right, axis], kind="stable")]
    along, step = theirs.numbers[free, axis], coding.steps[axis]
    taken = np.zeros(len(free), np.bool_)
    missing = []
    for leaf in left:
        first, last = np.searchsorted(along, int(ours.numbers[leaf, axis]) + np.array([-step, step + 1]))
        near = np.arange(first, last)[~taken[first:last]]
        fits = near[_alike(ours, np.full(len(near), leaf), theirs, free[near], coding)]
        if len(fits):
            off = _apart(theirs.numbers[free[fits]], ours.numbers[leaf]).sum(axis=1)
            taken[fits[np.argmin(off)]] = True
        else:
            missing.append(leaf)
    return np.array(missing, np.intp)


def _alike(
    ours: CodedSplats, left: NDArray[np.intp], theirs: CodedSplats, right: NDArray[np.intp], coding: LeafCoding
) -> NDArray[np.bool_]:
    """Return, for each pair of splats, whether all of their codes lie within a step of each other."""
    near = (_apart(theirs.numbers[right], ours.numbers[left]) <= coding.steps).all(axis=1)
    cosine = np.abs(np.einsum("ij,ij->i", theirs.quat_xyzw[right], ours.quat_xyzw[left], dtype=np.float64))
    return near & (np.degrees(2 * np.arccos(np.minimum(cosine, 1))) <= coding.degrees)


def _apart(one: NDArray[np.int32], other: NDArray[np.int32]) -> NDArray[np.int64]:
    return np.abs(one.astype(np.int64) - other)  # codes of floats may lie 32 bits apart


def _not_equal(ours: NDArray[np.void], theirs: NDArray[np.void]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return ascending indices of our and their rows that remain when pairs of equal rows are removed."""
    count = len(ours)
    rows = np.concatenate([ours, theirs])
    order = np.argsort(rows, kind="stable")  # ours come first among equal rows
    ordered, is_ours = rows[order], order < count
    begins = np.concatenate([[True], ordered[1:] != ordered[:-1]])
    group = np.cumsum(begins) - 1
    of_ours = np.bincount(group[is_ours], minlength=group[-1] + 1)
    of_theirs = np.bincount(group[~is_ours], minlength=group[-1] + 1)
    rank = np.arange(len(rows)) - np.flatnonzero(begins)[group] - np.where(is_ours, 0, of_ours[group])
    left = order[rank >= np.minimum(of_ours, of_theirs)[group]]
    return np.sort(left[left < count]), np.sort(left[left >= count]) - count
