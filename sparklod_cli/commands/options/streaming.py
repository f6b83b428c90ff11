"""How the chunks of files get to a viewer and stay with it."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from ...lod import detail_rule
from ...support import defaults
from ...support.units import parse_bandwidth, parse_time
from ..command import option, with_options
from ..usage import require
from .common import Command
from .types import Quantity

if TYPE_CHECKING:
    from ...simulation.streaming import StreamingSettings

HEADING = "Streaming"

#: Options that need --bandwidth.
OF_BANDWIDTH = ("latency", "fetchers")

#: The options of `streaming_options` with `pictures`, for files with levels alone.
OF_LOADING = ("after", "bandwidth", "latency", "fetchers", "chunk_cache")


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
        network = Network(self.bandwidth, self.latency or 0.0, self.fetchers)
        return StreamingSettings(network, self.chunk_cache)


@dataclass(frozen=True)
class PictureStreaming(Streaming):
    """The values of the options of `streaming_options` with `pictures`.

    Attributes:
        after: seconds since the page was opened; None draws what is there when everything has arrived.
    """

    after: float | None

    def check(self, ctx: click.Context) -> None:
        super().check(ctx)
        if self.after is None:
            require(ctx, OF_LOADING, "--after")
        elif self.bandwidth is None:
            raise click.UsageError("--after can only be used with --bandwidth")

    def loading(self) -> tuple[StreamingSettings, float] | None:
        """How chunks get to a viewer, and the seconds that it has had for them; None where all are there."""
        return None if self.after is None else (self.settings(), self.after)


def streaming_options(command: Command, *, pictures: bool = False) -> Command:
    """The options of `Streaming`.

    Args:
        command: that gets them.
        pictures: those of `PictureStreaming`.
    """
    add = functools.partial(option, heading=HEADING)
    after = add(
        "--after",
        type=Quantity("TIME", parse_time),
        help="Draw what a visitor sees this long after opening a page with the files, such as 500ms, who waits in front"
        " of the camera; with --bandwidth.  [default: what is drawn once every chunk has arrived]",
    )
    return with_options(
        command,
        *((after,) if pictures else ()),
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
            + ("" if pictures else "  [default: every chunk is resident]"),
        ),
        add(
            "--latency",
            type=Quantity("TIME", parse_time),
            help="Time from a request to the first byte, such as 60ms.  [default: 0ms]",
        ),
        add(
            "--fetchers",
            metavar="N",
            type=click.IntRange(1, 1000),
            help="Number of chunks that are fetched at a time."
            f"  [default: {defaults.FETCHERS}; {detail_rule.FETCHERS} of Streamed SOG]",
        ),
    )
