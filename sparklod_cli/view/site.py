"""A site: the page with its settings, camera paths, libraries and splat files; and its export into a folder."""

from __future__ import annotations

import binascii
import contextlib
import dataclasses
import hashlib
import json
import math
import os
import re
import secrets
import shutil
from base64 import b64decode, b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from .. import __version__
from ..cameras.camera import Settings as CameraSettings
from ..cameras.camera_files import Files, read
from ..cameras.camera_formats import NAMES
from ..cameras.sources import CameraPath
from ..io.files import leads_away, open_plain, read_text
from ..model.scene import up_notes_of
from ..system.errors import CameraPathError, OutputError, SparklodError, reason_of
from ..system.output import try_place, write_file
from ..system.progress import Progress, silent
from ..system.untrusted import parse_json, printable, quoted_value
from .shown_files import ENGINES, SPARK_TYPES, Extent, Resources, ShownFile

SPARK, PLAYCANVAS, CESIUM, THREE = "@sparkjsdev/spark", "playcanvas", "cesium", "three"

#: npm packages of each engine of `shown_files.ENGINES`; the page itself uses the vectors of three.js.
PACKAGES = {"spark": (SPARK, THREE), "playcanvas": (PLAYCANVAS, THREE), "cesium": (CESIUM, THREE)}

#: Versions with which the page was tested.
VERSIONS = {SPARK: "2.2.0", PLAYCANVAS: "2.23.3", CESIUM: "1.145.0", THREE: "0.187.0"}

#: A CDN of npm packages as published.
CDN = "https://cdn.jsdelivr.net/npm"

#: SHA-384 of modules in these versions, by package and path; a browser refuses a module of the CDN with another digest.
#: Spark imports one module of the examples of three.js, whose main module imports its core.
MODULES = {
    (SPARK, "dist/spark.module.js"): "OQEdbh3DPqIT6IsNEl9DQBNeBw4p2sTknDP1lrT6MjlQoTIEtzzM5LZ4ljB1QCh3",
    (PLAYCANVAS, "build/playcanvas.min.mjs"): "jIMtMpSIHxCHjnqekLLvZ9pz0cGMfA5JXdcO5YcNe5+Kn2IgCATDYJK4MjQVpxS+",
    (THREE, "build/three.module.js"): "T/E3B9AvPtLn5PKD7aTSFqizQcA4kHDfU0lub7u0fvM4w9BMGcSb3yI7r5LqMAMn",
    (THREE, "build/three.core.js"): "drH6BueSlcvoXCwAqWkNJvXwu2Ax3mnGOmZnIXaomedIw+uXSP9Bf/XIUINgLUW+",
    (THREE, "examples/jsm/postprocessing/Pass.js"): "927X5fcqlqKPsXZV1w3tv5BZx797OXX3D/TDJk0FHwJd12z58B5aqS77g5LZoprI",
}

#: Patterns of the other files that a package loads: workers of CesiumJS that pack and sort splats, their chunks, whose
#: names depend on the version, and files that each of its scenes reads.
FILES = {
    CESIUM: (
        "Build/Cesium/index.js",
        "Build/Cesium/Workers/chunk-*.js",
        "Build/Cesium/Workers/gaussianSplat*.js",
        "Build/Cesium/Workers/transferTypedArrayTest.js",
        "Build/Cesium/ThirdParty/wasm_splats_bg.wasm",
        "Build/Cesium/Assets/Images/ion-credit.png",
        "Build/Cesium/Assets/IAU2006_XYS/*.json",
    )
}

#: Packages that need `eval` and inline styles: Knockout in CesiumJS evaluates text to find the global object, and its
#: credits have inline styles.
LENIENT = {CESIUM}

#: Import map of the page: names of modules, or prefixes of these, with package and path.
MODULE_NAMES = {
    SPARK: (SPARK, "dist/spark.module.js"),
    PLAYCANVAS: (PLAYCANVAS, "build/playcanvas.min.mjs"),
    CESIUM: (CESIUM, "Build/Cesium/index.js"),
    THREE: (THREE, "build/three.module.js"),
    "three/addons/": (THREE, "examples/jsm/"),
}

