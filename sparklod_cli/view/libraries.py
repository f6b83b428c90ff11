"""The libraries that the page draws with: from a CDN at fixed versions, or from a folder of node_modules."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..io import read_text
from ..system.errors import SparklodError
from ..system.printable import printable
from ..system.untrusted import parse_json
from .files import ENGINES

SPARK, PLAYCANVAS, CESIUM, THREE = "@sparkjsdev/spark", "playcanvas", "cesium", "three"

#: What each engine of `files.ENGINES` needs; the page has its vectors from three.js, whatever draws.
PACKAGES = {"spark": (SPARK, THREE), "playcanvas": (PLAYCANVAS, THREE), "cesium": (CESIUM, THREE)}

#: The versions that the page was tested with.
VERSIONS = {SPARK: "2.2.0", PLAYCANVAS: "2.23.3", CESIUM: "1.145.0", THREE: "0.187.0"}

#: Serves the files of npm packages as they were published.
CDN = "https://cdn.jsdelivr.net/npm"

#: The modules by package and path in it, with the SHA-384 of those of `VERSIONS`: a browser refuses a module of the CDN
#: that has another one. Spark imports one module of three's examples, three's first module imports its core.
MODULES = {
    (SPARK, "dist/spark.module.js"): "OQEdbh3DPqIT6IsNEl9DQBNeBw4p2sTknDP1lrT6MjlQoTIEtzzM5LZ4ljB1QCh3",
    (PLAYCANVAS, "build/playcanvas.min.mjs"): "jIMtMpSIHxCHjnqekLLvZ9pz0cGMfA5JXdcO5YcNe5+Kn2IgCATDYJK4MjQVpxS+",
    (THREE, "build/three.module.js"): "T/E3B9AvPtLn5PKD7aTSFqizQcA4kHDfU0lub7u0fvM4w9BMGcSb3yI7r5LqMAMn",
    (THREE, "build/three.core.js"): "drH6BueSlcvoXCwAqWkNJvXwu2Ax3mnGOmZnIXaomedIw+uXSP9Bf/XIUINgLUW+",
    (THREE, "examples/jsm/postprocessing/Pass.js"): "927X5fcqlqKPsXZV1w3tv5BZx797OXX3D/TDJk0FHwJd12z58B5aqS77g5LZoprI",
}

#: What else an engine loads, as patterns of paths in its package: workers of CesiumJS that pack and sort splats, whose
#: names of other modules change from version to version; and what every scene of it reads.
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

#: Packages that need a page which may evaluate text and hold styles: CesiumJS, in which Knockout looks for `this` so,
#: and which writes the styles of its credits into the page.
LENIENT = {CESIUM}

#: What the page and Spark call modules, and what those names begin or are.
NAMES = {
    SPARK: (SPARK, "dist/spark.module.js"),
    PLAYCANVAS: (PLAYCANVAS, "build/playcanvas.min.mjs"),
    CESIUM: (CESIUM, "Build/Cesium/index.js"),
    THREE: (THREE, "build/three.module.js"),
    "three/addons/": (THREE, "examples/jsm/"),
}

#: Accompany the modules, as the licenses of all packages ask for: a package has one of these.
LICENSES = ("LICENSE", "LICENSE.md")


@dataclass(frozen=True)
class Libraries:
    """Addresses and files of the packages of an engine.

    Attributes:
        versions: by package.
        source: for display: the address of the CDN, or the folder.
        base: of the addresses of all packages, absolute or relative to the page.
        integrity: of the modules, by address; empty where the site itself has them.
        files: that the site itself has, by the names that they are served under.
    """

    versions: Mapping[str, str]
    source: str
    base: str
    integrity: Mapping[str, str]
    files: Mapping[str, Path]

    def import_map(self) -> dict[str, dict[str, str]]:
        """Return the content of `<script type="importmap">`."""
        imports = {
            name: self._url(package, path) for name, (package, path) in NAMES.items() if package in self.versions
        }
        return {"imports": imports} | ({"integrity": dict(self.integrity)} if self.integrity else {})

    def _url(self, package: str, path: str) -> str:
        return _url(self.base, package, self.versions[package] if self.integrity else None, path)

    def notes(self) -> list[str]:
        """Return notes on the versions for display."""
        return [
            f"{self.source} has {package} {version}; the page was tested with {VERSIONS[package]}"
            for package, version in self.versions.items()
            if version != VERSIONS[package]
        ]


def _url(base: str, package: str, version: str | None, path: str) -> str:
    return f"{base}/{package}{f'@{version}' if version else ''}/{path}"


def from_cdn(engine: str = "spark") -> Libraries:
    """Return the libraries of the CDN for an engine.

    Raises:
        SparklodError: the engine loads workers, which a browser does not check by digests.
    """
    if any(package in FILES for package in PACKAGES[engine]):
        raise SparklodError(
            f"{ENGINES[engine]} cannot be taken from a CDN; install it with {_install(Path('DIR'), engine)} and give"
            " --spark-dir DIR"
        )
    versions = {package: VERSIONS[package] for package in PACKAGES[engine]}
    integrity = {
        _url(CDN, package, versions[package], path): f"sha384-{digest}"
        for (package, path), digest in MODULES.items()
        if package in versions
    }
    return Libraries(versions, CDN, CDN, integrity, {})


def from_folder(folder: Path, engine: str = "spark") -> Libraries:
    """Return the libraries for an engine of a folder that has a node_modules, or is one.

    Raises:
        SparklodError: a package, or a module of it, is missing; the text says how to install it.
    """
    packages = folder if folder.name == "node_modules" else folder / "node_modules"
    install = _install(folder, engine)
    versions, files = {}, {}
    for package in PACKAGES[engine]:
        if not os.path.isdir(packages / package):  # noqa: PTH112, since `Path.is_dir` fails on names that are too long
            raise SparklodError(f"{packages} has no {package}; install it with {install}")
        versions[package] = _version(packages / package)
        home = packages / package
        for pattern in (*LICENSES, *FILES.get(package, ())):
            for found in home.glob(pattern):
                files[f"lib/{package}/{found.relative_to(home).as_posix()}"] = found
    for package, path in MODULES:
        if package in versions:
            files[f"lib/{package}/{path}"] = packages / package / path
    # A link, such as those of pnpm, is followed here, once.
    files = {name: path.resolve() for name, path in files.items() if path.is_file()}
    for package, path in NAMES.values():
        name = f"lib/{package}/{path}"
        if package in versions and not path.endswith("/") and name not in files:
            raise SparklodError(f"{packages / package} has no {path}; install {package} anew with {install}")
    return Libraries(versions, str(folder), "./lib", {}, files)


def _install(folder: Path, engine: str) -> str:
    """Return the command that installs the packages of an engine in a folder."""
    return f"npm install --prefix {folder} " + " ".join(f"{name}@{VERSIONS[name]}" for name in PACKAGES[engine])


def _version(package: Path) -> str:
    """Return the version of an installed package."""
    try:
        value = parse_json(read_text(package / "package.json"))
        return printable(str(value["version"]), 40)
    except (ValueError, KeyError, TypeError):
        raise SparklodError(f"{package / 'package.json'} has no version; install it anew with npm") from None
