"""The axis of a file that points up: the one that its format specifies, the assumed one, and messages about it.

A note of sparklod, or the coordinate system of an SPZ 4, says it of one file. Without one, formats of `SPECIFIED` are
taken at their word, and outputs note that axis. All other formats, and trees in SPZ, have the axes of whatever they
were made from: their axis is unknown and not noted, and cameras take `ASSUMED`. No coordinate is turned unless a user
asks for it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

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

#: By format, the axis that points up by its specification. z is up in a tileset of 3D Tiles, and y in the glTF of its
#: tiles, whose axes splats are read in. Files of SPZ without a tree; Spark's builder and sparklod's keep other axes.
SPECIFIED: Mapping[str, str] = {"SPZ": "y", "glTF": "y"}

#: The axis that cameras take for up in scenes that do not say it: training leaves them with y down.
ASSUMED = "-y"


def line(up: str | None, up_by: str) -> tuple[str, ...]:
    """Return the message on an axis that a specification names, which a file may contradict; empty for other axes.

    Args:
        up, up_by: of a `Scene`.
    """
    if up is None or not up_by:
        return ()
    return (f"{up} is up, as {up_by} specifies; if the scene is upside down, its converter kept y down: give --up -y",)


def lines_of(files: Iterable[tuple[str, str | None, str]]) -> list[str]:
    """Return the messages on the axes of files that are shown together: that of each file, and one if they differ.

    Args:
        files: the name of each, and `up` and `up_by` of its scene.
    """
    each = list(dict.fromkeys(files))
    messages = [f"{name}: {text}" for name, up, up_by in each for text in line(up, up_by)]
    return messages + [f"{text}, so {ASSUMED} is taken; --up chooses" for text in differing(up for _, up, _ in each)]


def differing(axes: Iterable[str | None]) -> tuple[str, ...]:
    """Return the beginning of a sentence that names the different axes of files; empty if all have the same."""
    names = list(dict.fromkeys(axis or "unknown" for axis in axes))
    return (f"the files differ in the axis that is up ({', '.join(names)})",) if len(names) > 1 else ()


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