#: File names of licenses, which must be served beside the modules; each package has one of them.
LICENSES = ("LICENSE", "LICENSE.md")


@dataclass(frozen=True)
class Libraries:
    """Packages of an engine.

    Attributes:
        versions: by package.
        source: address of the CDN or path of the folder, for display.
        import_map: addresses of modules, and on a CDN their digests.
        files: files that the site itself serves, by name.
    """

    versions: Mapping[str, str]
    source: str
    import_map: Mapping[str, Mapping[str, str]]
    files: Mapping[str, Path]

    def notes(self) -> list[str]:
        """Return a note for each version with which the page was not tested."""
        return [
            f"{self.source} has {package} {version}; the page was tested with {VERSIONS[package]}"
            for package, version in self.versions.items()
            if version != VERSIONS[package]
        ]


def from_cdn(engine: str = "spark") -> Libraries:
    """Return the libraries of an engine on the CDN.

    `SparklodError` if the engine loads workers, of which a browser does not check digests.
    """
    packages = PACKAGES[engine]
    if any(package in FILES for package in packages):
        raise SparklodError(
            f"{ENGINES[engine]} cannot be taken from a CDN; install it with {_install(Path('DIR'), engine)} and give"
            " --spark-dir DIR"
        )

    def url(package: str, path: str) -> str:
        return f"{CDN}/{package}@{VERSIONS[package]}/{path}"

    imports = {name: url(*place) for name, place in MODULE_NAMES.items() if place[0] in packages}
    integrity = {url(*place): f"sha384-{digest}" for place, digest in MODULES.items() if place[0] in packages}
    versions = {package: VERSIONS[package] for package in packages}
    return Libraries(versions, CDN, {"imports": imports, "integrity": integrity}, {})


def from_folder(folder: Path, engine: str = "spark") -> Libraries:
    """Return the libraries of an engine in a folder that has a node_modules, or is one.

    `SparklodError`, with the command that installs it, if a package or one of its modules is missing.
    """
    packages = folder if folder.name == "node_modules" else folder / "node_modules"
    install = _install(folder, engine)
    versions, files, imports = {}, {}, {}
    for package in PACKAGES[engine]:
        home = packages / package
        if not os.path.isdir(home):  # noqa: PTH112, since `Path.is_dir` fails on names that are too long
            raise SparklodError(f"{packages} has no {package}; install it with {install}")
        versions[package] = _version(home)
        for pattern in (*LICENSES, *FILES.get(package, ()), *(path for each, path in MODULES if each == package)):
            for found in filter(Path.is_file, home.glob(pattern)):
                # Links, such as those of pnpm, are followed here, once.
                files[f"lib/{package}/{found.relative_to(home).as_posix()}"] = found.resolve()
    for name, (package, path) in MODULE_NAMES.items():
        if package in versions:
            imports[name] = f"./lib/{package}/{path}"
            if not path.endswith("/") and f"lib/{package}/{path}" not in files:
                raise SparklodError(f"{packages / package} has no {path}; install {package} anew with {install}")
    return Libraries(versions, str(folder), {"imports": imports}, files)


def _install(folder: Path, engine: str) -> str:
    return f"npm install --prefix {folder} " + " ".join(f"{name}@{VERSIONS[name]}" for name in PACKAGES[engine])


def _version(package: Path) -> str:
    try:
        value = parse_json(read_text(package / "package.json"))
        return printable(str(value["version"]), 40)
    except (ValueError, KeyError, TypeError):
        raise SparklodError(f"{package / 'package.json'} has no version; install it anew with npm") from None


#: Most bytes of a request with camera files in base64; COLMAP's images.txt of a large scene has 50 MB.
MAX_BYTES = 1 << 27

#: Most files dropped together; COLMAP's models have three.
MAX_FILES = 16

#: Most cameras of a path sent to the page; a longer path is sampled evenly.
MAX_CAMERAS = 20_000


