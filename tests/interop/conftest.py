"""Fixtures that start Spark, engines, and other programs for splat files, or skip the test if they are missing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import sparklod_cli
from tests.interop import engines
from tests.interop.engines import Browser, Shot, detailed
from tests.interop.foreign import Foreign, SplatTransform, SpzLibrary
from tests.interop.node import ENGINES, FOREIGN, PAGE, SPARK, SPZ_LIBRARY, folder_with, require
from tests.interop.pictures import Page
from tests.interop.spark import Spark

#: Makes the folder with packages that an environment variable names.
Folder = Callable[[dict[str, str], str], Path]


@pytest.fixture(scope="session")
def packages_in(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Folder:
    return lambda packages, variable: folder_with(
        packages, variable=variable, request=request, tmp_path_factory=tmp_path_factory
    )


@pytest.fixture(scope="session")
def spark_dir(packages_in: Folder) -> Path:
    return packages_in(SPARK, "SPARK_DIR")


@pytest.fixture(scope="session")
def page_dir(packages_in: Folder) -> Path:
    return packages_in(PAGE, "SPARK_DIR")


@pytest.fixture(scope="session")
def engines_dir(packages_in: Folder) -> Path:
    return packages_in(ENGINES, "ENGINES_DIR")


@pytest.fixture(scope="session")
def spark(spark_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Spark]:
    """Spark's worker."""
    process = Spark(spark_dir, tmp_path_factory.mktemp("spark-arrays"))
    yield process
    process.close()


@pytest.fixture(scope="session")
def foreign(packages_in: Folder, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Foreign]:
    process = Foreign(packages_in(FOREIGN, "FOREIGN_DIR"), tmp_path_factory.mktemp("foreign-files"))
    yield process
    process.close()


@pytest.fixture(scope="session")
def splat_transform(engines_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SplatTransform]:
    process = SplatTransform(engines_dir, tmp_path_factory.mktemp("columns"))
    yield process
    process.close()


@pytest.fixture(scope="session")
def spz_library(packages_in: Folder, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SpzLibrary]:
    process = SpzLibrary(packages_in(SPZ_LIBRARY, "SPZ_DIR"), tmp_path_factory.mktemp("spz-library"))
    yield process
    process.close()


# Browsers live as long as a module: an engine draws its page again and again as long as that is open.


@pytest.fixture(scope="module")
def page(page_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """Spark in a browser."""
    browser = Page(page_dir, require("chromium"), tmp_path_factory.mktemp("pictures"))
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def browser(engines_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser with the engines."""
    browser = Browser(engines_dir, require("chromium"), tmp_path_factory.mktemp("pictures"))
    yield browser
    browser.close()


@pytest.fixture(scope="session")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Shot:
    """The demo scene, in which up, left and front differ, as Streamed SOG."""
    return engines.written(detailed(), tmp_path_factory.mktemp("web"))


@pytest.fixture(scope="session")
def shot_with_sky(tmp_path_factory: pytest.TempPathFactory) -> Shot:
    """The same scene with an environment, which is in its splats."""
    return engines.written(detailed(with_sky=True), tmp_path_factory.mktemp("web"))


@pytest.fixture(scope="session")
def sog(shot: Shot, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Level 0 as a plain SOG, bundled and unbundled, by the names of the files."""
    folder = tmp_path_factory.mktemp("sog")
    files = {name: folder / name for name in (engines.SOG, "meta.json")}
    for file in files.values():
        sparklod_cli.write(file, sparklod_cli.read(shot.file))
    return files
