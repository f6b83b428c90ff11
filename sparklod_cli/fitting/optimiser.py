"""`Optimiser`: moves merged splats against the gradients of pictures; and the schedule of its steps."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..render import gradients
from .kernels import adam
from .kernels.adam import Rates
from .nodes import FittedNodes, Index
from .pictures import FullDetailPicture

#: Stages, after each of which held-out cameras decide.
STAGES = 12

#: Rates of the first steps, and those of the last ones over these. Measured (benchmarks/notes/refining.md).
RATES, LAST = Rates(0.006, 0.012, 0.003, 0.006, 0.006, 0.0012), 0.02

#: Steps unless given: the most, the least, and their number times that of the leaves. Chosen.
MOST_BY_DEFAULT, LEAST_BY_DEFAULT, WORK = 12_000, 1000, 3_000_000_000


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
        """Take one step for a picture of a cut."""
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
        """Bring the columns of the nodes up to date; here they always are."""


def slots_of(nodes: FittedNodes) -> NDArray[np.int32]:
    """Return the row of each node in `Moments`, -1 for those that do not change."""
    slots = np.full(len(nodes.tree), -1, np.int32)
    slots[nodes.fitted] = np.arange(len(nodes.fitted), dtype=np.int32)
    return slots


class Schedule:
    """Steps that remain, and their rates: half a wave of a cosine, from `RATES` to `LAST` of them.

    Attributes:
        done, remaining: numbers of steps.
    """

    def __init__(self, steps: int) -> None:
        self.done, self.remaining = 0, steps
        self._stage = -(-steps // STAGES)
        self._progress = 0.0

    @property
    def stage_steps(self) -> int:
        """Steps of the next stage."""
        return min(self._stage, self.remaining)

    def rates(self) -> Rates:
        """Return the rates of the next step."""
        factor = LAST + (1 - LAST) * 0.5 * (1 + math.cos(math.pi * self._progress))
        return Rates(*(rate * factor for rate in RATES))

    def advance(self) -> None:
        """Count a step."""
        self._progress += (1 - self._progress) / self.remaining
        self.done += 1
        self.remaining -= 1

    def shorten(self) -> None:
        """Leave out half of the steps that remain, and all if less than a stage remains."""
        self.remaining = self.remaining // 2 if self.remaining > self._stage else 0


def default_steps(leaves: int) -> int:
    """Return the default number of steps for a tree of so many leaves."""
    return max(LEAST_BY_DEFAULT, min(MOST_BY_DEFAULT, WORK // leaves))
