"""Logarithms in place of scales, as drafts of KHR_gaussian_splatting had them until April 2026.

The extension demands linear scales, so the values have to tell, and the program that wrote them.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from ...model.splats import FloatArray
from .attributes import Attribute

#: Programs that wrote logarithms: gsbox up to version 4, and splat-transform before version 2.7, of June 2026.
WRITERS = re.compile(r"gsbox v?[0-4]\.|splat-transform v?(?:1\.|2\.[0-6]\.)", re.ASCII)

#: Share of splats with a scale below 0 from which on scales are logarithms, since broken files have a few; and how far
#: below 0 half of these must be, since linear scales of mirrored splats are small. Chosen.
NEGATIVE, BELOW = 0.1, 0.1

#: Largest ratio of the 99th to the first percentile of positive values that may be logarithms. That of linear scales of
#: real scenes is above 100, that of their logarithms below 10. Chosen.
NARROW = 20.0

#: Fewest splats of which positive values are judged. Chosen.
LEAST = 100

#: How many times the distance of splats their linear scale may be; in real scenes it is 0.8 to 3 times that. Chosen.
WIDE = 8.0

READ = "its scales are logarithms, as gsbox and splat-transform before version 2.7 write them, and are read as such"


def are_logs(scales: FloatArray, generator: object) -> bool:
    """Return whether scales are logarithms beyond doubt.

    Args:
        scales: (n, 3) values as the file has them, of splats from all over it.
        generator: of the file.
    """
    if isinstance(generator, str) and WRITERS.match(generator):
        return True
    negative = scales[scales < 0]
    share = float((scales < 0).any(axis=1).mean()) if len(scales) else 0.0
    return share >= NEGATIVE and float((negative < -BELOW).mean()) >= 0.5


def decoded(attribute: Attribute) -> Attribute:
    """Return an attribute whose values are logarithms."""
    return replace(attribute, decode=np.exp)


def doubt_about(scales: FloatArray, centers: FloatArray, count: int) -> str | None:
    """Return a note on linear scales that may be logarithms, all of them positive; None where nothing speaks for it.

    Args:
        scales, centers: (n, 3) values as the file has them, of splats from all over it.
        count: all splats of the file.
    """
    if count < LEAST or not (np.isfinite(scales).all() and np.isfinite(centers).all() and (scales > 0).all()):
        return None
    low, middle, high = np.quantile(scales.astype(np.float64), (0.01, 0.5, 0.99))
    sides = np.sort(np.subtract(*np.quantile(centers.astype(np.float64), (0.9, 0.1), axis=0)))
    distance = float(np.sqrt(sides[1] * sides[2] / (0.64 * count)))  # of splats on surfaces, but for far ones
    if high > NARROW * low or high - low < 1e-3 or not distance > 0 or middle < 0.1:
        return None
    as_scale, as_log = np.log(middle / distance), middle - np.log(distance)
    if as_scale <= np.log(WIDE) and abs(as_log) > abs(as_scale) - 1:
        return None
    return (
        f"its scales, {low:.3g} to {high:.3g}, look like logarithms, as gsbox and splat-transform before version 2.7"
        " write them, but are read as linear ones; if they are logarithms, write the file anew by a newer version"
    )
