"""Defaults of pictures. Imports nothing, so that `--help` stays fast."""

#: Quality of JPEG, 1 to 100: what is lost is hardly seen.
JPEG_QUALITY = 92

#: Width and height of a thumbnail, pixels, and the pixels along each side that each of them is the mean of.
THUMBNAIL_SIZE, THUMBNAIL_SUPERSAMPLE = (512, 512), 2
