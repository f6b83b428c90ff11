"""Quantiles of numbers of regions or tiles, weighted or not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Quantiles, by name.
QUANTILES = {"min": 0.0, "p25": 0.25, "p50": 0.5, "p75": 0.75, "max": 1.0}


def quantiles_of(values: Sequence[float], weights: Sequence[float] | None = None) -> dict[str, float]:
    """Return the quantiles of values, each of them one of these, and their mean.

    Args:
        values: one or more.
        weights: of the values, not all 0; without, all count the same.
    """
    numbers = np.asarray(values, np.float64)
    order = np.argsort(numbers, kind="stable")
    weighed = np.ones(len(numbers)) if weights is None else np.asarray(weights, np.float64)
    below = np.cumsum(weighed[order])
    places = np.searchsorted(below, [share * below[-1] for share in QUANTILES.values()])
    found = numbers[order][places]
    mean = float(numbers @ (weighed / below[-1]))
    return {name: float(f"{each:.6g}") for name, each in [*zip(QUANTILES, found, strict=True), ("mean", mean)]}
