"""Gets the real Spark and runs it, or skips where that cannot be."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from .spark import Spark

#: The version that these tests were tried with; layouts and file names inside the package may change with it.
VERSION = "2.2.0"
PACKAGE = "@sparkjsdev/spark"


def _has_package(folder: Path) -> bool:
    manifest = folder / "node_modules" / PACKAGE / "package.json"
    return manifest.is_file() and json.loads(manifest.read_text())["version"] == VERSION


def _install(folder: Path) -> None:
    """Installs the package beside `folder` and moves it there, so that the folder is whole or not there."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed")
    with tempfile.TemporaryDirectory(dir=folder.parent) as beside:
        work = Path(beside) / "spark"
        # The peer, three.js, is for pages: the worker does without.
        options = [
            "--no-audit",
            "--no-fund",
            "--no-save",
            "--ignore-scripts",
            "--legacy-peer-deps",
            "--prefix",
            str(work),
        ]
        command = [npm, "install", *options, f"{PACKAGE}@{VERSION}"]
        try:
            done = subprocess.run(command, capture_output=True, encoding="utf-8", timeout=120, check=False)
        except subprocess.TimeoutExpired:
            pytest.skip(f"npm takes too long to install {PACKAGE}")
        if done.returncode or not _has_package(work):
            pytest.skip(f"npm cannot install {PACKAGE}: {done.stderr[:300]}")
        shutil.rmtree(folder, ignore_errors=True)
        work.replace(folder)


@pytest.fixture(scope="session")
def spark_dir(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose node_modules has Spark: the one that SPARK_DIR names, or one of ours."""
    if given := os.environ.get("SPARK_DIR"):
        if not (Path(given) / "node_modules" / PACKAGE).is_dir():
            pytest.fail(f"SPARK_DIR is {given}, which has no node_modules/{PACKAGE}")
        return Path(given).resolve()
    cache = getattr(request.config, "cache", None)
    parent = cache.mkdir("spark") if cache else tmp_path_factory.mktemp("spark")
    folder: Path = parent / VERSION
    if not _has_package(folder):
        _install(folder)
    return folder


@pytest.fixture(scope="session")
def spark(spark_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Spark]:
    """Spark's worker, started once for all tests."""
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    process = Spark(spark_dir, tmp_path_factory.mktemp("spark-arrays"))
    yield process
    process.close()
