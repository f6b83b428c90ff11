"""`Scene`: the splats of one file with their tree and the metadata of the file.

The axis that points up is known from a note of sparklod, from the coordinate system of an SPZ 4, or for the formats of
`SPECIFIED` from their specification; outputs note it. All other formats, and trees in SPZ, have the axes of the files
that they were made from: the axis is unknown, outputs do not note it, and cameras assume `ASSUMED`. No coordinate is
rotated unless a user asks for it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..system.errors import InvalidSplatsError, TreeError
from .lod_tree import LodTree
from .sh import COEFFICIENTS
from .splats import Splats, describe_invalid

#: Coding of scales: "spz", or one of RAD's "ln_0r8" and "ln_f16"; empty for plain numbers, which all readers decode
#: alike. Then the ends of the range of the logarithms, or 0 for codings without a range.
ScaleCoding = tuple[str, float, float]

#: Codings of plain numbers and of SPZ.
PLAIN_SCALES: ScaleCoding = ("", 0.0, 0.0)
SPZ_SCALES: ScaleCoding = ("spz", 0.0, 0.0)


@dataclass(frozen=True)
class FileCoding:
    """Codings of the scales in a file.

    Attributes:
        scales: coding of each run of splats, in order.
        run: number of splats of each run but the last.
        packed_range: ends of the range of ln(scale) that the file sets for Spark's PackedSplats (RAD's
            "splatEncoding"); None for Spark's default.
    """

    scales: tuple[ScaleCoding, ...] = (PLAIN_SCALES,)
    run: int = 1
    packed_range: tuple[float, float] | None = None

    def parts(self, count: int) -> Iterator[tuple[slice, ScaleCoding]]:
        """Yield the rows of `count` splats in runs of one coding, with the coding."""
        start = 0
        for number, coding in enumerate(self.scales):
            last = number + 1 == len(self.scales)
            if last or self.scales[number + 1] != coding:
                stop = count if last else min((number + 1) * self.run, count)
                yield slice(start, stop), coding
                start = stop


#: Unit vectors of the axes, by name.
AXES: dict[str, tuple[float, float, float]] = {
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}

#: Up axis by the specification of a format. SPZ only without a tree, as builders keep other axes. A tileset of 3D Tiles
#: has z up, but the glTF of its tiles, whose axes splats keep, has y up.
SPECIFIED: Mapping[str, str] = {"SPZ": "y", "glTF": "y"}

#: Up axis that cameras assume for scenes that do not set it: trained scenes have y down.
ASSUMED = "-y"


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Splats and the metadata of their file.

    The columns of splats become read-only views, so that a drawn scene does not change. The arrays passed in keep their
    flags; pictures drawn after a write to such an array are undefined. The columns of the tree, at most a tenth of the
    bytes, are copied, so that a valid tree stays valid.

    Attributes:
        splats: N splats, in the order and the axes of the file.
        tree: (N,) nodes of a Level-of-Detail tree; None for a scene without a tree.
        antialiased: trained with the opacity compensation of Mip-Splatting.
        format: name of the file format, for display ("PLY", "SPZ 4").
        notes: losses in reading the file, for display.
        header: further numbers of the file's header, by name ("version", "fractional_bits").
        chunk_bytes: bytes of each chunk in the file; None for formats without chunks.
        coding: coding of the scales in the file; None for float32.
        up: the axis that points up, one of `AXES` ("y", "-z"); None if unknown.
        up_by: the format that specifies this axis ("SPZ", "glTF"); empty if the file itself does, or it is unknown.
    """

    splats: Splats
    tree: LodTree | None = None
    antialiased: bool = False
    format: str = ""
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    chunk_bytes: tuple[int, ...] | None = None
    coding: FileCoding | None = None
    up: str | None = None
    up_by: str = ""

    def __post_init__(self) -> None:
        if self.up is not None and self.up not in AXES:
            raise ValueError(f"up is {self.up!r}; give one of {', '.join(AXES)}, or None")
        object.__setattr__(self, "splats", self.splats.frozen())
        if self.tree is not None:
            object.__setattr__(self, "tree", self.tree.frozen())

    def check_tree(self) -> None:
        """Check that the tree, if any, is valid and has a node for each splat; raise `TreeError` otherwise."""
        if self.tree is not None:
            if len(self.tree) != len(self.splats):
                raise TreeError(f"the tree has {len(self.tree):,} nodes, but there are {len(self.splats):,} splats")
            self.tree.validate()

    @classmethod
    def from_arrays(
        cls,
        center: ArrayLike,
        scale: ArrayLike,
        quat_xyzw: ArrayLike,
        opacity: ArrayLike,
        rgb: ArrayLike,
        sh: ArrayLike | None = None,
        *,
        antialiased: bool = False,
        up: str | None = None,
    ) -> Scene:
        """Return a scene of N splats from arrays, which are copied only where they are not C-contiguous float32.

        Args:
            center: (N, 3) world units.
            scale: (N, 3) standard deviations along the local axes, linear, world units.
            quat_xyzw: (N, 4) unit quaternions, local to world.
            opacity: (N,) linear, 0..1.
            rgb: (N, 3) display-referred colours, 0..1; SH_C0 * f_dc + 0.5 of a trained file.
            sh: (N, K, 3) higher SH coefficients, K = 0, 3, 8 or 15; None for none.
            antialiased: trained with the opacity compensation of Mip-Splatting.
            up: the axis that points up, such as "y" or "-z"; None if unknown.

        Raises:
            ValueError: an array has another shape or other contents than real numbers, or there is no such axis.
            InvalidSplatsError: splats are invalid: NaN, a negative scale, a quaternion of another length than 1.
        """
        count = len(np.atleast_1d(np.asarray(center)))
        shapes = {"center": (3,), "scale": (3,), "quat_xyzw": (4,), "opacity": (), "rgb": (3,)}
        given = {"center": center, "scale": scale, "quat_xyzw": quat_xyzw, "opacity": opacity, "rgb": rgb}
        columns = {name: _column(name, given[name], (count, *shapes[name])) for name in shapes}
        if sh is None:
            columns["sh"] = np.zeros((count, 0, 3), np.float32)
        else:
            array = np.asarray(sh)
            coefficients = array.shape[1] if array.ndim == 3 else -1
            if coefficients not in COEFFICIENTS[:4]:
                raise ValueError(f"sh has the shape {array.shape}; give (N, K, 3) with K = 0, 3, 8 or 15")
            columns["sh"] = _column("sh", array, (count, coefficients, 3))
        splats = Splats(**columns)
        invalid = splats.invalid()
        if invalid:
            raise InvalidSplatsError(describe_invalid(invalid))
        return cls(splats, antialiased=antialiased, up=up)

    def __reduce__(self) -> tuple[Any, ...]:
        # Through the constructor: the columns of copies are read-only, too.
        return type(self), tuple(getattr(self, each.name) for each in dataclasses.fields(self))

    def __len__(self) -> int:
        return len(self.splats)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._facts())})"

    def _facts(self) -> list[str]:
        count = len(self.splats)
        facts = [f"{count:,} splat{'s' * (count != 1)}", f"SH degree {self.splats.sh_degree}"]
        if self.antialiased:
            facts.append("antialiased")
        return [*facts, self.format] if self.format else facts


