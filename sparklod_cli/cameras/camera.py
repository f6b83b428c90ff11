"""`Camera`, a pinhole camera somewhere in the world."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, in the axes of OpenGL and three.js: x to the right, y up, looking along -z.

    Attributes:
        camera_to_world: (4, 4) float64, a rotation and a position (world units), without scale.
        width, height: of the image, pixels.
        focal: fx, fy in pixels.
        principal: cx, cy, where the optical axis meets the image, in pixels from its upper left corner.
        time: seconds since the start of its path.
        name: of its frame, for people; may be empty.
    """

    camera_to_world: Matrix
    width: int
    height: int
    focal: tuple[float, float]
    principal: tuple[float, float]
    time: float = 0.0
    name: str = ""

    @property
    def position(self) -> Matrix:
        """(3,) world units."""
        return self.camera_to_world[:3, 3]

    @property
    def forward(self) -> Matrix:
        """(3,) unit vector along the optical axis, in the world."""
        return -self.camera_to_world[:3, 2]

    @property
    def fov_x(self) -> float:
        """Horizontal field of view in radians, as if the principal point were the image's centre."""
        return 2 * math.atan(self.width / (2 * self.focal[0]))

    @property
    def fov_y(self) -> float:
        """Vertical field of view in radians, as if the principal point were the image's centre."""
        return 2 * math.atan(self.height / (2 * self.focal[1]))
