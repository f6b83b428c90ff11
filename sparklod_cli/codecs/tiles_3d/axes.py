"""Axes of 3D Tiles: z is up in a tileset and its bounding volumes, y in the glTF content of its tiles.

A viewer turns content from y up to z up when it loads it: (x, y, z) becomes (x, -z, y). Facts: 3D Tiles 1.1, "glTF
transforms".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...model.scene import Bounds
from ..glb.placement import rotation_of_up

#: The turn from the axes of glTF to those of tilesets, of column vectors.
Y_TO_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def to_tileset(up: str | None) -> NDArray[np.float64]:
    """Return the (3, 3) rotation from the axes of splats in a GLB of ours, of which `up` is up, to the tileset's.

    Its entries are 0, 1 and -1, so that boxes stay boxes.
    """
    return Y_TO_Z @ rotation_of_up(up)


def turned(bounds: Bounds, rotation: NDArray[np.float64]) -> Bounds:
    """Return (..., 2, 3) corners of the boxes around turned ones.

    Args:
        bounds: (..., 2, 3) lowest and highest corners.
        rotation: (3, 3), of column vectors.
    """
    middle, half = bounds.mean(axis=-2), (bounds[..., 1, :] - bounds[..., 0, :]) / 2
    center, reach = middle @ rotation.T, half @ np.abs(rotation).T
    return np.stack([center - reach, center + reach], axis=-2)
