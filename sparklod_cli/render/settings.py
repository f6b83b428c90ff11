"""How splats become pixels, and how pictures are drawn; the defaults are Spark 2's. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..support.defaults import MAX_SH_DEGREE

#: Pixels squared that are added to the covariance on the screen, for which opacity makes up: Spark's `blurAmount`.
BLUR = 0.3

#: No splat is drawn farther from its centre, in pixels of the final picture: Spark's `maxPixelRadius`.
MAX_PIXEL_RADIUS = 512.0

#: A splat is drawn only if its centre is within this multiple of the picture's half width and height: Spark's `clipXY`.
CLIP = 1.4

#: How opacity falls off from the centre of a splat that is more than opaque.
PROFILES = ("spark", "shifted")

#: What is drawn: splats; opaque points of a pixel; discs of one opacity, in the order of the file or from far to near.
STYLES = ("splats", "points", "billboards", "sorted-billboards")

#: Quantities that can replace the colours of splats; those in `OF_PIXELS` are per pixel, the others per splat.
COLOR_BY = ("level", "lod-opacity", "size", "chunk", "overdraw", "depth")
OF_PIXELS = ("overdraw", "depth")

#: How the backend osmesa sorts splats: by their depths, or by 16 bits of them, as antimatter15's viewer does.
SORTINGS = ("exact", "counting16")

#: What splats are sorted by: the distance from the camera, or along its axis.
SORTS = ("radial", "z")


@dataclass(frozen=True)
class RasterSettings:
    """How splats become pixels.

    Attributes:
        near, far: splats nearer or farther along the axis are not drawn, world units.
        profile: one of `PROFILES`; both are exp(-z^2 / 2) up to D = 1. Above, Spark's is
            1 - (1 - exp(-z^2 / 2)) ** exp((D^2 - 1) / e), and that of its LoD design exp(-D / 2 * (z - (D - 1))^2).
        sort: one of `SORTS`.
        max_radius: no splat is drawn farther from its centre, pixels.
    """

    near: float = 0.01
    far: float = 1000.0
    profile: str = PROFILES[0]
    sort: str = SORTS[0]
    max_radius: float = MAX_PIXEL_RADIUS


@dataclass(frozen=True)
class RenderSettings:
    """How pictures are drawn.

    Attributes:
        raster: how splats become pixels.
        style: one of `STYLES`.
        backend: a name in `backends.BACKENDS`.
        color_by: one of `COLOR_BY`; None for the colours of the splats.
        supersample: samples along each side of a pixel, which is their mean.
        max_sh: degrees of spherical harmonics above this are left out.
        options: of the backend.
    """

    raster: RasterSettings = field(default_factory=RasterSettings)
    style: str = "splats"
    backend: str = "numba"
    color_by: str | None = None
    supersample: int = 1
    max_sh: int = MAX_SH_DEGREE
    options: Mapping[str, Any] = field(default_factory=dict)
