"""Programs in Node that answer requests, one line of JSON each, and their packages from npm."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from threading import Timer
from typing import Any

import pytest

PROGRAMS = Path(__file__).with_name("programs")

#: Time limit of a request, in seconds: far above what any takes, so that only a request that hangs fails.
SECONDS = 120

# Packages by the environment variable that names a folder with them, and the versions that the tests were written for.

#: Spark alone, for its worker; and for pictures with three.js, with which it draws, and the driver of the browser.
SPARK = {"@sparkjsdev/spark": "2.2.0"}
PAGE = {**SPARK, "three": "0.187.0", "playwright-core": "1.65.1"}
#: splat-transform needs playcanvas, mkkellogg's viewer needs three.js.
FOREIGN = {
    "@playcanvas/splat-transform": "2.7.1",
    "playcanvas": "2.23.3",
    "@mkkellogg/gaussian-splats-3d": "0.4.7",
    "three": "0.160.0",
    "gsplat": "1.2.9",
}
#: The library of the authors of SPZ.
SPZ_LIBRARY = {"@adobe/spz": "0.2.3"}
#: Babylon.js unpacks .sog files with fflate.
ENGINES = {
    "playcanvas": "2.23.3",
    "@playcanvas/supersplat-viewer": "1.36.2",
    "@playcanvas/splat-transform": "3.7.0",
    "@babylonjs/core": "9.34.0",
    "@babylonjs/loaders": "9.28.0",
    "fflate": "0.8.3",
    "cesium": "1.145.0",
    "playwright-core": "1.65.1",
}


class Node:
    """One Node process of a program in `PROGRAMS`, which answers one request after the other.

    Args:
        program: name of the file.
        arguments: of the program, such as the folder with node_modules and the path of the browser.
        scratch: an empty folder, for standard error and other files.
    """

    def __init__(self, program: str, *arguments: Path | str, scratch: Path) -> None:
        self._log = scratch / "stderr.txt"
        command = ["node", str(PROGRAMS / program), *map(str, arguments)]
        with self._log.open("wb") as stderr:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, encoding="utf-8"
            )

    def close(self) -> None:
        assert self._process.stdin and self._process.stdout
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait(SECONDS)

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return the answer to a request; `AssertionError` if it is an error or the process ends."""
        assert self._process.stdin and self._process.stdout
        watchdog = Timer(SECONDS, self._process.kill)
        watchdog.start()
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            answer: dict[str, Any] = json.loads(self._process.stdout.readline() or '{"error": "the process ended"}')
        except BrokenPipeError:
            answer = {"error": "the process ended"}
        finally:
            watchdog.cancel()
        if "error" in answer:
            log = self._log.read_text(encoding="utf-8", errors="replace")[-2000:]
            raise AssertionError(f"{request} failed: {answer['error']}\n{log}")
        return answer


def require(program: str) -> str:
    """Return the path of "node" or "chromium", or skip the test."""
    path = shutil.which(program)
    if path is None:
        pytest.skip(f"{program} is not installed")
    return path


def folder_with(
    packages: Mapping[str, str],
    *,
    variable: str,
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """Return a folder whose node_modules has packages: the one that an environment variable names, or a new one.

    Args:
        packages: versions by name, with all that they need; their scripts are not run, nor their peers installed.
        variable: the environment variable; versions in its folder are not checked.
        request: request of the calling fixture; the new folder is kept in its cache.
        tmp_path_factory: makes the new folder if there is no cache.
    """
    require("node")
    if given := os.environ.get(variable):
        missing = [name for name in packages if not (Path(given) / "node_modules" / name).is_dir()]
        if missing and packages is PAGE:  # the folder may have Spark alone, which suffices for all other tests
            pytest.skip(f"{variable} has no {' and no '.join(missing)}")
        assert not missing, f"{variable} is {given}, which has no node_modules/{missing[0]}"
        return Path(given).resolve()
    cache = getattr(request.config, "cache", None)
    label = variable.lower().removesuffix("_dir")
    parent = cache.mkdir(label) if cache else tmp_path_factory.mktemp(label)
    folder: Path = parent / "-".join(packages.values())
    with _locked(parent / "lock"):  # several processes may run tests at once
        if not _has(folder, packages):
            _install(folder, packages)
    return folder


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w") as file:
        if os.name == "posix":
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _has(folder: Path, packages: Mapping[str, str]) -> bool:
    manifests = {name: folder / "node_modules" / name / "package.json" for name in packages}
    return all(
        path.is_file() and json.loads(path.read_text(encoding="utf-8"))["version"] == packages[name]
        for name, path in manifests.items()
    )


def _install(folder: Path, packages: Mapping[str, str]) -> None:
    """Install packages beside `folder` and rename the result to it, so that it is complete or missing."""
    names = ", ".join(packages)
    with tempfile.TemporaryDirectory(dir=folder.parent) as temporary:
        work = Path(temporary) / "packages"
        # Peer dependencies are for pages only, or listed among the packages.
        options = ("--no-audit", "--no-fund", "--no-save", "--ignore-scripts", "--legacy-peer-deps", "--prefix", work)
        wanted = (f"{name}@{version}" for name, version in packages.items())
        command = [require("npm"), "install", *map(str, options), *wanted]
        try:
            done = subprocess.run(command, capture_output=True, encoding="utf-8", timeout=120, check=False)
        except subprocess.TimeoutExpired:
            pytest.skip(f"npm takes too long to install {names}")
        if done.returncode or not _has(work, packages):
            pytest.skip(f"npm cannot install {names}: {done.stderr[:300]}")
        shutil.rmtree(folder, ignore_errors=True)
        work.replace(folder)
