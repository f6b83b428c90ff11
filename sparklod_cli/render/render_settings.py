"""Settings of rasterization and rendering, with Spark 2's defaults; backends and devices. Imports nothing heavy."""

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

#: Backends; numba draws on the processor or on a card.
BACKENDS = ("numba", "osmesa", "open3d")


def uses_card(device: str, say: Callable[[str], None] = lambda text: None) -> bool:
    """Return whether one of `DEVICES` means a card here, and report the choice with `say`.

    `BackendError` for "cuda" without a usable card. "auto" without the extra reports nothing.
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


#: Pixels squared added to the covariance on the screen, compensated by opacity: Spark's `blurAmount`.
BLUR = 0.3

#: Largest radius of a splat, in pixels of the final picture: Spark's `maxPixelRadius`.
MAX_PIXEL_RADIUS = 512.0

#: Largest distance of a drawn centre from the middle, in halves of the picture's sides: Spark's `clipXY`.
CLIP = 1.4

#: Falloffs of opacity from the centre of a merged splat.
PROFILES = ("spark", "shifted")

#: Shapes of a splat: its Gaussian; an opaque pixel; a disc, in the order of the file or from far to near.
STYLES = ("splats", "points", "billboards", "sorted-billboards")

#: Quantities that can replace the colours of splats, and those of them that are per pixel, not per splat.
COLOR_BY = ("level", "lod-opacity", "size", "chunk", "overdraw", "depth")
OF_PIXELS = ("overdraw", "depth")

#: Sortings of the backend osmesa: by depths, or by 16 bits of depths, as in antimatter15's viewer.
SORTINGS = ("exact", "counting16")

#: Orders of splats: by distance from the camera, or along its axis.
SORTS = ("radial", "z")

#: Distances of the near and the far plane, world units.
DISTANCE = Range(above=0, most=FARTHEST, unit="D")


@dataclass(frozen=True)
class RasterSettings(CheckedSettings):
    """Settings of rasterization.

    Both profiles are exp(-z^2 / 2) up to D = 1. Above, Spark's is 1 - (1 - exp(-z^2 / 2)) ** exp((D^2 - 1) / e), and
    that of its LoD design exp(-D / 2 * (z - (D - 1))^2). `max_radius` is the largest radius of a splat, pixels.
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
        max_sh: highest degree of spherical harmonics that is drawn.
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
