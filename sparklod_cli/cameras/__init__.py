"""Cameras: poses, paths and their sources, and framing."""

#: Elevation in degrees, above their target, of the cameras of an orbit, a dolly and the overview; cameras of an orbit.
ELEVATION, ORBIT = 15.0, 60

#: Width and height of a picture, in pixels.
DEFAULT_SIZE = (1280, 720)
