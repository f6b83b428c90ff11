"""`Optimiser`: moves merged splats against the gradients of pictures; and the schedule of its steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..model.splats import FloatArray
from ..render import gradients
from .kernels import adam
from .kernels.adam import Rates
from .nodes import FittedNodes, Index
from .pictures import FullDetailPicture

#: Root of the mean squared error of pictures, that of 30 dB, for which the rates are. The steps of a splat are
#: proportional to the errors of the pictures that it is in: what is wrong with the splats of a fine cut is small.
USUAL_ERROR = 0.03

#: How far the feature size of a node may go from its first value: by a factor of `MOST_REACH` of those that cuts of up
#: to `FREE_SHARE` of the leaves refine, and the logarithm of that falls with the root of the share. Which nodes a fine
#: cut refines matters more than how large they are; measured (benchmarks/notes/refining.md).
MOST_REACH, FREE_SHARE = 1.5, 0.03

#: Stages, after each of which held-out cameras decide.
STAGES = 6

#: Rates of the first steps, and those of the last ones over these. Measured (benchmarks/notes/refining.md).
RATES, LAST = Rates(0.015, 0.03, 0.008, 0.015, 0.015, 0.003), 0.02

#: Steps unless given: the most, the least, and their number times that of the leaves: 2,400 for 500,000. Chosen.
MOST_BY_DEFAULT, LEAST_BY_DEFAULT, WORK = 6000, 1000, 1_200_000_000


class Optimiser:
    """Adam for the merged splats of a tree, each with its own count of steps."""

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

    def step(self, picture: FullDetailPicture, index: Index, rates: adam.Rates) -> Index:
        """Take one step for a picture of a cut; return the nodes that it showed."""
        nodes, camera = self.nodes, picture.camera
        seen, shaded = nodes.visible(index, camera)
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
    """Return the (S,) float32 factor that bounds the change of the feature size of each merged node, either way."""
    order = np.argsort(-nodes.sizes(nodes.merged), kind="stable")
    share = np.empty(len(order))
    share[order] = np.arange(1, len(order) + 1) / len(nodes.leaves)
    return (MOST_REACH ** np.minimum(1, np.sqrt(FREE_SHARE / share))).astype(np.float32)


@dataclass(frozen=True)
class Round:
    """Cuts that are drawn for one camera: their number, and the range of their shares of the leaves."""

    cuts: int
    least: float
    most: float

    def shares(self, random: np.random.Generator) -> list[float]:
        """Return shares of the leaves, one of each part of the range, in any order."""
        ratio = self.most / self.least
        parts = random.permutation(self.cuts)
        return [float(self.least * ratio ** ((part + random.random()) / self.cuts)) for part in parts]


#: Rounds, one after the other, each with a camera of its own: what is fitted to few cameras looks right from those.
ROUNDS = (Round(2, 0.01, 0.1), Round(2, 0.1, 0.5))


def default_steps(leaves: int) -> int:
    """Return the default number of steps for a tree of so many leaves."""
    return max(LEAST_BY_DEFAULT, min(MOST_BY_DEFAULT, WORK // leaves))


def rates_at(progress: float) -> Rates:
    """Return the rates after a share of the steps, 0..1: half a wave of a cosine."""
    factor = LAST + (1 - LAST) * 0.5 * (1 + math.cos(math.pi * progress))
    return Rates(*(rate * factor for rate in RATES))