def parse_drop(body: bytes, settings: CameraSettings) -> dict[str, Any]:
    """Parse dropped camera files and return the path as `frames_of`; `CameraPathError` if they are invalid.

    Args:
        body: JSON, {"files": [{"name": text, "data": base64}]}.
        settings: of the cameras; `up` is ignored for files whose cameras have up axes of their own.
    """
    try:
        files = parse_json(body)["files"]
        contents = {file["name"]: b64decode(file["data"], validate=True) for file in files[:MAX_FILES]}
    except (ValueError, KeyError, TypeError, binascii.Error):
        contents = {}
    if not contents:
        raise CameraPathError("the request holds no files")
    for name in contents:
        if not isinstance(name, str) or leads_away(name):
            raise CameraPathError(f"{quoted_value(name)} is no name of a file; rename it")
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


def frames_of(path: CameraPath) -> dict[str, Any]:
    """Return a camera path for the page, with camera-to-world matrices by columns, degrees and seconds."""
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


#: Files in the package's folder `page`; `INDEX` is a template.
INDEX = "index.html"
PAGE = (
    *("boot.js", "view.js", "spark.js", "scene.js", "sizes.js", "playcanvas.js", "cesium.js", "file_state.js"),
    *("faults.js", "controls.js", "panel.js", "player.js", "paths.js", "text.js"),
    "style.css",
)

#: Name of the settings of the page, and their "generator", by which `export` recognizes its own sites.
SETTINGS, GENERATOR = "view.json", "sparklod view"

#: Path to which the page posts dropped camera paths.
CAMERAS = "cameras"

#: Placeholders of the template.
MARK = re.compile(r"\{\{([A-Z_]+)\}\}")


@dataclass(frozen=True)
class Site:
    """A site, with notes for the user; `cameras` are the settings of camera paths dropped onto the page."""

    resources: Resources
    cameras: CameraSettings
    shown: Sequence[ShownFile]
    notes: Sequence[str]


def site_of(
    shown: Sequence[ShownFile],
    extents: Sequence[Extent],
    start: Mapping[str, Any],
    budget: int | None,
    path: CameraPath | None,
    libraries: Libraries,
    *,
    cameras: CameraSettings,
    served: bool,
) -> Site:
    """Return the site of files with their extents.

    Args:
        start: the first view, from `shown_files.start_of`.
        cameras: settings of camera paths dropped onto the page.
        served: `server` will serve the site and parse camera paths; otherwise the page reads those of sparklod only.
    """
    folder = files(__package__).joinpath("page")
    title = ", ".join(file.name for file in shown)
    settings = {
        "generator": GENERATOR,
        "version": __version__,
        "title": title,
        "engine": shown[0].engine,
        "files": [_file(file, extent) for file, extent in zip(shown, extents, strict=True)],
        "start": start,
        "up": cameras.up_axis,
        "budget": budget,
        "path": None if path is None else frames_of(path),
        "cameras": CAMERAS if served else None,
        "libraries": {"source": libraries.source, "versions": dict(libraries.versions)},
    }
    resources: dict[str, bytes | Path] = {
        INDEX: _index(folder.joinpath(INDEX).read_text("utf-8"), title, libraries).encode(),
        SETTINGS: json.dumps(settings, ensure_ascii=True, indent=1).encode(),
        **{name: folder.joinpath(name).read_bytes() for name in PAGE},
        **libraries.files,
    }
    for file in shown:
        resources |= file.files
    notes = [file.note for file in shown if file.note is not None]
    if cameras.up is None:
        notes += up_notes_of((file.name, each.up, each.up_by) for file, each in zip(shown, extents, strict=True))
    return Site(resources, cameras, shown, [*libraries.notes(), *notes, *(path.notes if path else ())])


def _file(shown: ShownFile, extent: Extent) -> dict[str, Any]:
    chunks = None if shown.header is None else shown.header.chunks
    return {
        "name": shown.name,
        "url": shown.url,
        "format": shown.format,
        "type": SPARK_TYPES.get(shown.format),
        "bytes": shown.bytes,
        "splats": extent.splats,
        "leaves": extent.leaves,
        "levels": extent.levels,
        "up": extent.up,
        "layout": extent.layout,
        "chunks": None if chunks is None else len(chunks),
        "first_bytes": None if chunks is None else sum(entry.bytes for entry in chunks[:1]),
        "paged": shown.paged,
        "chunked": shown.header is not None and shown.header.chunked,
    }


