"""Contents of one splat file: splats with their tree, detail levels or tiles, and metadata of the file.

The axis that points up is known from a note of sparklod, from the coordinate system of an SPZ 4, or for the formats of
`SPECIFIED` from their specification; outputs note it. All other formats, and trees in SPZ, have the axes of the files
that they were made from: their axis is unknown and not noted, and cameras take `ASSUMED`. No coordinate is turned
unless a user asks for it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..system.errors import InvalidSplatsError, TreeError
from .lod_tree import LodTree
from .sh import COEFFICIENTS
from .splats import Splats, describe_invalid

#: Coding of scales: "spz", or one of RAD's "ln_0r8" and "ln_f16"; empty for plain numbers, which all readers decode
#: alike. Then the ends of the range of the logarithms, where the codes have one; else 0.
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
        packed_range: ends of the range of logarithms in which Spark packs the scales of the file as PackedSplats, where
            the file sets one (RAD's "splatEncoding"); None for Spark's own.
    """

    scales: tuple[ScaleCoding, ...] = (PLAIN_SCALES,)
    run: int = 1
    packed_range: tuple[float, float] | None = None

    def parts(self, count: int) -> Iterator[tuple[slice, ScaleCoding]]:
        """Return the rows of `count` splats, as few slices as their codings allow."""
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

#: By format, the axis that points up by its specification. z is up in a tileset of 3D Tiles, and y in the glTF of its
#: tiles, whose axes splats are read in. Files of SPZ without a tree; Spark's builder and sparklod's keep other axes.
SPECIFIED: Mapping[str, str] = {"SPZ": "y", "glTF": "y"}

