"""The axis of a scene that points up, by its name: "y", "-z"."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

#: Unit vectors of the axes, by name.
AXES: dict[str, tuple[float, float, float]] = {
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}


def rotated(axis: str | None, rotation: ArrayLike) -> str | None:
    """Return the axis nearest to where a rotation takes an axis; None for None.

    The nearest one, since a rotation by a few degrees levels a scene whose axis was only roughly up.

    Args:
        axis: one of `AXES`.
        rotation: (3, 3) matrix that multiplies column vectors.
    """
    if axis is None:
        return None
    up = np.asarray(rotation, np.float64) @ AXES[axis]
    return max(AXES, key=lambda name: float(up @ AXES[name]))


def common(axes: Iterable[str | None]) -> str | None:
    """Return the axis that all scenes have up; None where one is unknown or two differ."""
    distinct = set(axes)
    return distinct.pop() if len(distinct) == 1 else None