def _index(template: str, title: str, libraries: Libraries) -> str:
    """Fill in the template of the page: addresses of its libraries, and a policy that lets it load nothing else."""
    import_map = json.dumps(libraries.import_map, indent=1).replace("<", "\\u003c")
    digest = b64encode(hashlib.sha256(import_map.encode()).digest()).decode()
    scripts = ["'self'", f"'sha256-{digest}'", "'wasm-unsafe-eval'", *libraries.import_map.get("integrity", ())]
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


#: Name of an incomplete folder, or of one about to be removed.
PARTS = ".sparklod-{}.part"

#: Bytes copied at a time.
PIECE = 1 << 20

#: Folders, and suffixes of files, in an exported site; names of files depend on the version.
FOLDERS, SUFFIXES = ("data", "lib"), (".html", ".css", ".js", ".json")


def check_folder(folder: Path, site: Site | None = None, *, overwrite: bool) -> None:
    """Raise an `OutputError` if a site cannot be written into a folder.

    An existing folder is replaced only if it is empty or holds an exported site and nothing else: other files in it,
    such as the .git of published pages, belong to the user. Files of the site must lie outside the folder.
    """
    try:
        if folder.suffix.lower() in (".html", ".htm") and not folder.is_dir():
            raise OutputError(f"{folder} names a page, but --export writes a folder; give {folder.with_suffix('')}")
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder} is a file; name a folder for the site")
        if folder.is_dir() and any(folder.iterdir()):
            if not overwrite:
                raise OutputError(f"{folder} exists, add --overwrite to replace the site in it")
            if not _is_site(folder):
                raise OutputError(f"{folder} holds something else than a site of sparklod view; name another folder")
            for other in folder.iterdir():
                if other.name not in FOLDERS if other.is_dir() else other.suffix not in SUFFIXES:
                    raise OutputError(f"{folder} holds {other.name}, which is not of the site; move it away first")
        real = folder.resolve()
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {reason_of(error)}") from None
    try_place(folder, least=0 if site is None else _total(site))
    for content in site.resources.values() if site is not None else ():
        if isinstance(content, Path) and content.is_relative_to(real):
            raise OutputError(f"{folder} holds {content.name}, which is to be shown; name another folder")


def _is_site(folder: Path) -> bool:
    try:
        settings = parse_json(read_text(folder / SETTINGS))
    except (SparklodError, ValueError):
        return False
    return isinstance(settings, dict) and settings.get("generator") == GENERATOR


def export(site: Site, folder: Path, *, overwrite: bool, progress: Progress = silent) -> int:
    """Write a site into a folder, which appears when it is complete; return the bytes written."""
    check_folder(folder, site, overwrite=overwrite)
    real = folder.resolve()
    part = real.with_name(PARTS.format(secrets.token_hex(8)))
    total, done = _total(site), 0
    try:
        real.parent.mkdir(parents=True, exist_ok=True)
        part.mkdir()
        for name, content in site.resources.items():
            pieces = [content] if isinstance(content, bytes) else _pieces(content)
            done += write_file(part / name, pieces, overwrite=False)
            progress("export", done, total, "B")
        _replace(real, part)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {reason_of(error)}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return done


def _total(site: Site) -> int:
    return sum(
        len(content) if isinstance(content, bytes) else content.stat().st_size for content in site.resources.values()
    )


def _pieces(path: Path) -> Iterator[bytes]:
    with open_plain(path) as file:
        while piece := file.read(PIECE):
            yield piece


def _replace(folder: Path, part: Path) -> None:
    """Replace a folder by a complete one, or restore it if that fails."""
    if not folder.exists():
        part.rename(folder)
        return
    aside = part.with_name(PARTS.format(secrets.token_hex(8)))
    folder.rename(aside)
    try:
        part.rename(folder)
    except BaseException:
        with contextlib.suppress(OSError):
            aside.rename(folder)
        raise
    shutil.rmtree(aside, ignore_errors=True)
