"""Settings of viewers: of cuts, of detail levels, and of the network and cache. Imports nothing heavy."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

from ..model.foveation import SPARK, Foveation
from ..system.setting_fields import CheckedSettings, Quantity, Range, setting, whole
from ..system.units import parse_bandwidth, parse_time

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

#: Uses of a budget: spend all of it, or only limit the levels that follow from distances.
BUDGET_MODES = ("target", "limit")

#: PlayCanvas's default budget of splats, and number of chunk files that it fetches concurrently.
PLAYCANVAS_BUDGET, PLAYCANVAS_FETCHERS = 1_000_000, 2

#: Concurrent requests of browsers to a host over HTTP/1.1; a chunk file takes seven or eight requests.
CONNECTIONS = 6

#: The shortest base distance, world units.
LEAST_BASE_DISTANCE = 0.1

#: Concurrent requests of CesiumJS to one server.
CESIUM_FETCHERS = 18


@dataclass(frozen=True)
class DetailRule(CheckedSettings):
    """Rule by which a viewer chooses detail levels, with the defaults and bounds of PlayCanvas 2.23.

    Its names there are `splatBudgetMode`, `lodBaseDistance` (seen by a camera with a field of view of 45 degrees),
    `lodMultiplier`, `lodBehindPenalty`, `lodDistanceShrink`, `lodRangeMin`, `lodRangeMax` and `lodUnderfillLimit`.

    Attributes:
        shrink: 0..1, share of the excess of a region's bound over the median size by which the bound shrinks when
            its distance is measured.
        finest, coarsest: the levels that may be chosen.

    Raises:
        ValueError: a number is out of its range.
    """

    HEADING: ClassVar[str] = "Streamed SOG"

    mode: str = setting(
        "Spend the whole budget, or take the levels that distances ask for, and coarser ones only where those exceed"
        " it.",
        BUDGET_MODES,
        BUDGET_MODES[0],
        name="budget_mode",
    )
    base_distance: float = setting(
        "Distance at which level 1 replaces full detail, in world units; with --budget-mode limit.",
        Range(LEAST_BASE_DISTANCE),
        5.0,
        name="lod_base_distance",
    )
    multiplier: float = setting(
        "Ratio of the distances at which successive levels begin.", Range(1.2), 3.0, name="lod_multiplier"
    )
    behind_penalty: float = setting(
        "Factor of the distance of regions straight behind the camera.", Range(1), 1.5, name="lod_behind_penalty"
    )
    shrink: float = 0.75
    finest: int = 0
    coarsest: int = 99
    underfill: int = setting(
        "With --bandwidth: while the file of a level loads, draw one that is up to this many levels coarser.",
        whole(0, 100),
        0,
        name="lod_underfill",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        Range(0, 1).check("shrink", self.shrink)
        if not 0 <= self.finest <= self.coarsest:
            raise ValueError(f"levels {self.finest} to {self.coarsest} are no range; give 0 <= finest <= coarsest")


@dataclass(frozen=True)
class LodSettings(CheckedSettings):
    """Settings of the cuts that a viewer draws.

    Attributes:
        budget: maximum number of splats, all instances together; by default that of Spark 2 on a desktop.
        foveation: weight of nodes by direction, for instances without their own foveation; by default Spark 2's.
        continuous: width of continuous cuts, the ratio of the pixel scales between which a node fades into its
            children, above 1 (see `viewers.continuous`); None for ordinary cuts.
        detail: choice of the detail levels of Streamed SOG; other fields but the budget are for trees only.
    """

    budget: int = PRESETS["desktop"]
    foveation: Foveation = SPARK
    pixel_scale_limit: float | None = setting(
        "Stop refining nodes of this size over distance, or smaller.  [default: that of a pixel, times"
        " --lod-render-scale]",
        FACTOR,
    )
    render_scale: float = setting(
        "Stop refining nodes smaller than this many pixels.", FACTOR, 1.0, name="lod_render_scale"
    )
    continuous: float | None = None
    detail: DetailRule = field(default_factory=DetailRule)

    def limit(self, fov_y: float, height: int) -> float:
        """Return the pixel scale at or below which no node is refined, for a `fov_y` in radians, a height in pixels."""
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


@dataclass(frozen=True)
class Network(CheckedSettings):
    """The network between a viewer and the files, whose transfers share the bandwidth (bytes/s) equally.

    The default delivers everything at once. The latency (seconds) uses no bandwidth.

    Raises:
        ValueError: a value is out of range.
    """

    bandwidth: float = setting(
        "Simulate streaming over a network of this bandwidth, such as 20Mbit.  [default: every chunk is resident]",
        Quantity("RATE", parse_bandwidth, Range(above=0)),
        math.inf,
    )
    latency: float = setting(
        "Time from a request to the first byte, such as 60ms.  [default: 0ms]",
        Quantity("TIME", parse_time, Range(0, below=math.inf)),
        0.0,
    )
    fetchers: int | None = setting(
        f"Number of chunks that are fetched at a time.  [default: {FETCHERS}; {PLAYCANVAS_FETCHERS} of Streamed SOG,"
        f" {CESIUM_FETCHERS} of 3D Tiles]",
        whole(1, 1000),
    )

    @property
    def instant(self) -> bool:
        return self.bandwidth == math.inf and self.latency == 0


@dataclass(frozen=True)
class StreamingSettings(CheckedSettings):
    """Network and cache of a viewer; by default everything arrives at once, and all chunks fit into memory."""

    HEADING: ClassVar[str] = "Streaming"

    network: Network = field(default_factory=Network)
    chunk_cache: int | None = setting(
        "Number of chunks, of 65,536 nodes each, that fit into memory.  [default: all]", whole(1)
    )
