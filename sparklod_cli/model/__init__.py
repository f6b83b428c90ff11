"""Data model: splats, scenes and Level-of-Detail trees, independent of file formats."""

#: Highest supported degree of spherical harmonics; higher coefficients are dropped.
MAX_SH_DEGREE = 3

#: Largest distance of the far plane, in world units, so that it fits a float32.
FARTHEST = 1e37

#: Axes that may point up in an input; the splats are rotated so that y does.
UP_AXES = ("y", "-y", "z", "-z")

#: Name of all instances together in tables.
TOTAL = "total"
