"""How finely positions need to be stored."""

from __future__ import annotations

import math

import numpy as np

from ..model.scene import Scene

#: A step of the positions is at most a 16th of the standard deviation of a small splat, so that rounding shifts it by
#: at most a 32nd; small are the splats at this quantile of the largest scales. See docs/decisions.
STEPS_A_SPLAT, SMALL_QUANTILE = 16, 0.01


#: Fractional bits of the smallest float32: with these, nothing is rounded.
ALL_BITS = 149


def fine_bits(scene: Scene) -> int:
    """Fractional bits with which a step is far below the smallest splats of full detail (`STEPS_A_SPLAT`).

    `ALL_BITS` where those have no size.
    """
    scale = scene.splats.scale if scene.tree is None else scene.splats.scale[scene.tree.is_leaf]
    small = float(np.quantile(scale.max(axis=1), SMALL_QUANTILE)) if len(scale) else 0.0
    return math.ceil(math.log2(STEPS_A_SPLAT / small)) if small > 0 else ALL_BITS
