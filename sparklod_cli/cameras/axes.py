"""`Axes`: what the numbers of a pose mean. Imports nothing heavy, because the command line names them in its help."""

from __future__ import annotations

from enum import Enum


class Axes(Enum):
    """Which way a camera's own axes point, and which way its matrix leads.

    In OpenGL's axes, which are those of Blender, three.js and nerfstudio, y is up and the camera looks along -z. In
    OpenCV's, which are those of COLMAP, y is down and it looks along +z. x is to the right in both. A matrix leads from
    the camera to the world (its last column is where the camera is), or from the world to the camera.
    """

    OPENGL_C2W = "opengl-c2w"
    OPENCV_C2W = "opencv-c2w"
    OPENGL_W2C = "opengl-w2c"
    OPENCV_W2C = "opencv-w2c"

    @property
    def opencv(self) -> bool:
        """Whether y is down."""
        return self in (Axes.OPENCV_C2W, Axes.OPENCV_W2C)

    @property
    def from_world(self) -> bool:
        """Whether the matrix leads from the world to the camera."""
        return self in (Axes.OPENGL_W2C, Axes.OPENCV_W2C)
