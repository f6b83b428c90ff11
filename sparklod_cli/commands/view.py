"""`sparklod view`: a page that shows splat files in Spark, PlayCanvas or CesiumJS."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ..lod.budget import doubt
from ..system.setting_fields import Quantity, Range, setting, whole
from ..system.units import format_size, parse_count
from ..system.untrusted import printable
from .command import COMMON, DIRECTION, VIEW, Command, common, flag, values_of
from .console import Console, count_of, print_json
from .option_groups import DEFAULT_UP, JSON, OVERWRITE, QUIET, UP, VERBOSE, General
from .outputs import NamedPath, keep_apart

if TYPE_CHECKING:
    from ..api.sites import Server, Site

EXAMPLES = """\
  sparklod view scene-lod.rad
  sparklod view web/lod-meta.json                    # in PlayCanvas
  sparklod view city/tileset.json --spark-dir ~/spark      # in CesiumJS
  sparklod view scene-lod.spz --look-at 0,-1,4:0,0,0 --budget 500k
  sparklod view quick-lod.spz quality-lod.spz        # a box for each
  sparklod view scene-lod.rad --camera-path path.json
  npm install --prefix ~/spark @sparkjsdev/spark@2.2.0 three@0.187.0
  sparklod view scene-lod.rad --spark-dir ~/spark    # without a network
  sparklod view scene-lod.rad --export site          # for any web server
"""


@dataclass(frozen=True)
class _Page:
    """Options of the page: its first view and its source files."""

    HEADING: ClassVar[str] = "Page"

    look_at: Any = common(
        "Place the camera at EYE, looking at TARGET, each x,y,z.  [default: it sees the whole scene]", VIEW
    )
    camera_path: Path | None = common("Play the cameras of a file, or of a folder written by COLMAP.", NamedPath())
    spark_dir: Path | None = common(
        "Folder whose node_modules have the viewer and three.js.  [default: a CDN, but not for CesiumJS]",
        NamedPath(),
        metavar="DIR",
    )
    budget: int | None = setting(
        "Most splats of trees that are drawn, such as 500k.  [default: as Spark chooses for the device]",
        Quantity("N", parse_count, whole(1)),
    )
    up: tuple[float, float, float] | None = common(f"{UP}{DEFAULT_UP}]", DIRECTION)
    fov: float | None = setting(
        "Vertical field of view, in degrees.  [default: 60]", Range(above=0, below=180, unit="DEGREES")
    )


@dataclass(frozen=True)
class _Place:
    """Options of the server, or of the folder that the page is written to."""

    HEADING: ClassVar[str] = "Server"

    export: Path | None = common(
        "Write the page and the files into a folder, for any web server.", NamedPath(output=True, folder=True)
    )
    overwrite: bool = flag(**OVERWRITE)
    port: int = setting("Port to listen on.", whole(0, 65_535), 0, show_default="any that is free")
    host: str = setting(
        "Address to listen on; 0.0.0.0 lets everybody on the network read the files.",
        default="127.0.0.1",
        metavar="NAME",
        show_default="127.0.0.1, for this machine alone",
    )
    cors: bool = flag("Let pages of other origins read the files.")
    no_open: bool = flag("Open no browser.")


@dataclass(frozen=True)
class _ViewGeneral(General):
    quiet: bool = flag("Print nothing but the address, and errors.", **QUIET)
    verbose: bool = flag("Print each request.", **VERBOSE)


@dataclass(frozen=True)
class _ViewOptions:
    """Options of the command, group by group."""

    files: tuple[Path, ...] = setting("", NamedPath(), (), argument=True, nargs=-1, metavar="FILE...", required=True)
    page: _Page = field(default_factory=_Page)
    place: _Place = field(default_factory=_Place)
    as_json: bool = flag("Print the address and the files as one JSON object on standard output.", **JSON)
    general: _ViewGeneral = field(default_factory=_ViewGeneral)


HEADINGS = (COMMON, "Page", "Server")


@click.command("view", cls=Command, options=_ViewOptions, examples=EXAMPLES, headings=HEADINGS)
@click.pass_context
def view(ctx: click.Context, /, **_: Any) -> None:
    """Show splat files in Spark, PlayCanvas or CesiumJS, in a browser.

    Serves a page and the files that it shows, prints its address and opens it in a browser, until Ctrl-C ends it. The
    page has a slider for the budget, colours by level, and what is drawn and how fast; it copies the camera as
    --look-at, and plays camera paths that are dropped onto it.

    Trees in RAD files are streamed, chunk by chunk, as a viewer on the web streams them. Streamed SOG and GLB are shown
    in PlayCanvas, 3D Tiles in CesiumJS, everything else in Spark. Spark, PlayCanvas and three.js come from a CDN unless
    --spark-dir names a folder that has them; CesiumJS needs one.
    """
    options = values_of(ctx, _ViewOptions)
    files, page, place, general = options.files, options.page, options.place, options.general
    keep_apart(ctx)
    with Console(quiet=general.quiet, verbose=general.verbose) as console:
        from ..api import sites

        if place.export is not None:
            sites.check_folder(place.export, overwrite=place.overwrite)
        site = sites.prepare(
            files, served=place.export is None, threads=general.threads, progress=console.progress, **vars(page)
        )
        console.clear()
        if question := doubt(page.budget, shares=False):
            console.say(question)
        for note in site.notes:
            console.say(note)
        if place.export is not None:
            size = sites.export(site, place.export, overwrite=place.overwrite, progress=console.progress)
            console.clear()
            count = count_of(len(site.resources), "file")
            console.say(f"wrote {printable(str(place.export))}: {count}, {format_size(size)}")
            if options.as_json:
                print_json({"folder": str(place.export), "bytes": size, "files": _files(site)})
        else:
            server = sites.Server(site, host=place.host, port=place.port, cors=place.cors, log=console.detail)
            _serve(console, server, opens=not place.no_open, as_json=options.as_json)


def _serve(console: Console, server: Server, *, opens: bool, as_json: bool) -> None:
    with server, contextlib.suppress(KeyboardInterrupt):
        if as_json:
            print_json({"url": server.url, "files": _files(server.site)})
        else:
            click.echo(server.url)
        sys.stdout.flush()
        names = ", ".join(printable(file.name) for file in server.site.shown)
        everybody = "" if server.loopback else "; everybody who can reach this machine can read them"
        console.say(f"serving {names}{everybody}; Ctrl-C ends it")
        if opens:
            threading.Thread(target=_open, args=(console, server.url), daemon=True).start()
        server.serve_forever()
    console.say("stopped")


def _open(console: Console, url: str) -> None:
    import webbrowser

    # Without a display, Python would start a browser for terminals, in ours.
    has_display = sys.platform in ("win32", "darwin") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    )
    if not has_display or not webbrowser.open(url):
        console.say(f"Could not open a browser; open this address yourself: {url}")


def _files(site: Site) -> list[dict[str, Any]]:
    return [
        {"file": str(file.path), "url": file.url, "format": file.format, "bytes": file.bytes} for file in site.shown
    ]
