"""Ranges and defaults that the command line names and the library checks; imports nothing, so `--help` stays quick."""

#: Growth of the voxel grid from level to level.
MIN_BASE, MAX_BASE, DEFAULT_BASE = 1.1, 2.0, 1.5

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

#: What files of plain splats can be written as, by suffix.
PLAIN_SUFFIXES = (".spz", ".ply", ".splat")

#: In-memory layouts of viewers that a tree can be dumped in.
ENCODINGS = ("packed", "ext", "lodtree", "texture")

#: What colours can mean in a picture of `inspect`.
PLOT_BY = ("level", "opacity", "size", "chunk")
