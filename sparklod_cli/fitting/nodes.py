"""The nodes of a tree while they are fitted, and what cameras see of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..lod.traversal import CutView, Forest, Traversal, TreeInstance
from ..model.foveation import Cones
from ..model.gaussian import linear_opacity, lod_opacity, normalized_quat, size_factor
from ..model.lod_tree import LodTree
from ..model.scene import PLAIN
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..render import rasterizer
from ..render.kernels.shade import add_sh
from ..render.rasterizer import ShadedSplats
from ..render.settings import RasterSettings
from ..scenes.loaded_scene import nodes_of
from .kernels.adam import MOST_D, Columns, FitBounds
from .kernels.view import mark_seen
from .settings import SHARES

Index = NDArray[np.int64]


class FittedNodes:
    """The nodes of a tree while they change.

    Attributes:
        columns: of the nodes, as they are now; changed in place.
        old: the columns as they were at first.
        leaves: indices of full detail, ascending.
        fitted: indices of the nodes that may change, ascending: the merged splats.
        shares: of the leaves, of the cuts that nodes are judged by.
    """

    shares: Sequence[float] = SHARES

    #: Bounds of what fitting changes. Feature sizes decide which nodes a cut refines, and the builder chose them well.
    #: Measured (benchmarks/notes/refining.md).
    bounds = FitBounds(MOST_D, np.float32(1.06))

    #: Least feature size of a node, over the mean of its children's, weighted by opacity times surface. `inspect
    #: --check` warns below a third, also after rounding to the steps of a format.
    least_ratio = 0.38

    def __init__(self, nodes: Splats, tree: LodTree, raster: RasterSettings, threads: int) -> None:
        self.original, self.tree, self.raster = nodes, tree, raster
        self.old = columns_of(nodes)
        self.columns = _copied(self.old)
        self.leaves: Index = np.flatnonzero(tree.is_leaf)
        self.fitted: Index = np.flatnonzero(~tree.is_leaf)
        self._forest = Forest([nodes_of(nodes, tree, PLAIN, precision="float16", threads=threads)])
        self._traversal = Traversal(self._forest, [TreeInstance(foveation=Cones())])

    def cut(self, camera: Camera, share: float) -> Index:
        """Return the nodes, ascending, of a cut of a share of the leaves, without pixel-scale limit or foveation."""
        budget = max(1, int(share * len(self.leaves)))
        view = CutView(camera.camera_to_world, camera.fov_x, camera.fov_y)
        return self._traversal.cut(view, budget=budget).indices()[0].astype(np.int64)

    def visible(self, index: Index, camera: Camera) -> tuple[Index, ShadedSplats]:
        """Return the nodes of `index` that a camera may see, and how it sees them."""
        now = self.columns
        whole = ShadedSplats(now.center, now.scale, now.quat_xyzw, now.lod_opacity, now.rgb)
        _, matrix, lens, limits = rasterizer.arguments(whole, camera, self.raster)
        marks = np.empty(len(index), np.bool_)
        mark_seen(len(index), now.center, now.lod_opacity, index, matrix, lens, limits, marks)
        seen = index[marks]
        found = Columns(*(column[seen] for column in now))
        if terms := found.sh.shape[1]:
            eye = camera.position.astype(np.float32)
            add_sh(len(seen), found.center, found.sh, eye, COEFFICIENTS.index(terms), found.rgb)
        np.maximum(found.rgb, 0, out=found.rgb)
        return seen, ShadedSplats(found.center, found.scale, found.quat_xyzw, found.lod_opacity, found.rgb)

    def renew(self, index: Index) -> None:
        """Update the nodes that cuts are found with."""
        self.place(index, self.columns.center[index], self.sizes(index))

    @np.errstate(over="ignore")  # what float16 cannot hold is infinite, as in Spark
    def place(self, index: Index, center: FloatArray, sizes: FloatArray) -> None:
        """Set centres, (M, 3), and feature sizes of the nodes that cuts are found with."""
        rows = self._forest.nodes
        rows["x"][index], rows["y"][index], rows["z"][index] = center.astype(np.float16).T
        rows["size"][index] = sizes.astype(np.float16)

    def sizes(self, index: Index, columns: Columns | None = None) -> FloatArray:
        """Return feature sizes of some nodes as they are now, or by other columns; see `gaussian.spark_size`."""
        columns = columns or self.columns
        x, y, z = columns.scale[index].T
        size: FloatArray = size_factor(columns.lod_opacity[index]) * 2 * ((x + y + z) / np.float32(3))
        return size

    def restore(self, index: Index, columns: Columns | None = None) -> None:
        """Set some nodes to the values of other columns, or to their first ones."""
        for now, other in zip(self.columns, columns or self.old, strict=True):
            now[index] = other[index]
        self.renew(index)

    def halve(self, index: Index) -> None:
        for now, old in zip(self.columns, self.old, strict=True):
            now[index] = (now[index] + old[index]) / 2
        turned = index[(self.columns.quat_xyzw[index] != self.old.quat_xyzw[index]).any(axis=1)]
        self.columns.quat_xyzw[turned] = normalized_quat(self.columns.quat_xyzw[turned])
        self.renew(index)

    def copy(self) -> Columns:
        return _copied(self.columns)

    def changed(self) -> NDArray[np.bool_]:
        """Return a (N,) mask of the nodes that differ from their first values."""
        pairs = zip(self.columns, self.old, strict=True)
        return np.logical_or.reduce([(a != b).reshape(len(a), -1).any(axis=1) for a, b in pairs])

    def result(self) -> Splats:
        """Return all nodes as they are now; what has not changed is the same bit for bit."""
        now = self.columns
        opacity = np.where(
            now.lod_opacity == self.old.lod_opacity, self.original.opacity, linear_opacity(now.lod_opacity)
        )
        return Splats(now.center, now.scale, now.quat_xyzw, opacity, now.rgb, now.sh)


class FittedSet(FittedNodes):
    """The nodes of one cut for all cameras while they change, leaves too; none has, or gets, an opacity above 1.

    Args:
        fixed: indices of the cut, ascending.
    """

    #: No camera chooses among the nodes by their sizes; single scales are limited, see `adam.MOST_CHANGE`.
    bounds, least_ratio = FitBounds(np.float32(1), np.float32(np.inf)), 0.0

    def __init__(self, nodes: Splats, tree: LodTree, fixed: Index, raster: RasterSettings, threads: int) -> None:
        super().__init__(nodes, tree, raster, threads)
        self._fixed = fixed
        self.fitted = fixed[: None if (~tree.is_leaf[fixed]).any() else 0]  # leaves alone are full detail
        self.shares = (len(fixed) / len(self.leaves),)

    def cut(self, camera: Camera, share: float) -> Index:
        return self._fixed


def columns_of(nodes: Splats) -> Columns:
    """Return the columns of nodes as they are fitted."""
    return Columns(nodes.center, nodes.scale, nodes.quat_xyzw, lod_opacity(nodes.opacity), nodes.rgb, nodes.sh)


def _copied(columns: Columns) -> Columns:
    return Columns(*(column.copy() for column in columns))
