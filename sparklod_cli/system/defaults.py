"""Ranges and defaults shared by the command line and the library. Imports nothing, so that `--help` stays fast."""

#: Ratio of the voxel sizes of successive levels in the quick builder.
MIN_BASE, MAX_BASE, DEFAULT_BASE = 1.1, 2.0, 1.5

#: Maximum ratio of nodes to leaves in the quality builder; 2 keeps every node of its binary tree.
MIN_GROWTH, MAX_GROWTH, DEFAULT_GROWTH = 1.05, 2.0, 1.4

#: Highest supported degree of spherical harmonics; higher coefficients are dropped.
MAX_SH_DEGREE = 3

#: Largest accepted number of threads.
MAX_THREADS = 256

#: SPZ versions that can be written, those that hold trees, and the default; see docs/decisions/05-spz.md.
SPZ_VERSIONS, TREE_SPZ_VERSIONS, DEFAULT_SPZ_VERSION = (2, 3, 4), (2, 3), 3

#: Largest number of fractional bits of an SPZ position.
MAX_FRACTIONAL_BITS = 24

#: Deflate levels, and the default; measured in docs/decisions/05-spz.md.
MIN_COMPRESSION, MAX_COMPRESSION, DEFAULT_COMPRESSION = 1, 9, 5

#: Entries of a palette of spherical harmonics: Spark's labels have 16 bits.
MIN_SH_CODES, MAX_SH_CODES = 2, 65_536

#: Quantities by which `inspect` can colour a picture.
PLOT_BY = ("level", "opacity", "size", "chunk")

#: Largest supersampling factor: samples per pixel along each axis.
MAX_SUPERSAMPLE = 4

#: Default splat budgets by device: those of Spark 2, then those of Spark's LoD design.
PRESETS = {
    "desktop": 2_500_000,
    "ios": 1_500_000,
    "android": 1_000_000,
    "vision-pro": 750_000,
    "quest": 500_000,
    "preview-desktop": 1_500_000,
    "mobile": 500_000,
}

#: Precision of the nodes: that of the file, or the float16 in which Spark's traversal stores them.
PRECISIONS = ("float32", "float16")

#: Spark 2's foveation: full angles of its cones in degrees, weights at the outer one and behind the camera.
CONE_FOV0, CONE_FOV, CONE_FOVEATE, BEHIND_FOVEATE = 90.0, 120.0, 0.4, 0.2

#: Number of chunks that Spark fetches concurrently.
FETCHERS = 3

#: Width of the blending range of continuous cuts, as a ratio of pixel scales.
BLEND = 1.25

#: Largest distance of the far plane, in world units, so that it fits a float32.
FARTHEST = 1e37

#: Elevation in degrees, above their target, of the cameras of an orbit, a dolly and the overview; cameras of an orbit.
ELEVATION, ORBIT = 15.0, 60

#: Axes that may point up in an input; the splats are rotated so that y does.
UP_AXES = ("y", "-y", "z", "-z")

#: Growth of the tree that the detail levels of a Streamed SOG are cut from: as it is not written, it keeps all nodes.
DETAIL_GROWTH = MAX_GROWTH
