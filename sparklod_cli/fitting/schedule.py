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
    """What is drawn of what one camera sees.

    Attributes:
        size: of its pictures, over that of held-out ones.
        cuts: how many.
        least, most: range of their shares of the leaves.
    """

    size: float
    cuts: int
    least: float
    most: float

    def shares(self, random: np.random.Generator) -> list[float]:
        """Shares of the leaves, one of each part of the range, in any order."""
        ratio = self.most / self.least
        return [
            float(self.least * ratio ** ((at + random.random()) / self.cuts)) for at in random.permutation(self.cuts)
        ]


#: Rounds, one after the other: the splats of coarse cuts are large, so that small pictures show what is wrong with them
#: as well, in a third of the time.
ROUNDS = (Round(0.5, 2, 0.01, 0.1), Round(1.0, 2, 0.1, 0.5))

#: Rates of the first steps, and those of the last ones over these. Measured (docs/decisions/2026-11-22-refine.md).
RATES, LAST = Rates(0.015, 0.03, 0.008, 0.015, 0.015, 0.003), 0.02

#: Steps unless given, for trees of any size. Chosen.
DEFAULT_STEPS = 6000


def rates_at(progress: float) -> Rates:
    """The rates after a share of the steps, 0..1: half a wave of a cosine."""
    factor = LAST + (1 - LAST) * 0.5 * (1 + math.cos(math.pi * progress))
    return Rates(*(rate * factor for rate in RATES))