#: The axis that cameras take for up in scenes that do not say it: training leaves them with y down.
ASSUMED = "-y"


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Splats and the metadata of their file.

    The columns of splats become read-only views, so that a scene cannot change after it was drawn. Arrays that were
    passed in keep their flags; pictures drawn after a write to one of them are undefined. The columns of the tree, a
    tenth of its bytes at most, are copied, so that a valid tree stays valid.

    Attributes:
        splats: N splats, in the order and the axes of the file.
        tree: (N,) nodes where the file is a Level-of-Detail tree, else None.
        antialiased: trained with the opacity compensation of Mip-Splatting.
        format: name of the file format, for display ("PLY", "SPZ 4").
        notes: losses in reading the file, for display.
        header: further numbers of the file's header, by name ("version", "fractional_bits").
        chunk_bytes: bytes of each chunk in the file; None for formats without chunks.
        coding: coding of the scales in the file; None for float32.
        up: the axis that points up, one of `AXES` ("y", "-z"); None where it is unknown.
        up_by: the format that specifies this axis ("SPZ", "glTF"); empty if the file names it, or it is unknown.
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
        """Check that the tree, if there is one, is valid and has a node for each splat.

        Raises:
            TreeError: it is invalid.
        """
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
            up: the axis that points up, such as "y" or "-z"; None where it is unknown.

        Raises:
            ValueError: an array has another shape, or holds something else than real numbers; names it. There is no
                such axis.
            InvalidSplatsError: splats have numbers that no Gaussian has: NaN, a negative scale, a quaternion of another
                length than 1.
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
        columns = {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}
        return functools.partial(type(self), **columns), ()  # copies are read-only, too

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
    """Return a column of `Splats` from numbers of this very shape."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} holds {array.dtype}; give real numbers")
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}; give {shape}, a row for each splat")
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, np.float32)


def facts_of(source: Any) -> dict[str, Any]:
    """Return the metadata that scenes of all kinds have of their files, by the names of its attributes."""
    return {name: getattr(source, name) for name in ("antialiased", "format", "notes", "header", "up", "up_by")}


def up_note(up: str, up_by: str) -> str:
    """Return the message on an axis that a specification names, which a file may contradict."""
    return f"{up} is up, as {up_by} specifies; if the scene is upside down, its converter kept y down: give --up -y"


def up_notes_of(files: Iterable[tuple[str, str | None, str]]) -> list[str]:
    """Return the messages on the axes of files that are shown together: that of each file, and one if they differ.

    Args:
        files: the name of each, and `up` and `up_by` of its scene.
    """
    each = list(dict.fromkeys(files))
    messages = [f"{name}: {up_note(up, up_by)}" for name, up, up_by in each if up and up_by]
    axes = dict.fromkeys(up for _, up, _ in each)
    return [*messages, f"{differing(axes)}, so {ASSUMED} is taken; --up chooses"] if len(axes) > 1 else messages


def differing(axes: Iterable[str | None]) -> str:
    """Return the beginning of a sentence that names the different axes of files."""
    return f"the files differ in the axis that is up ({', '.join(dict.fromkeys(axis or 'unknown' for axis in axes))})"


def rotated_axis(axis: str, rotation: ArrayLike) -> str:
    """Return the axis, one of `AXES`, nearest to where a rotation takes an axis.

    The nearest one, since a rotation by a few degrees levels a scene whose axis was only roughly up.

    Args:
        rotation: (3, 3) matrix that multiplies column vectors; it may scale them, too.
    """
    up = np.asarray(rotation, np.float64) @ AXES[axis]
    return max(AXES, key=lambda name: float(up @ AXES[name]))


def common_axis(axes: Iterable[str | None]) -> str | None:
    """Return the axis that all scenes have up; None where one is unknown or two differ."""
    distinct = set(axes)
    return distinct.pop() if len(distinct) == 1 else None


Bounds = NDArray[np.float64]
Counts = NDArray[np.int64]


def _check_shapes(scene: DetailScene | TileScene, shapes: Mapping[str, tuple[int, ...]]) -> None:
    for name, shape in shapes.items():
        if getattr(scene, name).shape != shape:
            raise ValueError(f"{name} has the shape {getattr(scene, name).shape}; expected {shape}")


@dataclass(frozen=True, eq=False)
class DetailScene:
    """Splats of all detail levels, and the regions whose level a viewer chooses one by one, as in Streamed SOG.

    Level 0 is full detail; the levels of a region stand for the same splats. The splats of a region at a level are its
    run. Runs lie level after level, and in a level region after region.

    Attributes:
        splats: N splats, those of all levels.
        counts: (R, L) int64 splats of each region at each level; 0 where a region has no such level.
        bounds: (R, 2, 3) float64 lowest and highest corner of each region, in world units.
        children: (R - 1, 2) int64 the binary tree over the regions: its inner nodes, root first and before their
            children. A number from 0 on is an inner node, -1 - r is region r.
        errors: (R, L) float64 differences of each level of a region from its level 0, not decreasing from level to
            level; None if they were not measured.
        environment: splats far outside, which are drawn at all levels; None without.
        antialiased: trained with the opacity compensation of Mip-Splatting.
        format, notes, header, up, up_by: as of `Scene`.
    """

    splats: Splats
    counts: Counts
    bounds: Bounds
    children: NDArray[np.int64]
    errors: NDArray[np.float64] | None = None
    environment: Splats | None = None
    antialiased: bool = False
    format: str = ""
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    up: str | None = None
    up_by: str = ""

    def __post_init__(self) -> None:
        regions, levels = self.counts.shape
        shapes = {"bounds": (regions, 2, 3), "children": (regions - 1, 2)}
        shapes |= {} if self.errors is None else {"errors": (regions, levels)}
        _check_shapes(self, shapes)
        if self.counts.sum() != len(self.splats):
            raise ValueError(f"counts are of {self.counts.sum():,} splats, but there are {len(self.splats):,}")

    @property
    def regions(self) -> int:
        """Number of regions."""
        return len(self.counts)

    @property
    def levels(self) -> int:
        """Number of detail levels."""
        return self.counts.shape[1]

    @functools.cached_property
    def starts(self) -> Counts:
        """(R, L) the first splat of each run."""
        flat = self.counts.T.ravel()
        return np.ascontiguousarray((np.cumsum(flat) - flat).reshape(self.levels, self.regions).T)

    def run(self, region: int, level: int) -> slice:
        """Return the splats of a region at a level."""
        start = int(self.starts[region, level])
        return slice(start, start + int(self.counts[region, level]))

    def level(self, level: int) -> slice:
        """Return the splats of a level, of all regions."""
        before = int(self.counts[:, :level].sum())
        return slice(before, before + int(self.counts[:, level].sum()))

    def scene(self) -> Scene:
        """Return full detail as a plain scene: level 0, then the environment."""
        splats = self.splats.take(self.level(0))
        if self.environment is not None:
            splats = Splats.concat([splats, self.environment])
        return Scene(splats, **facts_of(self))


@dataclass(frozen=True, eq=False)
class TileScene:
    """Tiles, root first and each after its parent, and their splats, tile after tile; as in 3D Tiles.

    The children of a tile together stand for what it stands for, in more splats. A tile without children has full
    detail. A viewer draws some tiles, none of them below another, that together stand for the scene.

    Attributes:
        splats: N splats, those of all tiles.
        parent: (T,) int32 tile that each tile replaces a part of; -1 of the root.
        level: (T,) int32 number of the cut that a tile is a part of, 0 of the root; more than that of its parent.
        counts: (T,) int64 splats of each tile.
        errors: (T,) float64 geometric error of each tile in world units, 0 of tiles without children.
        bounds: (T, 2, 3) float64 lowest and highest corner of each tile and those below it, in the axes of the splats.
        sizes: (T,) int64 bytes of the file of each tile, 0 without splats; None for a scene in memory.
        transform: (4, 4) float64 for column vectors, from the axes of the tileset, z up, to the Earth's (ECEF), metres;
            the identity where the scene has no place there.
        antialiased, format, notes, header, up, up_by: as of `Scene`.
    """

    splats: Splats
    parent: NDArray[np.int32]
    level: NDArray[np.int32]
    counts: Counts
    errors: NDArray[np.float64]
    bounds: Bounds
    sizes: Counts | None = None
    transform: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    antialiased: bool = False
    format: str = ""
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    up: str | None = None
    up_by: str = ""

    def __post_init__(self) -> None:
        tiles = len(self.parent)
        shapes = {"level": (tiles,), "counts": (tiles,), "errors": (tiles,), "bounds": (tiles, 2, 3)}
        _check_shapes(self, shapes | {"transform": (4, 4)})
        if not tiles or self.parent[0] != -1 or not (np.arange(tiles)[1:] > self.parent[1:]).all():
            raise ValueError("the first tile is the root, and every other comes after its parent")
        if self.counts.sum() != len(self.splats):
            raise ValueError(f"counts are of {self.counts.sum():,} splats, but there are {len(self.splats):,}")

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return len(self.parent)

    @functools.cached_property
    def starts(self) -> Counts:
        """(T,) int64 the first splat of each tile."""
        return np.cumsum(self.counts) - self.counts

    @functools.cached_property
    def is_leaf(self) -> NDArray[np.bool_]:
        """(T,) bool, true for tiles without children."""
        leaf = np.ones(self.tiles, np.bool_)
        leaf[self.parent[1:]] = False
        return leaf

    def run(self, tile: int) -> slice:
        """Return the splats of a tile."""
        return slice(int(self.starts[tile]), int(self.starts[tile] + self.counts[tile]))

    def at_level(self, level: int) -> NDArray[np.int64]:
        """Return the tiles, ascending, that together are the cut of a level: those of it, and leaves of coarser ones.

        A tile in which nothing is refined from one level to the next has no children at the next; it belongs to both.
        """
        below = np.full(self.tiles, np.iinfo(np.int32).max, np.int32)
        below[self.parent[1:]] = self.level[1:]  # siblings have one level
        return np.flatnonzero((self.level <= level) & (below > level))

    def scene(self) -> Scene:
        """Return full detail as a plain scene: the splats of the tiles without children."""
        splats = self.splats.take(np.repeat(self.is_leaf, self.counts))
        return Scene(splats, **facts_of(self))
