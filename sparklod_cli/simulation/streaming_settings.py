"""`Network` and `StreamingSettings`: how chunks get to a viewer and stay with it. Imports nothing heavy."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

from ..lod.settings import CESIUM_FETCHERS, FETCHERS, PLAYCANVAS_FETCHERS
from ..system.setting_fields import CheckedSettings, Quantity, Range, setting, whole
from ..system.units import parse_bandwidth, parse_time


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
        needs="bandwidth",
    )
    fetchers: int | None = setting(
        f"Number of chunks that are fetched at a time.  [default: {FETCHERS}; {PLAYCANVAS_FETCHERS} of Streamed SOG,"
        f" {CESIUM_FETCHERS} of 3D Tiles]",
        whole(1, 1000),
        needs="bandwidth",
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
