"""What each step draws and how far it goes: budgets, rates and stages."""

from __future__ import annotations

import math

import numpy as np

from .kernels.adam import Rates

#: Stages, after each of which held-out cameras decide.
STAGES = 4

#: Cuts that are drawn of what one camera sees, and the range of their shares of the leaves.
CUTS, LEAST_SHARE, MOST_SHARE = 5, 0.01, 0.5

#: Rates of the first steps, and those of the last ones over these. Measured (docs/decisions/2026-11-22-refine.md).
RATES, LAST = Rates(0.01, 0.02, 0.005, 0.01, 0.01, 0.002), 0.02

#: Steps unless given, for trees of any size. Chosen.
DEFAULT_STEPS = 2000


def rates_at(progress: float) -> Rates:
    """The rates after a share of the steps, 0..1: half a wave of a cosine."""
    factor = LAST + (1 - LAST) * 0.5 * (1 + math.cos(math.pi * progress))
    return Rates(*(rate * factor for rate in RATES))


def shares_of(random: np.random.Generator) -> list[float]:
    """Shares of the leaves for one camera's cuts, one of each part of the range, in any order."""
    ratio = MOST_SHARE / LEAST_SHARE
    return [float(LEAST_SHARE * ratio ** ((at + random.random()) / CUTS)) for at in random.permutation(CUTS)]
