"""Fixtures that start the real Spark and other programs for splat files, or skip the test if they are missing."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.interop import npm
from tests.interop.foreign import PACKAGES, Foreign
from tests.interop.page import Page
from tests.interop.spark import Spark

#: The version that these tests were written for; other versions may have other layouts and file names.
SPARK = {"@sparkjsdev/spark": "2.2.0"}
#: Packages for pictures: Spark, three.js, which it draws with, and the driver of the browser.
PAGE = {**SPARK, "three": "0.187.0", "playwright-core": "1.65.1"}


@pytest.fixture(scope="session")
def spark_dir(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose node_modules has Spark: the one that SPARK_DIR names, or one that is installed here."""
    return npm.folder_with(SPARK, variable="SPARK_DIR", request=request, tmp_path_factory=tmp_path_factory)


@pytest.fixture(scope="session")
def spark(spark_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Spark]:
    """Spark's worker, started once for all tests."""
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    process = Spark(spark_dir, tmp_path_factory.mktemp("spark-arrays"))
    yield process
    process.close()


@pytest.fixture(scope="module")  # an engine draws its page again and again as long as that is open
def page(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """Spark in a browser, started once for the tests of a module."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("Chromium is not installed (Debian's package chromium)")
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    if given := os.environ.get("SPARK_DIR"):  # it may have Spark alone, which all other tests can do with
        missing = [name for name in PAGE if not (Path(given) / "node_modules" / name).is_dir()]
        if missing:
            pytest.skip(f"SPARK_DIR has no {' and no '.join(missing)}")
    folder = npm.folder_with(PAGE, variable="SPARK_DIR", request=request, tmp_path_factory=tmp_path_factory)
    browser = Page(folder, chromium, tmp_path_factory.mktemp("pictures"))
    yield browser
    browser.close()


@pytest.fixture(scope="session")
def foreign_dir(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose node_modules has `PACKAGES`: the one that FOREIGN_DIR names, or one that is installed here."""
    return npm.folder_with(PACKAGES, variable="FOREIGN_DIR", request=request, tmp_path_factory=tmp_path_factory)


@pytest.fixture(scope="session")
def foreign(foreign_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Foreign]:
    """The other programs, started once for all tests."""
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    process = Foreign(foreign_dir, tmp_path_factory.mktemp("foreign-files"))
    yield process
    process.close()
