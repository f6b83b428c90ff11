"""The options of `view`: what the page shows at first, and where it is served or written."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from ...support.units import parse_count
from ..command import COMMON, option, with_options
from ..paths import InputPath, OutputPath
from ..usage import exclude, require
from .common import Command, overwrite_option
from .types import Direction, Quantity, Real
from .views import View

PAGE, SERVER = "Page", "Server"

#: Options that have no effect where a site is written.
OF_SERVER = ("host", "port", "cors", "no_open")


@dataclass(frozen=True)
class Page:
    """What the page shows at first, and what it is made of; None for what is not given.

    Attributes:
        look_at: eye and target of the camera.
        fov: its vertical field of view, degrees.
        up: x, y and z.
        budget: splats.
        camera_path: file of cameras that the page plays.
        spark_dir: folder whose node_modules has Spark, or PlayCanvas, and three.js.
    """

    look_at: Any
    fov: float | None
    up: tuple[float, float, float] | None
    budget: int | None
    camera_path: Path | None
    spark_dir: Path | None


@dataclass(frozen=True)
class Place:
    """Where the page is served, or written.

    Attributes:
        host, port: to listen on; 0 for any port that is free.
        cors: pages of other origins may read the files.
        no_open: open no browser.
        export: folder that gets the site in place of a server; None for none.
        overwrite: replace a site that is there.
    """

    host: str
    port: int
    cors: bool
    no_open: bool
    export: Path | None
    overwrite: bool

    def check(self, ctx: click.Context) -> None:
        """Raises a `click.UsageError` where options have nothing to do."""
        if self.export is not None:
            exclude(ctx, OF_SERVER, "--export")
        else:
            require(ctx, ["overwrite"], "--export")


def _budget(text: str) -> int:
    count = parse_count(text)
    if count < 1:
        raise ValueError(f"a budget of {text} leaves nothing to draw; give 1 or more")
    return count


def view_options(command: Command) -> Command:
    """The options of `Page` and `Place`."""
    common = functools.partial(option, heading=COMMON)
    page, server = functools.partial(option, heading=PAGE), functools.partial(option, heading=SERVER)
    return with_options(
        command,
        common(
            "--look-at",
            type=View(),
            help="Place the camera at EYE, looking at TARGET, each x,y,z.  [default: it sees the whole scene]",
        ),
        common(
            "--camera-path",
            metavar="FILE",
            type=InputPath(),
            help="Play the cameras of a file, or of a folder written by COLMAP.",
        ),
        common(
            "--spark-dir",
            metavar="DIR",
            type=InputPath(),
            help="Take Spark, or PlayCanvas, and three.js from the node_modules of a folder.  [default: from a CDN]",
        ),
        common(
            "--export",
            metavar="DIR",
            type=OutputPath(folder=True),
            help="Write the page and the files into a folder, for any web server, in place of serving them.",
        ),
        overwrite_option,
        page(
            "--budget",
            type=Quantity("N", _budget),
            help="Most splats of trees that are drawn, such as 500k.  [default: as Spark chooses for the device]",
        ),
        page(
            "--up",
            type=Direction(),
            help="Direction that is up, as an axis such as -y or as x,y,z.  [default: the axis that the files note,"
            " or -y, as training leaves scenes]",
        ),
        page(
            "--fov",
            metavar="DEGREES",
            type=Real(0, 180, min_open=True, max_open=True),
            help="Vertical field of view, in degrees.  [default: 60]",
        ),
        server(
            "--port",
            metavar="N",
            type=click.IntRange(0, 65_535),
            default=0,
            show_default="any that is free",
            help="Port to listen on.",
        ),
        server(
            "--host",
            metavar="NAME",
            default="127.0.0.1",
            show_default="127.0.0.1, for this machine alone",
            help="Address to listen on; 0.0.0.0 lets everybody on the network read the files.",
        ),
        server("--cors", is_flag=True, help="Let pages of other origins read the files."),
        server("--no-open", is_flag=True, help="Open no browser."),
    )
