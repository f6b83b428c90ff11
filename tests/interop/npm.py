"""Installs packages of other programs from npm, or skips the test if that is not possible."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest


def folder_with(
    packages: Mapping[str, str],
    *,
    variable: str,
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """Returns a folder whose node_modules has packages: the one that an environment variable names, or a new one.

    Args:
        packages: versions by name, with all that they need; their scripts are not run, nor their peers installed.
        variable: the environment variable; versions in its folder are not checked.
        request: request of the calling fixture; the new folder is kept in its cache.
        tmp_path_factory: makes the new folder if there is no cache.
    """
    if given := os.environ.get(variable):
        for name in packages:
            if not (Path(given) / "node_modules" / name).is_dir():
                pytest.fail(f"{variable} is {given}, which has no node_modules/{name}")
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
    """Installs packages beside `folder` and renames the result to it, so that it is complete or missing."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed")
    names = ", ".join(packages)
    with tempfile.TemporaryDirectory(dir=folder.parent) as open_companion:
        work = Path(open_companion) / "packages"
        # Peer dependencies are for pages only, or listed among the packages.
        options = [
            "--no-audit",
            "--no-fund",
            "--no-save",
            "--ignore-scripts",
            "--legacy-peer-deps",
            "--prefix",
            str(work),
        ]
        command = [npm, "install", *options, *(f"{name}@{version}" for name, version in packages.items())]
        try:
            done = subprocess.run(command, capture_output=True, encoding="utf-8", timeout=120, check=False)
        except subprocess.TimeoutExpired:
            pytest.skip(f"npm takes too long to install {names}")
        if done.returncode or not _has(work, packages):
            pytest.skip(f"npm cannot install {names}: {done.stderr[:300]}")
        shutil.rmtree(folder, ignore_errors=True)
        work.replace(folder)
