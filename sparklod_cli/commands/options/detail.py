"""Options of `sparklod build-lod` for Streamed SOG: detail levels, regions, chunk files and the environment."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import click

from ...support import defaults
from ..command import option, with_options
from ..paths import InputPath
from .common import Command
from .types import Quantity, Real

if TYPE_CHECKING:
    from ...lod.detail_rule import DetailSettings

HEADING = "Streamed SOG"

#: Parameters of this heading.
OF_DETAIL = (
    *("levels", "chunk_splats", "region_extent", "region_min_splats"),
    *("environment", "environment_beyond"),
)


def _levels(text: str) -> tuple[float, ...] | None:
    from ...lod.detail_rule import parse_levels

    return parse_levels(text)


def _count(text: str) -> int:
    from ...support.units import parse_count

    count = parse_count(text)
    if count < 1:
        raise ValueError(f"{text!r} is too few; give 1 or more")
    return count


def detail_options(command: Command) -> Command:
    """The options that `detail_of` reads."""
    add = functools.partial(option, heading=HEADING)
    return with_options(
        command,
        add(
            "--levels",
            type=Quantity("SHARES|auto", _levels),
            default="auto",
            help="Splats of each detail level after full detail, as shares of it in descending order, such as"
            " 50%,25%,12%,6%; auto suits the scene.",
        ),
        add(
            "--chunk-splats",
            type=Quantity("N", _count),
            default=defaults.DETAIL_CHUNK_SPLATS,
            help="Splats, about, after which a chunk file is closed.",
        ),
        add(
            "--region-extent",
            metavar="X",
            type=Real(0, min_open=True),
            default=defaults.DETAIL_EXTENT,
            help="Longest side of a region, in world units of the output; regions that are longer are divided.",
        ),
        add(
            "--region-min-splats",
            type=Quantity("N", _count),
            default=defaults.DETAIL_MIN_SPLATS,
            help="Splats below which a region is not divided, however long it is.",
        ),
        add(
            "--environment",
            metavar="FILE",
            type=InputPath(),
            help="Splats that are always drawn, such as a sky, from a file of any format without a tree; turned and"
            " moved as the scene.",
        ),
        add(
            "--environment-beyond",
            metavar="RADIUS",
            type=Real(0, min_open=True),
            help="Make splats whose centre is farther than this from the median of all centres the environment, in the"
            " input's units.",
        ),
    )


def detail_of(ctx: click.Context) -> DetailSettings:
    """How levels and regions are made."""
    from ...lod.detail_rule import DetailSettings

    asked = ctx.params
    return DetailSettings(asked["levels"], asked["chunk_splats"], asked["region_extent"], asked["region_min_splats"])
