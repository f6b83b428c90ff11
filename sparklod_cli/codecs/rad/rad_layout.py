"""The properties of RAD's chunks, and the encodings that each may be in: the one table of both.

Imports nothing heavy: `--help` names the encodings.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from .rad_header import Property

#: Leaves the choice to `options`.
AUTO = "auto"

#: Bytes of a number in each encoding of a file.
SIZES = {
    "f32": 4,
    "f16": 2,
    "f32_lebytes": 4,
    "f16_lebytes": 2,
    "r8": 1,
    "r8_delta": 1,
    "s8": 1,
    "s8_delta": 1,
    "ln_0r8": 1,
    "ln_f16": 2,
    "oct88r8": 1,
    "u16": 2,
    "u32": 4,
}

#: The keys of a property that an encoding needs, for the range of its codes.
RANGES = {
    "r8": ("min", "max"),
    "r8_delta": ("min", "max"),
    "ln_0r8": ("min", "max"),
    "s8": ("max",),
    "s8_delta": ("max",),
}

_SH_ENCODINGS = ("s8", "s8_delta", "r8", "r8_delta", "f16", "f32")


class Row(NamedTuple):
    """A property.

    Attributes:
        name: in the file.
        option: the field of `RadOptions` that chooses its encoding; empty where there is no choice.
        column: of `Splats` or `LodTree`; "labels" for those of the palette.
        numbers: of a splat.
        encodings: that it may be in, as Spark reads them; the first is the one that Spark writes by itself.
        degree: of spherical harmonics; 0 for what is none of them.
        codes: whether it is a part of the palette of spherical harmonics, of which only the first chunk has one.
    """

    name: str
    option: str
    column: str
    numbers: int
    encodings: tuple[str, ...]
    degree: int = 0
    codes: bool = False


#: In the order of a chunk.
PROPERTIES = (
    Row("center", "center", "center", 3, ("f32_lebytes", "f32", "f16_lebytes", "f16")),
    Row("alpha", "alpha", "opacity", 1, ("f16", "r8", "f32")),
    Row("rgb", "rgb", "rgb", 3, ("r8_delta", "r8", "f16", "f32")),
    Row("scales", "scales", "scale", 3, ("ln_0r8", "ln_f16", "f32")),
    Row("orientation", "orientation", "quat_xyzw", 3, ("oct88r8", "f16", "f32")),
    Row("sh1", "sh", "sh", 9, _SH_ENCODINGS, 1),
    Row("sh2", "sh", "sh", 15, _SH_ENCODINGS, 2),
    Row("sh3", "sh", "sh", 21, _SH_ENCODINGS, 3),
    Row("sh1_code", "sh", "sh", 9, _SH_ENCODINGS, 1, True),
    Row("sh2_code", "sh", "sh", 15, _SH_ENCODINGS, 2, True),
    Row("sh3_code", "sh", "sh", 21, _SH_ENCODINGS, 3, True),
    Row("sh_label", "", "labels", 1, ("u16", "u32")),
    Row("child_count", "", "child_count", 1, ("u16",)),
    Row("child_start", "", "child_start", 1, ("u32",)),
)

BY_NAME = {row.name: row for row in PROPERTIES}

#: The fields of `RadOptions` that choose an encoding.
OPTIONS = tuple(dict.fromkeys(row.option for row in PROPERTIES if row.option))


def choices(option: str) -> tuple[str, ...]:
    """Return the encodings that a field of `RadOptions` may name, "auto" first."""
    return (AUTO, *next(row.encodings for row in PROPERTIES if row.option == option))


def encodings_of(properties: Iterable[Property]) -> dict[str, str]:
    """Return the encodings of a chunk's properties, by the field of `RadOptions`."""
    return {BY_NAME[each.name].option: each.encoding for each in properties if BY_NAME[each.name].option}
