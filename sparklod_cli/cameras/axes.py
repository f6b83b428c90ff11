"""`Axes`: conventions of pose matrices. Imports nothing heavy: `--help` names them."""

from __future__ import annotations

from enum import Enum


class Axes(Enum):
    """Directions of a camera's own axes, and direction of its matrix.

    In OpenGL's axes, also those of Blender, three.js and nerfstudio, y points up and the camera looks along -z. In
    OpenCV's, also those of COLMAP, y points down and the camera looks along +z. In both x points right. A matrix
    transforms from camera to world (its last column is the position of the camera) or from world to camera.
    """

    OPENGL_C2W = "opengl-c2w"
    OPENCV_C2W = "opencv-c2w"
    OPENGL_W2C = "opengl-w2c"
    OPENCV_W2C = "opencv-w2c"

    @property
    def opencv(self) -> bool:
        """Whether y points down and the camera looks along +z."""
        return self in (Axes.OPENCV_C2W, Axes.OPENCV_W2C)

    @property
    def from_world(self) -> bool:
        """Whether the matrix transforms from world to camera."""
        return self in (Axes.OPENGL_W2C, Axes.OPENCV_W2C)
