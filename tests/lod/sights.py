"""A view of any fields of view, in place of a `Camera`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class CutView:
    """A camera for cuts.

    Attributes:
        camera_to_world: (4, 4), axes of OpenGL: x to the right, y up, looking along -z.
        fov_x, fov_y: radians.
        width, height: of the picture, pixels.
    """

    camera_to_world: NDArray[np.float64]
    fov_x: float
    fov_y: float
    width: int = 640
    height: int = 480
