"""`Camera`, a pinhole camera somewhere in the world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..system.errors import CameraPathError
from . import DEFAULT_SIZE

Matrix = NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class Camera:
    """A pinhole camera, in the axes of OpenGL and three.js: x to the right, y up, looking along -z.

    Attributes:
        camera_to_world: (4, 4) float64, a rotation and a position (world units), without scale.
        width, height: of the image, pixels.
        focal: fx, fy in pixels.
        principal: cx, cy, where the optical axis meets the image, in pixels from its upper left corner.
        time: seconds since the start of its path.
        name: of its frame, for display; may be empty.
    """

    camera_to_world: Matrix
    width: int
    height: int
    focal: tuple[float, float]
    principal: tuple[float, float]
    time: float = 0.0
    name: str = ""

    @classmethod
    def look_at(
        cls,
        eye: Sequence[float],
        target: Sequence[float],
        *,
        up: Sequence[float] = (0.0, -1.0, 0.0),
        fov_y: float = 60.0,
        size: tuple[int, int] = DEFAULT_SIZE,
        time: float = 0.0,
        name: str = "",
    ) -> Camera:
        """Return a camera at a point that looks at another.

        Args:
            eye, target: x, y, z in world units.
            up: x, y, z of what is up in the picture; -y in scenes as training leaves them.
            fov_y: vertical field of view, degrees.
            size: width and height of the image, pixels.
            time: seconds since the start of its path.
            name: of its frame, for display.

        Raises:
            CameraPathError: eye and target are the same point, or a number is out of its range.
        """
        from .pose import look_at  # which needs this module

        for what, vector in (("eye", eye), ("target", target), ("up", up)):
            if np.shape(vector) != (3,):
                raise CameraPathError(f"{what} is {vector!r}; give x, y, z")
        if any(int(side) != side for side in size):
            raise CameraPathError(f"a camera of {size[0]} x {size[1]} pixels; give whole numbers")
        if not 0 < fov_y < 180 or min(size) < 1:
            raise CameraPathError(f"a camera of {fov_y:g} degrees and {size[0]} x {size[1]} pixels sees nothing")
        try:
            pose = look_at(eye, target, up)
        except ValueError as error:
            raise CameraPathError(f"the camera {error}") from None
        focal = size[1] / (2 * math.tan(math.radians(fov_y) / 2))
        return cls(pose, *size, (focal, focal), (size[0] / 2, size[1] / 2), time, name)

    def __repr__(self) -> str:
        at, ahead = (", ".join(f"{value:.4g}" for value in vector) for vector in (self.position, self.forward))
        view = f"{math.degrees(self.fov_y):.4g} degrees, {self.width} x {self.height}"
        return f"Camera(at {at}, looking along {ahead}, {view})"

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
