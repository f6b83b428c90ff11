"""`Optimiser`: steps that move the merged splats of a tree towards pictures of full detail."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..render import gradients
from .kernels import adam
from .pictures import FittedNodes, FullDetailPicture, Index


class Optimiser:
    """Adam for the merged splats of a tree, each with its own count of steps."""

    def __init__(self, nodes: FittedNodes) -> None:
        self.nodes = nodes
        self._moved: list[Any] = []
        count, terms = len(nodes.fitted), nodes.columns.sh.shape[1]
        self._slots = slots_of(nodes)
        self._moments = adam.Moments(
            np.zeros((count, adam.FIRST), np.float32),
            np.zeros((count, terms, 3), np.float32),
            np.zeros((count, adam.SECOND), np.float32),
            np.zeros(count, np.int32),
        )

    def step(self, picture: FullDetailPicture, index: Index, rates: adam.Rates) -> None:
        nodes, camera = self.nodes, picture.camera
        seen, shaded = nodes.visible(index, camera)
        drawing = gradients.draw(shaded, camera, nodes.raster)
        found = drawing.gradients(picture.gradient(drawing.image))
        terms = nodes.columns.sh.shape[1]
        rgb, sh = gradients.by_sh(shaded.center, camera.position, terms, shaded.rgb, found.rgb)
        derivatives = found.center, found.log_scale, found.turn, found.lod_opacity, rgb, sh
        columns = adam.Gradients(*map(np.ascontiguousarray, derivatives))
        rates = adam.Rates(*map(np.float32, rates))
        adam.step(len(seen), nodes.columns, nodes.old, seen, self._slots, columns, rates, self._moments, nodes.bounds)
        self._moved.append(seen)

    def place(self) -> None:
        """Update the nodes that cuts are found with, by the steps since the last call."""
        for seen in self._moved:
            self.nodes.renew(seen)
        self._moved.clear()

    def synchronize(self) -> None:
        """Update the columns of the nodes, which are always up to date here."""


def slots_of(nodes: FittedNodes) -> NDArray[np.int32]:
    """Return the row of each node in `Moments`, -1 for those that do not change."""
    slots = np.full(len(nodes.tree), -1, np.int32)
    slots[nodes.fitted] = np.arange(len(nodes.fitted), dtype=np.int32)
    return slots
