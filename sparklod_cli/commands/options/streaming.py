"""How the chunks of files get to a viewer and stay with it."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from ...support import defaults
from ...support.units import parse_bandwidth, parse_latency
from ..command import option, with_options
from ..usage import require
from .common import Command
from .types import Quantity

if TYPE_CHECKING:
    from ...simulation.streaming import StreamingSettings

HEADING = "Streaming"

#: Options that need --bandwidth.
OF_BANDWIDTH = ("latency", "fetchers")


@dataclass(frozen=True)
class Streaming:
    """The values of the options of `streaming_options`; None for those not given.

    Attributes:
        chunk_cache: chunks that fit into memory.
        bandwidth: bytes per second.
        latency: seconds.
        fetchers: chunks that are fetched at a time.
    """

    chunk_cache: int | None
    bandwidth: float | None
    latency: float | None
    fetchers: int | None

    def check(self, ctx: click.Context) -> None:
        """Raises a `click.UsageError` where an option has nothing to do."""
        if self.bandwidth is None:
            require(ctx, OF_BANDWIDTH, "--bandwidth")

    def settings(self) -> StreamingSettings:
        """How chunks get to a viewer and stay with it."""
        from ...simulation.streaming import Network, StreamingSettings

        if self.bandwidth is None:
            return StreamingSettings(chunk_cache=self.chunk_cache)
        network = Network(self.bandwidth, self.latency or 0.0, self.fetchers or defaults.FETCHERS)
        return StreamingSettings(network, self.chunk_cache)


def streaming_options(command: Command) -> Command:
    """The options of `Streaming`."""
    add = functools.partial(option, heading=HEADING)
    return with_options(
        command,
        add(
            "--chunk-cache",
            metavar="N",
            type=click.IntRange(1),
            help="Number of chunks, of 65,536 nodes each, that fit into memory.  [default: all]",
        ),
        add(
            "--bandwidth",
            type=Quantity("RATE", parse_bandwidth),
            help="Simulate streaming over a network of this bandwidth, such as 20Mbit."
            "  [default: every chunk is resident]",
        ),
        add(
            "--latency",
            type=Quantity("TIME", parse_latency),
            help="Time from a request to the first byte, such as 60ms.  [default: 0ms]",
        ),
        add(
            "--fetchers",
            metavar="N",
            type=click.IntRange(1, 1000),
            help=f"Number of chunks that are fetched at a time.  [default: {defaults.FETCHERS}]",
        ),
    )
