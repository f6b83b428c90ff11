"""`Statistics`: what has to be known of all splats of a file before the first of them can be written.

They are counted in any pieces, merged in any order with the same outcome, and small: a file that does not fit into
memory is settled by those of its pieces.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..support.parallel import blocks_of, ordered_map
from .binades import Binades
from .magnitudes import Magnitudes
from .sh_bits import ShBytes

#: What can be counted: the largest coordinate, the largest scale of each leaf, how many times as long as wide it is,
#: the SH bytes of leaves, and the magnitudes of columns.
ALL = frozenset(("reach", "leaf_scale", "leaf_length", "leaf_sh", "rgb", "scale", "sh"))

#: Splats that a thread counts at a time. Counts take some 2 MB.
_BLOCK = 1 << 16


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of splats.

    Attributes:
        count: N splats, which are nodes where there is a tree.
        sh_degree: of them.
        tree: whether they are nodes of a tree.
        reach: the largest magnitude of a coordinate; None where it was not asked for.
        leaf_scale: the largest scale of each leaf, or splat where there is no tree; None where not asked for.
        magnitudes: of the values of "rgb", "scale", "sh1", "sh2" and "sh3", as far as they were asked for.
        leaf_sh: SH of leaves, or of splats where there is no tree; None where not asked for, or without SH.
        leaf_length: of each leaf, or splat where there is no tree, the largest scale as a multiple of the middle one;
            None where not asked for.
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
        """Counts splats.

        Args:
            splats: N splats or nodes.
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
        """Counts the splats of a scene."""
        return cls._of_blocks(scene.splats, None if scene.tree is None else scene.tree.is_leaf, needed, threads)

    @classmethod
    def of_leaves(cls, splats: Splats, needed: Collection[str] = ALL, *, threads: int = 1) -> Statistics:
        """Counts splats that will be the leaves of a tree, for `of_tree`."""
        return cls._of_blocks(splats, np.ones(len(splats), np.bool_), needed, threads)

    @classmethod
    def of_tree(
        cls, scene: Scene, leaves: Statistics, needed: Collection[str] = ALL, *, threads: int = 1
    ) -> Statistics:
        """As `of_scene`, of a tree whose leaves have been counted.

        Args:
            scene: the tree.
            leaves: of `of_leaves`, asked for the same.
            needed: what to count, of `ALL`.
            threads: to count on.
        """
        assert scene.tree is not None
        inner = scene.splats.take(np.flatnonzero(scene.tree.child_count))
        return cls.merged([leaves, cls._of_blocks(inner, np.zeros(len(inner), np.bool_), needed, threads)])

    @classmethod
    def _of_blocks(
        cls, splats: Splats, leaf: NDArray[np.bool_] | None, needed: Collection[str], threads: int
    ) -> Statistics:
        """As `of`, block by block."""

        def count(part: slice) -> Statistics:
            return cls.of(splats.take(part), None if leaf is None else leaf[part], needed)

        found: Statistics | None = None
        for some in ordered_map(count, blocks_of(len(splats), _BLOCK), threads):
            found = some if found is None else cls.merged([found, some])
        return cls.of(splats, leaf, needed) if found is None else found

    @classmethod
    def merged(cls, parts: Sequence[Statistics]) -> Statistics:
        """Those of all splats of one part or more, which were asked for the same.

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
        """The bytes of these statistics, tens of KB, from which `from_array` makes them again."""
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
        """The statistics of `array`."""
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
    """(N,) how many times as long as wide splats are: the largest scale by the middle one; 1 for those of no width."""
    x, y, z = scale.T
    largest = np.maximum(np.maximum(x, y), z)
    middle = np.maximum(np.minimum(x, y), np.minimum(np.maximum(x, y), z))
    with np.errstate(divide="ignore", over="ignore"):
        return np.divide(largest, middle, out=np.ones_like(largest), where=middle > 0)


def _known(found: Binades | None) -> Binades:
    assert found is not None, "the parts were asked for different statistics"
    return found
