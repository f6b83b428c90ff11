"""Contents of one splat file: `Scene`, splats with their tree if they have one, and metadata of the file.

`DetailScene` is one whose regions each exist at several detail levels, as Streamed SOG holds it. `FileCoding` tells how
a file holds its scales: what it takes to know the numbers that another reader has of them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..system.errors import InvalidSplatsError, TreeError
from .axes import AXES
from .lod_tree import LodTree
from .sh import COEFFICIENTS
from .splats import Splats, describe_invalid


@dataclass(frozen=True)
class ScaleCoding:
    """The codes that some scales are decoded from.

    Attributes:
        name: "spz", or one of RAD's "ln_0r8" and "ln_f16"; empty for plain numbers, which all readers have alike.
        low, high: ends of the range of the logarithms, where the codes have one.
    """

    name: str = ""
    low: float = 0.0
    high: float = 0.0


@dataclass(frozen=True)
class FileCoding:
    """Codings of the scales in a file.

    Attributes:
        scales: of each run of splats, in order.
        run: splats of each run but the last.
        packed_range: ends of the range of logarithms in which Spark packs the scales of the file as PackedSplats, where
            the file sets one (RAD's "splatEncoding"); None for Spark's own.
    """

    scales: tuple[ScaleCoding, ...]
    run: int
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


#: That of splats that were not read from codes.
PLAIN = FileCoding((ScaleCoding(),), 1)


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Splats, and what a file says of them all.

    The columns of splats become read-only views, so that a scene cannot change after it was drawn. Arrays that were
    passed in keep their flags; what is drawn after a write to one of them is undefined. The columns of the tree, a
    tenth of its bytes at most, are copied, so that a tree which was valid stays valid.

    Attributes:
        splats: N splats, in the order and the axes of the file.
        tree: (N,) nodes where the file is a Level-of-Detail tree, else None.
        antialiased: trained with the opacity compensation of Mip-Splatting.
        format: what it was read from, for display ("PLY", "SPZ 4").
        notes: what the reader had to leave out, for display.
        header: numbers of the file's header that the splats do not tell, by name ("version", "fractional_bits").
        chunk_bytes: of each of its chunks in the file, where its format has chunks; None elsewhere.
        coding: how the file holds its scales; `PLAIN` where it has the very numbers.
        up: the axis that points up, one of `axes.AXES` ("y", "-z"); None where it is unknown.
        up_by: the format whose specification says so ("SPZ", "glTF"); empty where the file itself does, or nobody.
    """

    splats: Splats
    tree: LodTree | None = None
    antialiased: bool = False
    format: str = ""
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    chunk_bytes: tuple[int, ...] | None = None
    coding: FileCoding = PLAIN
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
            TreeError: it does not.
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


@dataclass(frozen=True, eq=False, repr=False)
class Tree(Scene):
    """A scene with a Level-of-Detail tree: its splats are the nodes, and `tree` says which are whose children."""

    tree: LodTree = field()

    def _facts(self) -> list[str]:
        nodes, leaves = len(self.splats), int(np.count_nonzero(self.tree.is_leaf))
        try:
            self.check_tree()
            depth = f"depth {self.tree.depths().max()}"
        except TreeError as error:
            depth = f"broken: {error}"
        counts = [f"{nodes:,} node{'s' * (nodes != 1)}", f"{leaves:,} leaves", depth]
        return [*counts, *super()._facts()[1:]]


def _column(name: str, values: ArrayLike, shape: tuple[int, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Return a column of `Splats` from numbers of this very shape."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} holds {array.dtype}; give real numbers")
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}; give {shape}, a row for each splat")
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, np.float32)


Bounds = NDArray[np.float64]
Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class DetailScene:
    """Splats of all detail levels, and the regions whose level a viewer chooses one by one.

    Level 0 is full detail; the levels of a region stand for the same splats. The splats of a region at a level are its
    run. Runs lie level after level, and in a level region after region.

    Attributes:
        splats: N splats, those of all levels.
        counts: (R, L) int64 splats of each region at each level; 0 where a region has no such level.
        bounds: (R, 2, 3) float64 lowest and highest corner of each region, in world units.
        children: (R - 1, 2) int64 the binary tree over the regions: its inner nodes, root first and before their
            children. A number from 0 on is an inner node, -1 - r is region r.
        errors: (R, L) float64 how far each level of a region is from its level 0, 0 there and not decreasing from level
            to level; None where nobody measured it.
        environment: splats far outside, which are drawn whatever the levels are; None without.
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
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has the shape {getattr(self, name).shape}; expected {shape}")
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


def facts_of(source: Any) -> dict[str, Any]:
    """Return what a scene of any kind says of its file, by the names of the attributes that all of them have."""
    return {name: getattr(source, name) for name in ("antialiased", "format", "notes", "header", "up", "up_by")}


@dataclass(frozen=True, eq=False)
class NodeStream:
    """The nodes of a tree in their final order, made whenever they are asked for.

    Attributes:
        count: M nodes.
        sh_degree: of all windows.
        antialiased, up: as in `Scene`.
        read: called with a range of nodes, returns them and their tree columns, whose `child_start` counts from the
            first node of the whole tree; may be called again, from several threads at once.
    """

    count: int
    sh_degree: int
    antialiased: bool
    read: Callable[[int, int], tuple[Splats, LodTree]]
    up: str | None = None
