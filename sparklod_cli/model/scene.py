"""`Scene`, what one splat file holds: splats, their tree if they have one, and what belongs to the file as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ..support.errors import InvalidSplatsError
from .coding import PLAIN, FileCoding
from .lod_tree import LodTree
from .sh import COEFFICIENTS
from .splats import Splats, describe_invalid
from .up_axis import AXES


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Splats, and what a file says of them all.

    The columns of splats and tree become read-only views, so that a scene cannot change after it was drawn. Arrays that
    were passed in keep their flags; what is drawn after a write to one of them is undefined.

    Attributes:
        splats: N splats, in the order and the axes of the file.
        tree: (N,) nodes where the file is a Level-of-Detail tree, else None.
        antialiased: trained with the opacity compensation of Mip-Splatting.
        format: what it was read from, for display ("PLY", "SPZ 4").
        notes: what the reader had to leave out, for display.
        header: numbers of the file's header that the splats do not tell, by name ("version", "fractional_bits").
        chunk_bytes: of each of its chunks in the file, where its format has chunks; None elsewhere.
        coding: how the file holds its scales; `coding.PLAIN` where it has the very numbers.
        up: the axis that points up, one of `up_axis.AXES` ("y", "-z"); None where the file does not say.
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

    def __post_init__(self) -> None:
        if self.up is not None and self.up not in AXES:
            raise ValueError(f"up is {self.up!r}; give one of {', '.join(AXES)}, or None")
        object.__setattr__(self, "splats", self.splats.frozen())
        if self.tree is not None:
            object.__setattr__(self, "tree", self.tree.frozen())

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
        """A scene of N splats from arrays of numbers, which are copied only where they are not C-contiguous float32.

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
        depth = int(self.tree.depths().max(initial=0))
        counts = [f"{nodes:,} node{'s' * (nodes != 1)}", f"{leaves:,} leaves", f"depth {depth}"]
        return [*counts, *super()._facts()[1:]]


def _column(name: str, values: ArrayLike, shape: tuple[int, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """A column of `Splats` from numbers of this very shape."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} holds {array.dtype}; give real numbers")
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}; give {shape}, a row for each splat")
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, np.float32)
