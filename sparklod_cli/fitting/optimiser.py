"""`Optimiser`: moves merged splats against the gradients of pictures."""

from __future__ import annotations

import numpy as np

from ..model.splats import FloatArray
from ..render import gradients
from .kernels import adam
from .nodes import FittedNodes, Index
from .pictures import Picture

#: Root of the mean squared error of pictures, that of 30 dB, for which the rates are. The steps of a splat are
#: proportional to the errors of the pictures that it is in: what is wrong with the splats of a fine cut is small.
USUAL_ERROR = 0.03

#: How far the feature size of a node may go from its first value: by a factor of `MOST_REACH` of those that cuts of up
#: to `FREE_SHARE` of the leaves refine, and the logarithm of that falls with the root of the share. Which nodes a fine
#: cut refines matters more than how large they are; measured (docs/decisions/2026-11-22-refine.md).
MOST_REACH, FREE_SHARE = 1.5, 0.03


class Optimiser:
    """Adam for the merged splats of a tree, each with its own count of steps.

    Args:
        nodes: that are moved.
    """

    def __init__(self, nodes: FittedNodes) -> None:
        self.nodes = nodes
        count, terms = len(nodes.merged), nodes.columns.sh.shape[1]
        self._slots = np.full(len(nodes.tree), -1, np.int32)
        self._slots[nodes.merged] = np.arange(count, dtype=np.int32)
        self._moments = adam.Moments(
            np.zeros((count, adam.FIRST), np.float32),
            np.zeros((count, terms, 3), np.float32),
            np.zeros((count, adam.SECOND), np.float32),
            np.zeros(count, np.int32),
            reach_of(nodes),
        )

    def step(self, picture: Picture, index: Index, rates: adam.Rates) -> Index:
        """One step for a picture of a cut; returns the nodes that it showed."""
        nodes, camera = self.nodes, picture.camera
        seen, shaded = nodes.seen(index, camera)
        drawing = gradients.draw(shaded, camera, nodes.raster)
        by_image, error = picture.gradient(drawing.image)
        found = drawing.gradients(by_image)
        terms = nodes.columns.sh.shape[1]
        rgb, sh = gradients.by_sh(shaded.center, camera.position, terms, shaded.rgb, found.rgb)
        derivatives = found.center, found.log_scale, found.turn, found.lod_opacity, rgb, sh
        columns = adam.Gradients(*map(np.ascontiguousarray, derivatives))
        rates = adam.Rates(*map(np.float32, rates))
        precision = np.float32((USUAL_ERROR / error) ** 2)
        adam.step(nodes.columns, nodes.old, seen, self._slots, columns, rates, self._moments, precision)
        return seen


def reach_of(nodes: FittedNodes) -> FloatArray:
    """(S,) float32 of each merged node: most that its feature size may become of the first one, or that of it."""
    order = np.argsort(-nodes.sizes(nodes.merged), kind="stable")
    share = np.empty(len(order))
    share[order] = np.arange(1, len(order) + 1) / len(nodes.leaves)
    return (MOST_REACH ** np.minimum(1, np.sqrt(FREE_SHARE / share))).astype(np.float32)
