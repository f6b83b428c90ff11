"""How far regions are from a camera, for the choice of their detail levels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .detail_rule import DetailRule

if TYPE_CHECKING:
    from .traversal import View

Matrix = NDArray[np.float64]
Distances = NDArray[np.float64]

#: Distances are those of a camera whose narrower field of view is 45 degrees; others see as large from farther away.
REFERENCE_TANGENT = math.tan(math.radians(22.5))

#: Squared world units below which nothing is behind the camera.
NO_BEHIND = 1e-4


class RegionBounds:
    """Bounds of regions as PlayCanvas holds them: in float32, each with what it has more than the median.

    Args:
        bounds: (R, 2, 3) lowest and highest corner of each, in the space of the scene.

    Attributes:
        low, high: (R, 3) float64.
        excess: (R, 3) float64, half of each side, less half of the median side along the axis; not less than 0.
    """

    def __init__(self, bounds: Matrix) -> None:
        center, half = bounds.sum(axis=1) * 0.5, (bounds[:, 1] - bounds[:, 0]) * 0.5
        self.low = (center - half).astype(np.float32).astype(np.float64)
        self.high = (center + half).astype(np.float32).astype(np.float64)
        half32 = ((self.high - self.low) * 0.5).astype(np.float32)
        median = np.sort(half32, axis=0)[len(half32) // 2].astype(np.float64)
        self.excess = np.maximum(half32 - median, 0).astype(np.float32).astype(np.float64)

    def squared_distances(self, view: View, object_to_world: Matrix, rule: DetailRule) -> Distances:
        """(R,) squares of the distances by which levels are chosen, in world units of a field of view of 45 degrees.

        The distance is that from the camera to the nearest point of the bound, shrunk by `rule.shrink` of its excess;
        what lies behind the camera counts as farther. As `GSplatOctreeInstance.evaluateNodeDistances` of PlayCanvas.

        Args:
            view: the camera.
            object_to_world: (4, 4) where the scene stands: a rotation, a uniform scale and a translation.
            rule: for its `shrink` and `behind_penalty`.
        """
        # PlayCanvas holds matrices in float32.
        placed, camera = (
            matrix.astype(np.float32).astype(np.float64) for matrix in (object_to_world, view.camera_to_world)
        )
        world_to_object = np.linalg.inv(placed).astype(np.float32).astype(np.float64)
        eye = world_to_object[:3, :3] @ camera[:3, 3] + world_to_object[:3, 3]
        forward = world_to_object[:3, :3] @ -_unit(camera[:3, 2])
        forward = _unit(forward)
        low, high = self.low + self.excess * rule.shrink, self.high - self.excess * rule.shrink
        offset = np.where(eye < low, low, np.where(eye > high, high, eye)) - eye
        squared: Distances = (offset**2).sum(axis=1)
        factor = np.ones(len(squared))
        ahead = offset @ forward
        behind = (squared > NO_BEHIND) & (ahead < 0)
        factor[behind] += -ahead[behind] / np.sqrt(squared[behind]) * (rule.behind_penalty - 1)
        tangent = min(math.tan(view.fov_x / 2), math.tan(view.fov_y / 2))
        scale = tangent / REFERENCE_TANGENT * float(np.linalg.norm(placed[:3, 0]))
        return squared * factor * factor * (scale * scale)


def _unit(vector: Matrix) -> Matrix:
    unit: Matrix = vector / np.linalg.norm(vector)
    return unit
