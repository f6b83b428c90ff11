"""Attributes of splats in a glTF: their table, the names that drafts of the extension had, and what is left out."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..model import MAX_SH_DEGREE
from ..model.gaussian import normalized_quat
from ..model.sh import COEFFICIENTS, notes_on_degree
from ..model.splats import FloatArray, Splats
from ..system.errors import FormatError
from . import quantize
from .reader import left_out

EXTENSION, COMPRESSION = "KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"

#: An extension before these two, of primitives, with an SPZ file as `COMPRESSION`.
OLD_COMPRESSION = "KHR_spz_gaussian_splats_compression"

#: What the names of attributes begin with; "_" in the draft that CesiumJS 1.130 read.
PREFIX, DRAFT_PREFIX = f"{EXTENSION}:", "_"

#: Component types of integers.
SIGNED, UNSIGNED = (5120, 5122), (5121, 5123)

Coding = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Attribute:
    """An attribute of a splat.

    Attributes:
        semantic: its name in the file.
        type: of its accessor.
        integers: component types besides float that are read.
        column: of `Splats`.
        decode, encode: between values of the file and of the column.
        term: number of the coefficient of SH; None for other columns.
        components: of the accessor that the column has: the first, and the one after the last.
    """

    semantic: str
    type: str
    integers: tuple[int, ...]
    column: str
    decode: Coding = np.asarray
    encode: Coding = np.asarray
    term: int | None = None
    components: tuple[int, int | None] = (0, None)

    def part_of(self, splats: Splats) -> FloatArray:
        """Return the view of a column that it fills."""
        column: FloatArray = getattr(splats, self.column)
        return column if self.term is None else column[:, self.term]


#: The attributes of every splat. Integers of scales are unsigned in the extension, signed in drafts of it.
POSITION, ROTATION, SCALE, OPACITY, COLOR = ATTRIBUTES = (
    Attribute("POSITION", "VEC3", (*SIGNED, *UNSIGNED), "center"),
    Attribute(f"{PREFIX}ROTATION", "VEC4", SIGNED, "quat_xyzw", normalized_quat),
    Attribute(f"{PREFIX}SCALE", "VEC3", (*SIGNED, *UNSIGNED), "scale"),
    Attribute(f"{PREFIX}OPACITY", "SCALAR", UNSIGNED, "opacity"),
    Attribute(f"{PREFIX}SH_DEGREE_0_COEF_0", "VEC3", (), "rgb", quantize.decode_dc, quantize.encode_dc),
)

#: The colour of points for viewers without splats. In drafts it was that of the splats, and their opacity.
POINT_COLOR = "COLOR_0"
DRAFT_ATTRIBUTES = {
    "opacity": Attribute(POINT_COLOR, "VEC4", UNSIGNED, "opacity", components=(3, 4)),
    "rgb": Attribute(POINT_COLOR, "VEC4", UNSIGNED, "rgb", components=(0, 3)),
}


def sh_attributes(degree: int) -> list[Attribute]:
    """Return the attributes of SH from degree 1 to a degree, each one coefficient."""
    return [
        Attribute(f"{PREFIX}SH_DEGREE_{each}_COEF_{order}", "VEC3", (), "sh", term=each * each - 1 + order)
        for each in range(1, degree + 1)
        for order in range(2 * each + 1)
    ]


def attributes_of(names: Mapping[str, Any]) -> tuple[list[Attribute], int]:
    """Return the attributes that splats are read from, of those that a primitive names, and their SH degree."""
    chosen = [_named(each, names) or _drafted(each, names) for each in ATTRIBUTES]
    missing = [each.semantic for each, found in zip(ATTRIBUTES, chosen, strict=True) if found is None]
    if missing:
        raise FormatError(f"its splats have no {', '.join(missing)}")
    all_terms = sh_attributes(MAX_SH_DEGREE)
    terms = [found for each in all_terms if (found := _named(each, names)) is not None]
    degree = 0
    while degree < MAX_SH_DEGREE and all(_named(each, names) for each in sh_attributes(degree + 1)):
        degree += 1
    if len(terms) != COEFFICIENTS[degree]:
        raise FormatError(f"SH of degree {degree + 1} are incomplete: {len(terms)} coefficients in all")
    return [each for each in [*chosen, *terms] if each is not None], degree


def _named(attribute: Attribute, names: Mapping[str, Any]) -> Attribute | None:
    """Return an attribute by the name that a primitive has for it; None where it has none."""
    own = attribute.semantic
    draft = own.replace(PREFIX, DRAFT_PREFIX)
    name = next((each for each in (own, draft) if each in names), None)
    return None if name is None else replace(attribute, semantic=name)


def _drafted(attribute: Attribute, names: Mapping[str, Any]) -> Attribute | None:
    found = DRAFT_ATTRIBUTES.get(attribute.column)
    return found if found is not None and found.semantic in names else None


#: SH of higher degrees than any that is read.
_HIGHER_SH = re.compile(rf"(?:{PREFIX}|{DRAFT_PREFIX})SH_DEGREE_(\d)_COEF_\d+", re.ASCII)


def notes_on(names: Mapping[str, Any], read: Sequence[Attribute]) -> tuple[str, ...]:
    """Return notes on the attributes of a primitive that are not read."""
    known = {each.semantic for each in read}
    others = [name for name in names if name not in known]
    degrees = {name: int(match[1]) for name in others if (match := _HIGHER_SH.fullmatch(name))}
    cut = notes_on_degree(max(degrees.values(), default=0))
    return cut + left_out("attribute", "attributes", (name for name in others if name not in degrees))


#: Programs that wrote logarithms in place of scales, as drafts of the extension had them until April 2026: gsbox up to
#: version 4, and splat-transform before version 2.7, of June 2026. The extension demands linear scales.
WRITERS = re.compile(r"gsbox v?[0-4]\.|splat-transform v?(?:1\.|2\.[0-6]\.)", re.ASCII)

#: Share of splats with a scale below 0 from which on scales are logarithms, since broken files have a few; and how far
#: below 0 half of these must be, since linear scales of mirrored splats are small. Chosen.
NEGATIVE, BELOW = 0.1, 0.1

#: Largest ratio of the 99th to the first percentile of positive values that may be logarithms. That of linear scales of
#: real scenes is above 100, that of their logarithms below 10. Chosen.
NARROW = 20.0

#: Fewest splats of which positive values are judged. Chosen.
LEAST = 100

#: How many times the distance of splats their linear scale may be; in real scenes it is 0.8 to 3 times that. Chosen.
WIDE = 8.0

READ_AS_LOGS = (
    "its scales are logarithms, as gsbox and splat-transform before version 2.7 write them, and are read as such"
)


def are_logs(scales: FloatArray, generator: object) -> bool:
    """Return whether scales, (n, 3) values of splats from all over a file, are logarithms beyond doubt."""
    if isinstance(generator, str) and WRITERS.match(generator):
        return True
    negative = scales[scales < 0]
    share = float((scales < 0).any(axis=1).mean()) if len(scales) else 0.0
    return share >= NEGATIVE and float((negative < -BELOW).mean()) >= 0.5


def doubt_about(scales: FloatArray, centers: FloatArray, count: int) -> str | None:
    """Return a note on positive scales that are read as linear and may be logarithms; None if they seem linear.

    Args:
        scales, centers: (n, 3) values of splats from all over a file of `count` splats.
    """
    if count < LEAST or not (np.isfinite(scales).all() and np.isfinite(centers).all() and (scales > 0).all()):
        return None
    low, middle, high = np.quantile(scales.astype(np.float64), (0.01, 0.5, 0.99))
    sides = np.sort(np.subtract(*np.quantile(centers.astype(np.float64), (0.9, 0.1), axis=0)))
    distance = float(np.sqrt(sides[1] * sides[2] / (0.64 * count)))  # of splats on surfaces, but for far ones
    if high > NARROW * low or high - low < 1e-3 or not distance > 0 or middle < 0.1:
        return None
    as_scale, as_log = np.log(middle / distance), middle - np.log(distance)
    if as_scale <= np.log(WIDE) and abs(as_log) > abs(as_scale) - 1:
        return None
    return (
        f"its scales, {low:.3g} to {high:.3g}, look like logarithms, as gsbox and splat-transform before version 2.7"
        " write them, but are read as linear ones; if they are logarithms, write the file anew by a newer version"
    )
