"""`FittedNodes`: the nodes of a tree while they change, and what cameras see of them."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..lod.traversal import Forest, Traversal, TreeInstance, View
from ..model.foveation import Cones
from ..model.gaussian import linear_opacity, lod_opacity
from ..model.lod_tree import LodTree
from ..model.splats import FloatArray, Splats
from ..render.shading import ShadedSplats, shade
from ..scenes.loaded_scene import nodes_of

Index = NDArray[np.int64]


class FittedNodes:
    """The nodes of a tree while they change.

    Args:
        nodes: N nodes, as they are at first.
        tree: of them.
        threads: to prepare them on.

    Attributes:
        splats: N, as they are now, but for the opacity; columns are changed in place.
        lod_opacity: (N,) float32 D, as they are now.
        leaves: indices of full detail, ascending.
        merged: (N,) bool, the nodes that may change.
    """

    def __init__(self, nodes: Splats, tree: LodTree, threads: int) -> None:
        self.original, self.tree = nodes, tree
        self.splats = dataclasses.replace(
            nodes, **{field.name: getattr(nodes, field.name).copy() for field in dataclasses.fields(Splats)}
        )
        self.lod_opacity = lod_opacity(nodes.opacity)
        self.merged = ~tree.is_leaf
        self.leaves: Index = np.flatnonzero(tree.is_leaf)
        self._forest = Forest([nodes_of(nodes, tree, "float16", threads)])
        self._traversal = Traversal(self._forest, [TreeInstance(foveation=Cones())])

    def cut(self, camera: Camera, share: float) -> Index:
        """The nodes of a cut of this share of the leaves, ascending, without a pixel-scale limit or foveation."""
        budget = max(1, int(share * len(self.leaves)))
        view = View(camera.camera_to_world, camera.fov_x, camera.fov_y)
        return self._traversal.cut(view, budget=budget).indices()[0].astype(np.int64)

    def shaded(self, index: Index, camera: Camera) -> ShadedSplats:
        """Some nodes as a camera sees them."""
        return shade([(self.result().take(index), np.eye(4))], camera)

    def result(self) -> Splats:
        """All nodes as they are now; what has not changed is the same bit for bit."""
        same = self.lod_opacity == lod_opacity(self.original.opacity)
        opacity: FloatArray = np.where(same, self.original.opacity, linear_opacity(self.lod_opacity))
        return dataclasses.replace(self.splats, opacity=opacity)
