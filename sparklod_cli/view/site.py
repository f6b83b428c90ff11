"""A site: the page, what it is told, and all files that it may ask for, by their names."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from .. import __version__
from ..cameras.frame import Settings as CameraSettings
from ..cameras.path import CameraPath
from .drops import frames_of
from .files import Resources, ShownFile
from .libraries import Libraries
from .start import Extent, Point, Start

#: Files of the page, in the package's folder `page`; `INDEX` is a template.
INDEX = "index.html"
PAGE = (
    *("boot.js", "view.js", "spark.js", "playcanvas.js", "scene.js", "sizes.js"),
    *("controls.js", "panel.js", "player.js", "paths.js", "text.js"),
    "style.css",
)

#: What the page reads first, by which `export` also knows its own sites.
SETTINGS = "view.json"

#: Where a server parses camera paths that are dropped onto the page.
CAMERAS = "cameras"

#: Places of the template that are filled.
MARK = re.compile(r"\{\{([A-Z_]+)\}\}")

#: What marks `SETTINGS`.
GENERATOR = "sparklod view"


@dataclass(frozen=True)
class Look:
    """How the page shows the files at first.

    Attributes:
        start: the camera.
        up: direction that is up.
        budget: splats; None for Spark's default on the device.
        path: cameras that the page plays; None for none.
    """

    start: Start
    up: Point
    budget: int | None
    path: CameraPath | None


@dataclass(frozen=True)
class Site:
    """A site.

    Attributes:
        resources: all of it, by name.
        cameras: settings of camera paths that are dropped onto the page.
    """

    resources: Resources
    cameras: CameraSettings


def site_of(
    shown: Sequence[ShownFile],
    extents: Sequence[Extent],
    look: Look,
    libraries: Libraries,
    *,
    cameras: CameraSettings,
    served: bool,
) -> Site:
    """The site of some files.

    Args:
        shown: the files, and
        extents: what they hold.
        look: how the page shows them at first.
        libraries: that it draws with.
        cameras: settings of camera paths that are dropped onto the page.
        served: by `server`, which parses camera paths; otherwise the page can read those of sparklod itself.
    """
    folder = files(__package__).joinpath("page")
    title = ", ".join(file.name for file in shown)
    settings = {
        "generator": GENERATOR,
        "version": __version__,
        "title": title,
        "engine": shown[0].engine,
        "files": [_file(file, extent) for file, extent in zip(shown, extents, strict=True)],
        "start": dataclasses.asdict(look.start),
        "up": look.up,
        "budget": look.budget,
        "path": None if look.path is None else frames_of(look.path),
        "cameras": CAMERAS if served else None,
        "libraries": {"source": libraries.source, "versions": dict(libraries.versions)},
    }
    resources: dict[str, bytes | Path] = {
        INDEX: _index(folder.joinpath(INDEX).read_text("utf-8"), title, libraries).encode(),
        SETTINGS: json.dumps(settings, ensure_ascii=True, indent=1).encode(),
    }
    for name in PAGE:
        resources[name] = folder.joinpath(name).read_bytes()
    resources.update(libraries.files)
    for file in shown:
        resources.update(file.files)
    return Site(resources, cameras)


def _file(shown: ShownFile, extent: Extent) -> dict[str, Any]:
    return {
        "name": shown.name,
        "url": shown.url,
        "format": shown.format,
        "type": shown.spark_type,
        "bytes": shown.bytes,
        "splats": extent.splats,
        "leaves": extent.leaves,
        "levels": extent.levels,
        "chunks": None if shown.header is None else len(shown.header.chunks),
        "first_bytes": None if shown.header is None else sum(entry.bytes for entry in shown.header.chunks[:1]),
        "paged": shown.paged,
        "chunked": shown.header is not None and shown.header.chunked,
    }


def _index(template: str, title: str, libraries: Libraries) -> str:
    """The page with the addresses of its libraries, and a policy that lets it load nothing else."""
    import_map = json.dumps(libraries.import_map(), indent=1).replace("<", "\\u003c")
    digest = base64.b64encode(hashlib.sha256(import_map.encode()).digest()).decode()
    scripts = ["'self'", f"'sha256-{digest}'", "'wasm-unsafe-eval'", *libraries.integrity]
    policy = {
        "default-src": ["'none'"],
        "script-src": scripts,
        "worker-src": ["blob:", "data:"],
        "style-src": ["'self'"],
        "img-src": ["'self'", "data:", "blob:"],
        "connect-src": ["'self'", "data:", "blob:"],
        "base-uri": ["'none'"],
        "form-action": ["'none'"],
    }
    text = "; ".join(" ".join([name, *sources]) for name, sources in policy.items())
    marks = {"POLICY": escape(text), "TITLE": escape(title), "IMPORT_MAP": import_map}
    return MARK.sub(lambda found: marks[found[1]], template)
