"""`sparklod view`: a page that shows splat files in Spark, or in PlayCanvas."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..support.printable import printable
from .command import COMMON, Command
from .console import Console, count_of, size_of
from .options.common import General, common_options
from .options.viewing import PAGE, SERVER, Page, Place, view_options
from .paths import InputPath, keep_apart
from .usage import options_of

if TYPE_CHECKING:
    from ..api.viewing import Prepared, Server

EXAMPLES = """
\b
Examples:
  sparklod view scene-lod.rad
  sparklod view web/lod-meta.json                         # in PlayCanvas
  sparklod view scene-lod.spz --look-at 0,-1,4:0,0,0 --budget 500k
  sparklod view quick-lod.spz quality-lod.spz             # both, with a box for each
  sparklod view scene-lod.rad --camera-path path.json
  npm install --prefix ~/spark @sparkjsdev/spark@2.2.0 three@0.187.0
  sparklod view scene-lod.rad --spark-dir ~/spark         # without a network
  sparklod view scene-lod.rad --export site               # for any web server
"""


@click.command(
    "view", cls=Command, headings=(COMMON, PAGE, SERVER), epilog=EXAMPLES, context_settings={"show_default": True}
)
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=InputPath())
@view_options
@functools.partial(
    common_options,
    json="Print the address and the files as one JSON object on standard output.",
    quiet="Print nothing but the address, and errors.",
    verbose="Print each request.",
)
@click.pass_context
def view(ctx: click.Context, /, files: tuple[Path, ...], **_: Any) -> None:
    """Show splat files in Spark or PlayCanvas, in a browser.

    Serves a page and the files that it shows, prints its address and opens it in a browser, until Ctrl-C ends it. The
    page has a slider for the budget, colours by level, and what is drawn and how fast; it copies the camera as
    --look-at, and plays camera paths that are dropped onto it.

    Trees in RAD files are streamed, chunk by chunk, as a viewer on the web streams them. Streamed SOG is shown in
    PlayCanvas, everything else in Spark; both, and three.js, come from a CDN unless --spark-dir names a folder that
    has them.
    """
    general, page, place = options_of(ctx, General), options_of(ctx, Page), options_of(ctx, Place)
    keep_apart(ctx)
    place.check(ctx)
    with general.console() as console:
        from ..api import viewing

        served = place.export is None
        if place.export is not None:
            viewing.check_folder(place.export, overwrite=place.overwrite)
        settings = viewing.ViewSettings(page.look_at, page.fov, page.up, page.budget, page.camera_path, page.spark_dir)
        prepared = viewing.prepare(files, settings, served=served, threads=general.threads, progress=console.progress)
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
    with server, contextlib.suppress(KeyboardInterrupt):
        click.echo(json.dumps({"url": server.url, "files": _files(prepared)}) if as_json else server.url)
        sys.stdout.flush()
        names = ", ".join(printable(file.name) for file in prepared.shown)
        everybody = "" if server.loopback else "; everybody who can reach this machine can read them"
        console.say(f"serving {names}{everybody}; Ctrl-C ends it")
        if opens:
            threading.Thread(target=_open, args=(console, server.url), daemon=True).start()
        server.serve_forever()
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
        {"file": str(file.path), "url": file.url, "format": file.format, "bytes": file.bytes} for file in prepared.shown
    ]
