"""Round numbers for the ticks of an axis."""

from __future__ import annotations

import math


def nice_step(least: float) -> float:
    """The smallest number of the form 1, 2 or 5 times a power of ten that is not below `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(step for step in (power, 2 * power, 5 * power, 10 * power, 20 * power) if step >= least * (1 - 1e-9))


def ticks(low: float, high: float, least: float) -> list[tuple[float, str]]:
    """Round numbers from `low` to `high`, at least `least` apart, and their texts."""
    step = nice_step(least)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    plain = step > 1e-5 and max(abs(low), abs(high)) < 1e7
    return [(step * n, f"{step * n:.{digits}f}" if plain else f"{step * n:.6g}") for n in range(first, last + 1)]