def _column(name: str, values: ArrayLike, shape: tuple[int, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Return a column of `Splats`; raise `ValueError` unless the values are real numbers of this shape."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} holds {array.dtype}; give real numbers")
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}; give {shape}, a row for each splat")
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, np.float32)


def facts_of(source: Any) -> dict[str, Any]:
    """Return the attributes that all kinds of scenes have of their files."""
    return {name: getattr(source, name) for name in ("antialiased", "format", "notes", "header", "up", "up_by")}


def up_note(up: str, up_by: str) -> str:
    """Return the message on an up axis set by a specification, which a file may contradict."""
    return f"{up} is up, as {up_by} specifies; if the scene is upside down, its converter kept y down: give --up -y"


def up_notes_of(files: Iterable[tuple[str, str | None, str]]) -> list[str]:
    """Return the messages on the up axes of files in one view: one on each file, and one if the axes differ.

    Args:
        files: name, `Scene.up` and `Scene.up_by` of each file.
    """
    each = list(dict.fromkeys(files))
    messages = [f"{name}: {up_note(up, up_by)}" for name, up, up_by in each if up and up_by]
    axes = dict.fromkeys(up for _, up, _ in each)
    return [*messages, f"{differing(axes)}, so {ASSUMED} is taken; --up chooses"] if len(axes) > 1 else messages


def differing(axes: Iterable[str | None]) -> str:
    """Return the beginning of a message on files with different up axes."""
    return f"the files differ in the axis that is up ({', '.join(dict.fromkeys(axis or 'unknown' for axis in axes))})"


def rotated_axis(axis: str, rotation: ArrayLike) -> str:
    """Return the axis, one of `AXES`, nearest to a rotated axis.

    A rotation by a few degrees levels a scene whose axis was only roughly up.

    Args:
        rotation: (3, 3) matrix for column vectors, which may scale, too.
    """
    up = np.asarray(rotation, np.float64) @ AXES[axis]
    return max(AXES, key=lambda name: float(up @ AXES[name]))


def common_axis(axes: Iterable[str | None]) -> str | None:
    """Return the common up axis of scenes; None if an axis is unknown or two differ."""
    distinct = set(axes)
    return distinct.pop() if len(distinct) == 1 else None
