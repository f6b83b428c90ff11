"""Formats and defaults of pictures. Imports nothing, so that `--help` stays fast."""

#: Quantities by which `inspect` can colour a picture.
PLOT_BY = ("level", "opacity", "size", "chunk")


#: Formats of single pictures, of animations, and of contact sheets.
STILL = ("png", "jpg", "webp", "npy")
MOVING = ("webp", "gif", "mp4", "webm")
SHEETS = ("png", "jpg", "webp")

#: Formats by suffix, where the two differ.
SUFFIXES = {"jpeg": "jpg"}

#: Quality of JPEG, 1 to 100: losses are hardly visible.
JPEG_QUALITY = 92

#: Width and height of a thumbnail, pixels, and the pixels along each side that each of them is the mean of.
THUMBNAIL_SIZE, THUMBNAIL_SUPERSAMPLE = (512, 512), 2
