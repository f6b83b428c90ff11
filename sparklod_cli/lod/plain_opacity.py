"""Splats that are more than opaque as ones of opacity 1, for formats that hold no more.

A splat of linear opacity A > 1 has the alpha p(z) = 1 - (1 - exp(-z^2 / 2)) ** A, flat on top. A plain Gaussian of
opacity 1 and k times the scale has g(z) = exp(-z^2 / (2 k^2)). Both are isotropic on the screen, in standard deviations
of the splat, so k depends on A alone. It is the one that covers as much: the integral of p over the plane is 2 pi H(A),
with the harmonic number H (see `model/falloff.py`), that of g is 2 pi k^2, so k = sqrt(H(A)).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ..model.falloff import harmonic
from ..model.splats import Splats


def with_plain_opacity(splats: Splats) -> Splats:
    """The same splats with opacities of at most 1, those above enlarged so that they cover as much on the screen."""
    above = np.flatnonzero(splats.opacity > 1)
    if not above.size:
        return splats
    scale, opacity = splats.scale.copy(), splats.opacity.copy()
    factor = np.sqrt(harmonic(opacity[above].astype(np.float64))[0])
    with np.errstate(over="ignore"):
        scale[above] = np.minimum(scale[above] * factor[:, None], np.finfo(np.float32).max)
    opacity[above] = 1
    return dataclasses.replace(splats, scale=scale, opacity=opacity)
