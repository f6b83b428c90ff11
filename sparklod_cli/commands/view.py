"""`sparklod view`: a page that shows splat files in Spark."""

from __future__ import annotations

import functools
import json
import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..support.printable import printable
from ..support.units import parse_count
from .command import COMMON, Command, option, with_options
from .console import Console, count_of, size_of
from .options.common import General, common_options, overwrite_option
from .options.types import Direction, Quantity, Real
from .options.views import View
from .paths import InputPath, OutputPath, keep_apart
from .usage import exclude, options_of, require

if TYPE_CHECKING:
    from ..api.viewing import Prepared, Server

EXAMPLES = """
\b
Examples:
  sparklod view scene-lod.rad
  sparklod view scene-lod.spz --look-at 0,-1,4:0,0,0 --budget 500k
  sparklod view quick-lod.spz quality-lod.spz             # both, with a box for each
  sparklod view scene-lod.rad --camera-path path.json
  npm install --prefix ~/spark @sparkjsdev/spark@2.2.0 three@0.187.0
  sparklod view scene-lod.rad --spark-dir ~/spark         # without a network
  sparklod view scene-lod.rad --export site               # for any web server
"""

SERVED, SHOWN = "Server", "Page"

#: Options that have no effect where a site is written.
OF_SERVER = ("host", "port", "cors", "no_open")


@dataclass(frozen=True)
class Page:
    """What the page shows at first; None for what is not given."""

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


def _budget(text: str) -> int:
    count = parse_count(text)
    if count < 1:
        raise ValueError(f"a budget of {text} leaves nothing to draw; give 1 or more")
    return count


def _options(command: Any) -> Any:
    served, shown = functools.partial(option, heading=SERVED), functools.partial(option, heading=SHOWN)
    return with_options(
        command,
        option("--look-at", heading=COMMON, type=View(), help="Place the camera at EYE, looking at TARGET, each x,y,z."
               "  [default: the whole scene]"),
        option("--camera-path", heading=COMMON, metavar="FILE", type=InputPath(),
               help="Play the cameras of a file, or of a folder written by COLMAP."),
        option("--spark-dir", heading=COMMON, metavar="DIR", type=InputPath(),
               help="Take Spark and three.js from the node_modules of a folder.  [default: from a CDN, by the network]"),
        option("--export", heading=COMMON, metavar="DIR", type=OutputPath(folder=True),
               help="Write the page and the files into a folder that any web server can serve, in place of serving them."),
        overwrite_option,
        shown("--budget", type=Quantity("N", _budget), help="Most splats of trees that are drawn."
              "  [default: as many as Spark draws on the device]"),
        shown("--up", type=Direction(), help="Direction that is up, as an axis such as -y or as x,y,z."
              "  [default: -y, as training leaves scenes]"),
        shown("--fov", metavar="DEGREES", type=Real(0, 180, min_open=True, max_open=True),
              help="Vertical field of view, in degrees.  [default: 60]"),
        served("--port", metavar="N", type=click.IntRange(0, 65_535), default=0, show_default="any that is free",
               help="Port to listen on."),
        served("--host", metavar="NAME", default="127.0.0.1", show_default="127.0.0.1, for this machine alone",
               help="Address to listen on; 0.0.0.0 lets everybody on the network see the files."),
        served("--cors", is_flag=True, help="Let pages of other origins read the files."),
        served("--no-open", is_flag=True, help="Open no browser."),
    )  # fmt: skip


@click.command("view", cls=Command, headings=(COMMON, SHOWN, SERVED), epilog=EXAMPLES,
               context_settings={"show_default": True})  # fmt: skip
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=InputPath())
@_options
@functools.partial(
    common_options,
    json="Print the address and the files as one JSON object on standard output.",
    quiet="Print nothing but the address, and errors.",
)
@click.pass_context
def view(ctx: click.Context, /, files: tuple[Path, ...], **_: Any) -> None:
    """Show splat files in Spark, in a browser.

    Serves a page and the files that it shows, prints its address and opens it in a browser, until Ctrl-C ends it. The
    page has a slider for the budget, colours by level, and what Spark draws and how fast; it copies the camera as
    --look-at, and plays camera paths that are dropped onto it.

    Trees in RAD files are streamed, chunk by chunk, as a viewer on the web streams them. Spark and three.js come from a
    CDN unless --spark-dir names a folder that has them.
    """
    general, page, place = (options_of(ctx, kind) for kind in (General, Page, Place))
    keep_apart(ctx)
    if place.export is not None:
        exclude(ctx, OF_SERVER, "--export")
    else:
        require(ctx, ["overwrite"], "--export")
    with general.console() as console:
        from ..api import viewing

        if place.export is not None:
            viewing.check_folder(place.export, overwrite=place.overwrite)
        settings = viewing.ViewSettings(**vars(page))
        served = place.export is None
        prepared = viewing.prepare(
            files, settings, served=served, threads=general.threads, progress=console.progress
        )
        console.clear()
        for note in prepared.notes:
            console.say(note)
        if place.export is not None:
            size = viewing.export(prepared.site, place.export, overwrite=place.overwrite, progress=console.progress)
            console.clear()
            _report_export(console, place.export, prepared, size, as_json=general.as_json)
        else:
            server = viewing.Server(
                prepared.site, host=place.host, port=place.port, cors=place.cors, log=console.detail
            )
            _serve(console, server, prepared, opens=not place.no_open, as_json=general.as_json)


def _serve(console: Console, server: Server, prepared: Prepared, *, opens: bool, as_json: bool) -> None:
    """Serves until an interrupt, which is how a server ends."""
    with server:
        click.echo(json.dumps({"url": server.url, "files": _files(prepared)}) if as_json else server.url)
        sys.stdout.flush()
        names = ", ".join(printable(file.name) for file in prepared.shown)
        everybody = "" if server.loopback else "; everybody who can reach this machine can read them"
        console.say(f"serving {names}{everybody}; Ctrl-C ends it")
        if opens:
            threading.Thread(target=_open, args=(console, server.url), daemon=True).start()
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            console.say("stopped")


def _open(console: Console, url: str) -> None:
    """Opens a browser, or says that there is none."""
    import webbrowser

    # Without a display, Python would start a browser for terminals, in ours.
    has_display = sys.platform in ("win32", "darwin") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    )
    if not has_display or not webbrowser.open(url):
        console.say("no browser can be opened here; open the address above in one")


def _report_export(console: Console, folder: Path, prepared: Prepared, size: int, *, as_json: bool) -> None:
    console.say(f"wrote {printable(str(folder))}: {count_of(len(prepared.site.resources), 'file')}, {size_of(size)}")
    if as_json:
        click.echo(json.dumps({"folder": str(folder), "bytes": size, "files": _files(prepared)}))


def _files(prepared: Prepared) -> list[dict[str, Any]]:
    return [
        {"file": str(file.path), "url": file.url, "format": file.format, "bytes": file.bytes}
        for file in prepared.shown
    ]
