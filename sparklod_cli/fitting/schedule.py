"""What each step draws and how far it goes: budgets, rates and stages."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .kernels.adam import Rates

#: Stages, after each of which held-out cameras decide.
STAGES = 6


@dataclass(frozen=True)
class Round:
    """Which cuts are drawn of what one camera sees.

    Attributes:
        cuts: how many.
        least, most: range of their shares of the leaves.
    """

    cuts: int
    least: float
    most: float

    def shares(self, random: np.random.Generator) -> list[float]:
        """Shares of the leaves, one of each part of the range, in any order."""
        ratio = self.most / self.least
        parts = random.permutation(self.cuts)
        return [float(self.least * ratio ** ((part + random.random()) / self.cuts)) for part in parts]


#: Rounds, one after the other, each with a camera of its own: what is fitted to few cameras looks right from those.
ROUNDS = (Round(2, 0.01, 0.1), Round(2, 0.1, 0.5))

#: Rates of the first steps, and those of the last ones over these. Measured (docs/decisions/2026-11-22-refine.md).
RATES, LAST = Rates(0.015, 0.03, 0.008, 0.015, 0.015, 0.003), 0.02

#: Steps unless given: the most, the least, and their number times that of the leaves: 2,400 for 500,000. Chosen.
MOST_BY_DEFAULT, LEAST_BY_DEFAULT, WORK = 6000, 1000, 1_200_000_000


def default_steps(leaves: int) -> int:
    """The number of steps unless given, by the leaves of a tree."""
    return max(LEAST_BY_DEFAULT, min(MOST_BY_DEFAULT, WORK // leaves))


def rates_at(progress: float) -> Rates:
    """The rates after a share of the steps, 0..1: half a wave of a cosine."""
    factor = LAST + (1 - LAST) * 0.5 * (1 + math.cos(math.pi * progress))
    return Rates(*(rate * factor for rate in RATES))
