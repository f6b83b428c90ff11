"""Ranges and defaults that the command line names and the library checks; imports nothing, so `--help` stays quick."""

#: Growth of the voxel grid from level to level.
MIN_BASE, MAX_BASE, DEFAULT_BASE = 1.1, 2.0, 1.5

#: Nodes for each leaf that the quality builder may make. Two would keep every node of its binary tree.
MIN_GROWTH, MAX_GROWTH, DEFAULT_GROWTH = 1.05, 2.0, 1.4

#: Highest degree of spherical harmonics that is kept.
MAX_SH_DEGREE = 3

#: Threads to work on.
MAX_THREADS = 256

#: SPZ versions that can be written, and the one that is; docs/decisions has the measurement.
SPZ_VERSIONS, DEFAULT_SPZ_VERSION = (2, 3), 3

#: Bits after the binary point of an SPZ position.
MAX_FRACTIONAL_BITS = 24

#: Deflate levels, and the one that is used; docs/decisions has the measurement.
MIN_COMPRESSION, MAX_COMPRESSION, DEFAULT_COMPRESSION = 1, 9, 5

#: What colours can mean in a picture of `inspect`.
PLOT_BY = ("level", "opacity", "size", "chunk")

#: Pixels a pixel along a side.
MAX_SUPERSAMPLE = 4

#: How many splats viewers draw by default: Spark 2's, by device, then those of its LoD design.
PRESETS = {
    "desktop": 2_500_000,
    "ios": 1_500_000,
    "android": 1_000_000,
    "vision-pro": 750_000,
    "quest": 500_000,
    "preview-desktop": 1_500_000,
    "mobile": 500_000,
}

#: Numbers that nodes can be read in: as the file has them, or as Spark's traversal holds them in memory.
PRECISIONS = ("float32", "float16")

#: Spark 2's foveation: full angles of its cones in degrees, weights at the outer one and behind the camera.
CONE_FOV0, CONE_FOV, CONE_FOVEATE, BEHIND_FOVEATE = 90.0, 120.0, 0.4, 0.2

#: Chunks that Spark fetches at a time.
FETCHERS = 3

#: Ratio of the pixel scales between which continuous cuts blend a node and its children.
BLEND = 1.25

#: No far plane is farther away, world units, so that it is a float32.
FARTHEST = 1e37

#: Axes of a file that can point up, for splats that are turned to have y up.
UP_AXES = ("y", "-y", "z", "-z")
