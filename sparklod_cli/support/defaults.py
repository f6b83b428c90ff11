"""Ranges and defaults that the command line names and the library checks; imports nothing, so `--help` stays quick."""

#: Base of the quick builder: growth of its voxel grid from one level to the next.
MIN_BASE, MAX_BASE, DEFAULT_BASE = 1.1, 2.0, 1.5

#: Growth of the quality builder: largest number of nodes per leaf. 2 would keep every node of its binary tree.
MIN_GROWTH, MAX_GROWTH, DEFAULT_GROWTH = 1.05, 2.0, 1.4

#: Highest degree of spherical harmonics that is read and written.
MAX_SH_DEGREE = 3

#: Most threads that can be asked for.
MAX_THREADS = 256

#: SPZ versions that can be written, and the default; docs/decisions has the measurement.
SPZ_VERSIONS, DEFAULT_SPZ_VERSION = (2, 3), 3

#: Most fractional bits of an SPZ position, all of its 24.
MAX_FRACTIONAL_BITS = 24

#: Deflate levels of SPZ files, and the default; docs/decisions has the measurement.
MIN_COMPRESSION, MAX_COMPRESSION, DEFAULT_COMPRESSION = 1, 9, 5

#: Quantities that colours can show in a picture of `inspect`; "level" is the depth of a node.
PLOT_BY = ("level", "opacity", "size", "chunk")

#: Shapes that `render` draws splats as, and quantities that colours can show instead of the splats' own.
STYLES = ("splats", "points", "billboards", "sorted-billboards")
COLOR_BY = ("level", "lod-opacity", "size", "chunk", "overdraw", "depth")

#: The quantities among these that are computed for pixels instead of splats.
OF_PIXELS = ("overdraw", "depth")

#: Most samples along each side of a pixel.
MAX_SUPERSAMPLE = 4

#: Budgets, in splats, of viewers: Spark 2's defaults by device, then those of its LoD design.
PRESETS = {
    "desktop": 2_500_000,
    "ios": 1_500_000,
    "android": 1_000_000,
    "vision-pro": 750_000,
    "quest": 500_000,
    "preview-desktop": 1_500_000,
    "mobile": 500_000,
}

#: Precision of the centres and sizes of nodes: that of the file, or that of Spark's traversal.
PRECISIONS = ("float32", "float16")

#: Spark 2's foveation: full angles of the inner and the outer cone in degrees, and weights at the outer cone and behind
#: the camera.
CONE_FOV0, CONE_FOV, CONE_FOVEATE, BEHIND_FOVEATE = 90.0, 120.0, 0.4, 0.2

#: Chunks that Spark fetches at the same time.
FETCHERS = 3

#: Ratio of the pixel scales between which continuous cuts blend a node with its children.
BLEND = 1.25

#: Ways in which the backend osmesa can sort splats.
SORTINGS = ("exact", "counting16")

#: Largest distance of a far plane, world units: a float32 holds it with room for products.
FARTHEST = 1e37

#: Axes of a file that can point up, for splats that are turned to have y up.
UP_AXES = ("y", "-y", "z", "-z")
