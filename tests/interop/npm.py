"""Gets packages of other people's programs from npm, or skips where that cannot be."""

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
    """A folder whose node_modules has these packages: the one that an environment variable names, or one of ours.

    Args:
        packages: versions by name, all that is needed; no scripts of theirs run and no peers come with them.
        variable: the environment variable; the versions in its folder are not looked at.
        request: of the fixture that asks; its cache holds our folder.
        tmp_path_factory: where there is no cache.
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
    with _locked(parent / "lock"):  # several processes may test at once
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
    """Installs the packages beside `folder` and moves them there, so that the folder is whole or not there."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed")
    names = ", ".join(packages)
    with tempfile.TemporaryDirectory(dir=folder.parent) as beside:
        work = Path(beside) / "packages"
        # Peers are for pages, or named among the packages.
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
