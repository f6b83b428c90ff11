"""`LodSettings`: what a viewer draws of Level-of-Detail trees, and of scenes at several detail levels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ..model.foveation import SPARK, Foveation
from ..system.setting_fields import CheckedSettings, Range, setting
from .detail_rule import DetailRule

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

#: Number of chunks that Spark fetches concurrently.
FETCHERS = 3

#: Width of the blending range of continuous cuts, as a ratio of pixel scales.
BLEND = 1.25


#: Factors that the traversal multiplies in float32.
FACTOR = Range(0, 10**12)


@dataclass(frozen=True)
class LodSettings(CheckedSettings):
    """Settings of the cuts that a viewer draws.

    Attributes:
        budget: maximum number of splats, all instances together; by default that of Spark 2 on a desktop.
        foveation: weight of nodes by direction, for instances without their own foveation; by default Spark 2's.
        continuous: width of continuous cuts, the ratio of the pixel scales between which a node fades into its
            children, above 1 (see `continuous`); None for ordinary cuts.
        detail: how detail levels of Streamed SOG are chosen; all but this and the budget is of trees.
    """

    budget: int = PRESETS["desktop"]
    foveation: Foveation = SPARK
    pixel_scale_limit: float | None = setting(
        None,
        "Stop refining nodes of this size over distance, or smaller.  [default: that of a pixel, times"
        " --lod-render-scale]",
        FACTOR,
        excludes=("lod_render_scale",),
    )
    render_scale: float = setting(
        1.0, "Stop refining nodes smaller than this many pixels.", FACTOR, name="lod_render_scale"
    )
    continuous: float | None = None
    detail: DetailRule = field(default_factory=DetailRule)

    def limit(self, fov_y: float, height: int) -> float:
        """Pixel scale at or below which no node is refined; by vertical field of view (radians) and height (pixels)."""
        if self.pixel_scale_limit is not None:
            return self.pixel_scale_limit
        return pixel_limit(fov_y, height, self.render_scale)


def pixel_limit(fov_y: float, height: int, scale: float = 1.0) -> float:
    """Return the pixel scale of a pixel, Spark's `pixelScaleLimit`: 2 * tan(fov_y / 2) / height * scale.

    Args:
        fov_y: radians.
        height: pixels.
        scale: Spark's `lodRenderScale`.
    """
    return 2 * math.tan(fov_y / 2) / height * scale
