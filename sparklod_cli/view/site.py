"""A site: the page, its settings and camera paths, and all files that it may ask for, by their names."""

from __future__ import annotations

import base64
import binascii
import contextlib
import dataclasses
import hashlib
import json
import math
import re
from base64 import b64decode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from .. import __version__
from ..cameras.formats.source import Files
from ..cameras.formats.table import NAMES
from ..cameras.frame import Settings as CameraSettings
from ..cameras.path import CameraPath, read
from ..io.local_files import leads_away
from ..model.axes import lines_of
from ..system.errors import CameraPathError
from ..system.untrusted import parse_json, quoted_value
from .files import Resources, ShownFile
from .libraries import LENIENT, Libraries
from .start import Extent, Start

#: Bytes of a request with camera files, in base64: COLMAP's images.txt of a large scene has 50 MB.
MAX_BYTES = 1 << 27

#: Files that are dropped together; COLMAP's models have three.
MAX_FILES = 16

#: Cameras that the page gets; of longer paths only so many, evenly spaced.
MAX_CAMERAS = 20_000


def parse_drop(body: bytes, settings: CameraSettings) -> dict[str, Any]:
    """Return the path of some dropped files, as `frames_of` has it.

    Args:
        body: JSON, {"files": [{"name": text, "data": base64}]}.
        settings: of the cameras; `up` is left out of those of files whose cameras have up axes of their own.

    Raises:
        CameraPathError: they are no camera path that sparklod reads.
    """
    contents = _contents(body)
    first = next((names[0] for names in NAMES if names[0] in contents), next(iter(contents)))
    beside = next((names for names in NAMES if first in names), ())
    dropped = Files(Path(first), {name: contents[name] for name in (first, *beside) if name in contents})
    if settings.up is not None:
        with contextlib.suppress(CameraPathError):
            return frames_of(read(dropped, settings=settings))
    try:
        return frames_of(read(dropped, settings=dataclasses.replace(settings, up=None)))
    except CameraPathError as error:
        raise CameraPathError(f"{first}: {error}") from None


def _contents(body: bytes) -> Mapping[str, bytes]:
    """Return the dropped files by their names, at least one."""
    try:
        files = parse_json(body)["files"]
        contents = {file["name"]: b64decode(file["data"], validate=True) for file in files[:MAX_FILES]}
    except (ValueError, KeyError, TypeError, binascii.Error):
        raise CameraPathError("the request holds no files") from None
    for name in contents:
        if not isinstance(name, str) or leads_away(name):
            raise CameraPathError(f"{quoted_value(name)} is no name of a file; rename it")
    if not contents:
        raise CameraPathError("the request holds no files")
    return contents


def frames_of(path: CameraPath) -> dict[str, Any]:
    """Return a camera path as the page plays it: camera-to-world matrices by columns, degrees and seconds."""
    every = -(-len(path) // MAX_CAMERAS)
    notes = [*path.notes]
    if every > 1:
        notes.append(f"It has {len(path):,} cameras; every {every}th is played.")
    frames = [
        {
            "matrix": [round(value, 9) for value in camera.camera_to_world.T.ravel().tolist()],
            "fov": round(math.degrees(camera.fov_y), 6),
            "time": camera.time,
            "name": camera.name,
        }
        for camera in path.cameras[::every]
    ]
    return {"format": path.format, "notes": notes, "frames": frames}


#: Files of the page, in the package's folder `page`; `INDEX` is a template.
INDEX = "index.html"
PAGE = (
    *("boot.js", "view.js", "spark.js", "scene.js", "sizes.js", "playcanvas.js", "cesium.js", "file_state.js"),
    *("faults.js", "controls.js", "panel.js", "player.js", "paths.js", "text.js"),
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
class Site:
    """A site.

    Attributes:
        resources: all of it, by name.
        cameras: settings of camera paths that are dropped onto the page.
        shown: its splat files.
        notes: what a person should know.
    """

    resources: Resources
    cameras: CameraSettings
    shown: Sequence[ShownFile]
    notes: Sequence[str]


def site_of(
    shown: Sequence[ShownFile],
    extents: Sequence[Extent],
    start: Start,
    budget: int | None,
    path: CameraPath | None,
    libraries: Libraries,
    *,
    cameras: CameraSettings,
    served: bool,
) -> Site:
    """Return the site of some files, of given extents.

    Args:
        budget: splats; None for Spark's default on the device.
        path: cameras that the page plays; None for none.
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
        "start": dataclasses.asdict(start),
        "up": cameras.up_axis,
        "budget": budget,
        "path": None if path is None else frames_of(path),
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
    notes = [file.note for file in shown if file.note is not None]
    if cameras.up is None:
        notes += lines_of((file.name, each.up, each.up_by) for file, each in zip(shown, extents, strict=True))
    return Site(resources, cameras, shown, [*libraries.notes(), *notes, *(path.notes if path else ())])


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
        "up": extent.up,
        "layout": extent.layout,
        "chunks": None if shown.header is None else len(shown.header.chunks),
        "first_bytes": None if shown.header is None else sum(entry.bytes for entry in shown.header.chunks[:1]),
        "paged": shown.paged,
        "chunked": shown.header is not None and shown.header.chunked,
    }


def _index(template: str, title: str, libraries: Libraries) -> str:
    """Return the page with the addresses of its libraries, and a policy that lets it load nothing else."""
    import_map = json.dumps(libraries.import_map(), indent=1).replace("<", "\\u003c")
    digest = base64.b64encode(hashlib.sha256(import_map.encode()).digest()).decode()
    scripts = ["'self'", f"'sha256-{digest}'", "'wasm-unsafe-eval'", *libraries.integrity]
    styles = ["'self'"]
    if LENIENT & libraries.versions.keys():
        scripts.append("'unsafe-eval'")
        styles.append("'unsafe-inline'")
    policy = {
        "default-src": ["'none'"],
        "script-src": scripts,
        "worker-src": ["'self'", "blob:", "data:"],
        "style-src": styles,
        "img-src": ["'self'", "data:", "blob:"],
        "connect-src": ["'self'", "data:", "blob:"],
        "base-uri": ["'none'"],
        "form-action": ["'none'"],
    }
    text = "; ".join(" ".join([name, *sources]) for name, sources in policy.items())
    marks = {"POLICY": escape(text), "TITLE": escape(title), "IMPORT_MAP": import_map}
    return MARK.sub(lambda found: marks[found[1]], template)
