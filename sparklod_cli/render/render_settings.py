"""Settings of rasterization and rendering, defaults as in Spark 2; backends and devices. Imports nothing heavy."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ..model import FARTHEST, MAX_SH_DEGREE
from ..system.errors import BackendError
from ..system.setting_fields import CheckedSettings, Range, setting, whole
from . import DEVICE_HELP, DEVICES

#: Largest supersampling factor: samples per pixel along each axis.
MAX_SUPERSAMPLE = 4

#: Backends; numba is the default, and draws on the processor or on a card.
BACKENDS = ("numba", "osmesa", "open3d")


def uses_card(device: str, say: Callable[[str], None] = lambda text: None) -> bool:
    """Return True if a card is used for one of `DEVICES`; say so, or why not, in a line.

    "auto" does without a word where the extra is not installed.

    Raises:
        BackendError: a card is requested, and none is usable.
    """
    if device == "cpu" or (device == "auto" and importlib.util.find_spec("numba_cuda") is None):
        return False
    from .cuda.card import find_card  # loads numba

    try:
        card = find_card()
    except BackendError as error:
        if device == "cuda":
            raise
        say(f"uses the processor: {error}")
        return False
    slowly = "; sorts on the processor, which is slow, as cupy is not installed" if card.sorter == "numpy" else ""
    say(f"uses the card {card}{slowly}")
    return True


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

#: Distances of the near and the far plane, world units.
DISTANCE = Range(above=0, most=FARTHEST, unit="D")


@dataclass(frozen=True)
class RasterSettings(CheckedSettings):
    """Settings of rasterization.

    Both profiles are exp(-z^2 / 2) up to D = 1. Above, Spark's is 1 - (1 - exp(-z^2 / 2)) ** exp((D^2 - 1) / e), and
    that of its LoD design exp(-D / 2 * (z - (D - 1))^2).

    Attributes:
        max_radius: no splat is drawn farther from its centre, pixels.
    """

    near: float = setting(
        "Distance of the near plane along the optical axis, in world units; nearer splats are left out."
        "  [default: 0.01, or less where the camera is chosen for the scene]",
        DISTANCE,
        0.01,
    )
    far: float = setting(
        "Distance of the far plane along the optical axis, in world units; farther splats are left out."
        "  [default: 1000, or more where the camera is chosen for the scene]",
        DISTANCE,
        1000.0,
    )
    profile: str = setting(
        "Falloff of splats with a LoD opacity above 1: as Spark 2 draws it (spark), or as its LoD design describes it"
        " (shifted).",
        PROFILES,
        PROFILES[0],
    )
    sort: str = setting(
        "Order of the splats: by distance from the camera (radial), or along its axis (z).", SORTS, SORTS[0]
    )
    max_radius: float = MAX_PIXEL_RADIUS


@dataclass(frozen=True)
class RenderSettings(CheckedSettings):
    """Settings of rendering.

    Attributes:
        raster: how splats become pixels.
        max_sh: degrees of spherical harmonics above this are left out.
        options: of the backend.
    """

    raster: RasterSettings = field(default_factory=RasterSettings)
    style: str = setting(
        "Shape of each splat: its Gaussian, one opaque pixel (points), or an opaque disc, in the order of the file"
        " (billboards) or from far to near (sorted-billboards).",
        STYLES,
        STYLES[0],
    )
    backend: str = setting(
        "Renderer: numba is the reference, osmesa is OpenGL in software, open3d is a quick look.", BACKENDS, BACKENDS[0]
    )
    device: str = setting(DEVICE_HELP.format("the backend numba"), DEVICES, "cpu")
    color_by: str | None = setting(
        "Colour splats by a quantity, unlit, with a colour bar beside the picture.  [default: their own colours]",
        COLOR_BY,
    )
    supersample: int = setting(
        "Draw each pixel as the mean of N x N samples, up to 4 x 4.", whole(1, MAX_SUPERSAMPLE), 1
    )
    max_sh: int = MAX_SH_DEGREE
    options: Mapping[str, Any] = field(default_factory=dict)
