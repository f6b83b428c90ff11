"""How finely positions need to be stored."""

from __future__ import annotations

import math

from .binades import Binades

#: A step of the positions is at most a 16th of the standard deviation of a small splat, so that rounding shifts it by
#: at most a 32nd; small are the splats at this quantile of the largest scales. See docs/decisions.
STEPS_A_SPLAT, SMALL_QUANTILE = 16, 0.01


#: Fractional bits of the smallest float32: with these, nothing is rounded.
ALL_BITS = 149


def fine_bits(leaf_scale: Binades) -> int:
    """Fractional bits with which a step is far below the smallest splats of full detail (`STEPS_A_SPLAT`).

    A step is a power of two, so the binade of the small splats is all that matters.

    Args:
        leaf_scale: the largest scale of each splat of full detail; `ALL_BITS` where the small ones have no size.
    """
    small = leaf_scale.quantile(SMALL_QUANTILE)
    return math.ceil(math.log2(STEPS_A_SPLAT / small)) if 0 < small < math.inf else ALL_BITS
